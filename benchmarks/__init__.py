"""One script per claim; each writes benchmarks/results/<name>.json."""
