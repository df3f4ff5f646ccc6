"""What a vehicle is missing: evidence, its posterior, and the verdict."""
