"""Evaluation of drivers: episodes, baselines, sweeps, intervals, and pages."""
