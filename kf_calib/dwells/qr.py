"""The one matrix operation everything stands on: rows in, an upper triangle out."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats

_PART = 1024  # rows of a part that is taken at once: with its copies it stays in the processor's cache


def triangle(rows: NDArray[np.floating[Any]]) -> Floats:
    """R of the QR decomposition of rows (..., m, n): (..., min(m, n), n), same normal equations R^T R as the rows.

    Orthogonal transforms only: the condition number is that of the rows, not its square.
    """
    count, width = rows.shape[-2:]
    part = max(_PART, 4 * width)
    if rows.ndim == 2 and count >= 4 * part:
        whole = count // part * part
        rows = np.vstack([*(triangle(rows[k : k + part]) for k in range(0, whole, part)), rows[whole:]])
    return cast("Floats", np.linalg.qr(rows, mode="r"))


def orthonormal(rows: Floats) -> tuple[Floats, Floats]:
    """Q (m, k) and R (k, n) of rows (m, n), k the smaller of m and n; Q may be written into the rows: there is no room
    for both."""
    count, width = rows.shape
    part = max(_PART, 4 * width)
    if count < 2 * part or not width:
        return np.linalg.qr(rows)
    parts = [slice(k, min(k + part, count)) for k in range(0, count - width, part)]
    parts[-1] = slice(parts[-1].start, count)  # no part has fewer rows than columns
    upper = np.empty((len(parts) * width, width))
    for k, own in enumerate(parts):
        rows[own], upper[k * width : (k + 1) * width] = np.linalg.qr(rows[own])
    turned, out = orthonormal(upper)
    for k, own in enumerate(parts):
        rows[own] = rows[own] @ turned[k * width : (k + 1) * width]
    return rows, out
