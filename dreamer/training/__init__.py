"""What a training run keeps: its first state, programs, devices, checkpoints, metrics."""
