"""Training: the environment as a learner sees it, PPO, checks while it trains, and the final report."""
