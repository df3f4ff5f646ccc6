"""What moves the vehicle: a policy or a table of commands, and what a base must be known for."""
