"""What earlier commands left: folders of runs, read without trust, on one page, or live in a browser."""
