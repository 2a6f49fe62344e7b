"""Numbers of readings and of sigmas from which something is told; several modules have them in common."""

from __future__ import annotations

import numpy as np

CURVE = 3
"""Coefficients of a parabola, and the readings or messages that its second difference takes."""
CUBIC = 3
"""Degree of the curves that follow what changes slowly: noise over frequencies, the temperature over a run."""
SIMPSON = np.array([1.0, 4.0, 1.0]) / 6.0
"""Weights of begin, middle and end of a piece in the mean of a parabola."""
FEWEST_COMPARED = 4
"""Dwells, windows of readings, or readings in one, of which it is told how they differ."""
FEWEST_READINGS = 8
"""Readings, or degrees of freedom, whose scatter tells noise."""
SAMPLE = 32
"""Numbers whose median tells what is usual."""
SIGMAS = 6.0
"""What is farther off than by so many is no chance."""
