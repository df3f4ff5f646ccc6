"""Thin ROS 2 bridge: runs a policy file on the vehicle, and the simulator behind the same topics."""
