"""Identification of vehicle parameters from driving logs."""
