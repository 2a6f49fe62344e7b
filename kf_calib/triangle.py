"""The one matrix operation everything stands on: rows in, an upper triangle out."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.samples import Floats

_FEW = 4096  # numbers: of more, the threads of some BLAS get in each other's way unless they are limited


def triangle(rows: NDArray[np.floating[Any]]) -> Floats:
    """R of the QR decomposition of rows (..., m, n): (..., min(m, n), n), same normal equations R^T R as the rows.

    Orthogonal transforms only: the condition number is that of the rows, not its square.
    """
    if rows.ndim > 2 or not 0 < rows.size <= _FEW:
        return cast("Floats", np.linalg.qr(rows, mode="r"))
    # numpy.linalg.qr calls the same, three times as slowly where rows are few
    below, _, _, _ = _geqrf()(rows, lwork=rows.shape[1])
    height = min(rows.shape)
    return below[:height] * _upper(height, rows.shape[1])


@lru_cache(maxsize=1)
def _geqrf() -> Callable[..., tuple[Floats, Floats, Floats, int]]:
    from scipy.linalg import get_lapack_funcs

    return cast("Callable[..., tuple[Floats, Floats, Floats, int]]", get_lapack_funcs("geqrf", dtype=np.float64))


@lru_cache(maxsize=256)
def _upper(height: int, width: int) -> Floats:
    """Ones on and above the diagonal (height, width)."""
    return np.triu(np.ones((height, width)))
