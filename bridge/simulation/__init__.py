"""Simulated vehicles behind the topics, and the node that serves them."""
