"""Recordings of ROS: their streams, found by topic and type."""
