"""Noise model, filters, least squares, the fit and its results."""
