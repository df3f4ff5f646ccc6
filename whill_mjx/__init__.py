"""Batched simulator of micromobility vehicles on MuJoCo MJX."""

from whill_mjx.processor import share_results

__version__ = "0.1.0"

share_results()
