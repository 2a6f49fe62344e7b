"""Tables of orientations: a row a dwell, with its mean readings."""
