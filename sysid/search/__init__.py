"""The searches: bounded least squares from many starts, and the global ones by Optuna."""
