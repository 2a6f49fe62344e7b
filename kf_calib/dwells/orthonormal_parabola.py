"""The parabola that is subtracted from readings so that the residuals are their noise."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import Floats


@lru_cache(maxsize=4)  # blocks are mostly of one length
def orthonormal_parabola(count: int) -> Floats:
    """1, u, u^2 at ``count`` instants evenly from u = -1 to 1, made orthonormal, (n, 3)."""
    u = np.linspace(-1.0, 1.0, count)
    return np.linalg.qr(np.column_stack([np.ones(count), u, u * u]))[0]
