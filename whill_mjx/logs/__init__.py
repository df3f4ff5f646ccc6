"""Driving logs that the simulator writes: manoeuvres, simulated sensors, and the dataset."""
