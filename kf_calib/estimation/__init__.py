"""The measurement model, the filters, least squares, the fit of a model and its results."""
