"""After the verdict: how far to trust it, what has no name, what these drives could show, and the next drive."""
