"""The QR decompositions on which all estimates rest."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import AT_ONCE, Floats, Mask, portions


def triangle(rows: NDArray[np.floating[Any]]) -> Floats:
    """The factor R (..., min(m, n), n) of the QR decomposition of rows (..., m, n), so that R^T R equals rows^T rows.

    Only orthogonal transformations are used, so that the condition number is that of the rows, not its square.
    """
    count, width = rows.shape[-2:]
    part = max(AT_ONCE, 4 * width)
    if rows.ndim == 2 and count >= 4 * part:
        whole = count // part * part
        rows = np.vstack([*(triangle(rows[k : k + part]) for k in range(0, whole, part)), rows[whole:]])
    # numpy's mode "r" makes the mask anew at each call, which for a small matrix takes as long as its decomposition
    least = min(count, width)
    folded = np.swapaxes(np.linalg.qr(rows, mode="raw")[0], -1, -2)[..., :least, :]
    return cast("Floats", np.where(_upper(least, width), folded, 0.0))


def square_triangle(stacked: Floats) -> Floats:
    """The square triangular factors of rows (..., n, c), padded with zeros if there are fewer rows than columns."""
    missing = stacked.shape[-1] - stacked.shape[-2]
    if missing > 0:
        zeros = np.zeros((*stacked.shape[:-2], missing, stacked.shape[-1]))
        stacked = np.concatenate([stacked, zeros], axis=-2)
    return triangle(stacked)


@lru_cache(maxsize=256)
def _upper(count: int, width: int) -> Mask:
    """Return the mask (m, n) of an upper triangle."""
    return np.arange(count)[:, None] <= np.arange(width)


def orthonormal(rows: Floats) -> tuple[Floats, Floats]:
    """The factors Q (m, k) and R (k, n) of the QR decomposition of rows (m, n), where k is the smaller of m and n.

    To save memory, Q may overwrite the rows.
    """
    count, width = rows.shape
    part = max(AT_ONCE, 4 * width)
    if count < 2 * part or not width:
        return np.linalg.qr(rows)
    parts = [slice(k, min(k + part, count)) for k in range(0, count - width, part)]
    parts[-1] = slice(parts[-1].start, count)  # so that no part has fewer rows than columns
    upper = np.empty((len(parts) * width, width))
    for k, part_rows in enumerate(parts):
        rows[part_rows], upper[k * width : (k + 1) * width] = np.linalg.qr(rows[part_rows])
    small_q, factor = orthonormal(upper)
    for k, part_rows in enumerate(parts):
        rows[part_rows] = rows[part_rows] @ small_q[k * width : (k + 1) * width]
    return rows, factor


def multiplied(rows: Floats, matrix: Floats) -> Floats:
    """The product (m, l) of rows (m, n) and a matrix (n, l) that is no wider; to save memory, it overwrites the
    rows."""
    product = rows[:, : matrix.shape[1]]
    for part in portions(len(rows), AT_ONCE):
        product[part] = rows[part] @ matrix
    return product


def spanned(columns: Floats, least: float = 1e-9) -> tuple[Floats, Floats, float]:
    """What columns (m, n) span: an orthonormal basis (m, r), the matrix (n, r) from its coefficients to theirs, and the
    logarithm of their volume; what is less than a share ``least``, as rounding is, counts as nothing. To save memory,
    the columns are overwritten."""
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    columns /= lengths
    rows, upper = orthonormal(columns)
    turn, singular, right = np.linalg.svd(upper, full_matrices=False)
    seen = singular > least * singular.max(initial=0.0)
    log_volume = float(np.log(singular[seen]).sum() + np.log(lengths).sum())
    return multiplied(rows, turn[:, seen]), right[seen].T / singular[seen] / lengths[:, None], log_volume


def inverse_of_lower(lower: Floats) -> Floats:
    """The inverses (n, k, k) of many small lower triangles, by substitution: each entry has the accuracy of its terms.

    LAPACK's inverse of each matrix alone takes several times as long, and so does substitution in wide rows.
    """
    inverse = np.zeros_like(lower)
    for i in range(lower.shape[-1]):
        inverse[:, i, i] = 1.0 / lower[:, i, i]
        for j in range(i):
            terms = lower[:, i, j:i] * inverse[:, j:i, j]
            inverse[:, i, j] = -inverse[:, i, i] * terms.sum(axis=1)
    return inverse
