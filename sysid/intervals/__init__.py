"""How far a fitted parameter may be trusted: variances of correlated errors, intervals, profiles."""
