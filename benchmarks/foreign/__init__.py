"""A foreign corridor to measure with, never to train on: contact physics, another renderer, other looks."""
