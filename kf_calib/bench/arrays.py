"""Array types, named by what the arrays hold, and the lengths of vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


def lengths(vectors: Floats) -> Floats:
    """The length (n,) of each row (n, k) of numbers as they stand in a file; infinite where it is beyond a double."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=1))
