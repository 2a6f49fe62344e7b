"""When a search for the least of a function ends, if it does not end by itself."""

from __future__ import annotations

MOST_STEPS = 60
"""Steps, each of which is shorter than the one before where the search converges."""
MOST_HALVINGS = 12
"""Halvings of a step after which the function does not fall: its slope is rounding."""
ENOUGH = 1e-9
"""A log-likelihood that is not worth another step."""
