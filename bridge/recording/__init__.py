"""Drives written as trials of a driving-log dataset, and as MCAP files."""
