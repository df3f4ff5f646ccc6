"""Driving logs: the dataset and its loaders, the quality of streams, and errors between motions."""
