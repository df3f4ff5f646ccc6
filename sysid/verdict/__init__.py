"""The verdict: which effects are named, how surely, and what speaks against them."""
