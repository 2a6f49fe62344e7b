"""The choice of orientations: criteria, limits, exact designs and the next orientation."""
