"""Sensors: what a task or a user may observe besides the camera image. One sensor a file."""
