"""The one matrix operation everything stands on: rows in, an upper triangle out."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.samples import Floats

_PART = 1024  # rows of a part that is taken at once: with its copies it stays in the processor's cache


def triangle(rows: NDArray[np.floating[Any]]) -> Floats:
    """R of the QR decomposition of rows (..., m, n): (..., min(m, n), n), same normal equations R^T R as the rows.

    Orthogonal transforms only: the condition number is that of the rows, not its square.
    """
    count, width = rows.shape[-2:]
    if rows.ndim == 2 and count >= 4 * _PART:
        parts = rows[: count // _PART * _PART].reshape(-1, _PART, width)
        rows = np.vstack([*triangle(parts), rows[count // _PART * _PART :]])
    return cast("Floats", np.linalg.qr(rows, mode="r"))
