"""Tasks: where episodes start, what is rewarded, and when they end."""
