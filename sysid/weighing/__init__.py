"""A trial beside the search: what is missing by posterior weight, from a saved file of evidence."""
