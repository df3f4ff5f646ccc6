"""What the agent learns from: collected steps, their replay, noise, and an iteration over them."""
