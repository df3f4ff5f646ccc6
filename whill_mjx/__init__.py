"""Batched simulator of micromobility vehicles on MuJoCo MJX."""

from whill_mjx.processor import share_results

share_results()
