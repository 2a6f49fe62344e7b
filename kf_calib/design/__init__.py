"""Where to point: criteria, limits, exact designs, the next orientation."""
