"""Ways to look at a result: the console, JSON and Rerun. Views read results; nothing reads a view."""
