"""Batched simulator of micromobility vehicles on MuJoCo MJX."""
