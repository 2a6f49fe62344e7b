"""A simulated bench: the nonlinear truth, with effects injected into it."""
