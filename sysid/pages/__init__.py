"""Reports that people read: HTML pages, charts, plots, and the JSON beside them."""
