"""Numbers of readings and of sigmas from which something is told; several modules have them in common."""

from __future__ import annotations

CURVE = 3
"""Coefficients of a parabola, and the readings or messages that its second difference takes."""
FEWEST_READINGS = 8
"""Readings, or degrees of freedom, whose scatter tells noise."""
FEWEST_DWELLS = 4
"""Dwells that tell how dwells differ, or what goes on over the run."""
SAMPLE = 32
"""Numbers whose median tells what is usual."""
SIGMAS = 6.0
"""What is farther off than by so many is no chance."""
