"""What may be missing: effects as hypotheses, their signatures in drives, reference days, and refits."""
