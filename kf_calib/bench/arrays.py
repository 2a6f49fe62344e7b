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


def crossed(one: Floats, other: Floats) -> Floats:
    """The cross products (n, 3) of vectors (n, 3); ``np.cross`` takes several times as long."""
    (a, b, c), (x, y, z) = one.T, other.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)
