"""Numbers so large or small that only their logarithms are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def weights(logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers that sum to 1 and are in proportion to those given by their logarithms."""
    return np.exp(logarithms - np.logaddexp.reduce(logarithms, axis=None))
