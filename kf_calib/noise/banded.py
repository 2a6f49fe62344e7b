"""Banded covariances of 3 D numbers, in which each three are correlated among themselves and with the next three only.

All operations take time proportional to D. A matrix is stored by columns as (D, 6, 3): for each three their own
covariance, and below it the covariance of the next three with them (zeros for the last). Where no three are correlated
with the next, only their own are stored, (D, 3, 3), and in place of the Cholesky factor its inverse, (D, 3, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, cast

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import inverse_of_lower

_BELOW = np.arange(6)[:, None] - np.arange(3)  # distance of an entry from the diagonal
_KEPT, _BAND = _BELOW >= 0, np.maximum(_BELOW, 0)
_TWICE = np.repeat([1.0, 2.0], 3)[:, None]  # blocks beside the diagonal occur on both sides


def root(columns: Floats) -> Floats:
    """The lower Cholesky factor in LAPACK's band storage: its diagonals (6, 3 D) from the main one down; the inverse
    (D, 3, 3) of the factor where no three are correlated with the next."""
    if columns.shape[1] == 3:
        return inverse_of_lower(cast("Floats", np.linalg.cholesky(columns)))
    padded = np.zeros((len(columns), 8, 3))
    padded[:, :6] = columns
    bands = padded[:, np.arange(3)[:, None] + np.arange(6), np.arange(3)[:, None]].reshape(-1, 6).T
    lower, failed = _lapack("pbtrf")(bands, lower=1, overwrite_ab=1)
    if failed:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return cast("Floats", lower)


def diagonal(lower: Floats) -> Floats:
    """The main diagonal (3 D,) of a Cholesky factor."""
    return 1.0 / np.einsum("dii->di", lower).ravel() if lower.ndim == 3 else lower[0]


def solve(lower: Floats, rows: Floats, transposed: bool = False) -> Floats:
    """The inverse of the Cholesky factor, or of its transpose, times rows (3 D, c)."""
    if not rows.size:
        return rows  # scipy's wrapper would write beyond empty arrays
    if lower.ndim == 3:
        back = np.swapaxes(lower, 1, 2) if transposed else lower
        return (back @ rows.reshape(-1, 3, rows.shape[1])).reshape(rows.shape)
    return cast("Floats", _lapack("tbtrs")(lower, rows, uplo="L", trans="T" if transposed else "N")[0])


def inverse(columns: Floats, lower: Floats) -> Floats:
    """The entries of the inverse within the band, from block Cholesky factors L of a forward and U of a backward
    elimination.

      X_d = L_d^-T (I - M' M)^-1 L_d^-1,  M = U_{d+1}^-1 L_{d+1,d};  below it: -X_{d+1} L_{d+1,d} L_d^-1
    """
    if lower.ndim == 3:
        return np.swapaxes(lower, 1, 2) @ lower
    forward, within_band = _unbanded(lower), np.zeros_like(columns)
    back, beside = np.linalg.inv(forward[:, :3]), forward[:-1, 3:]
    within_band[:, :3] = np.swapaxes(back, 1, 2) @ back
    if beside.any():
        backward = _unbanded(root(_reversed(columns)))[::-1, 2::-1, ::-1]
        share = np.linalg.solve(backward[1:], beside)
        middle = np.linalg.inv(np.eye(3) - np.swapaxes(share, 1, 2) @ share)
        within_band[:-1, :3] = np.swapaxes(back[:-1], 1, 2) @ middle @ back[:-1]
        within_band[:-1, 3:] = -within_band[1:, :3] @ beside @ back[:-1]
    return within_band


def outer(rows: Floats, height: int = 6) -> Floats:
    """The entries of rows rows^T within the band, for rows (3 D, c); with height 3, those of each three alone."""
    blocks = rows.reshape(-1, 3, rows.shape[1])
    if height == 3:
        return blocks @ np.swapaxes(blocks, 1, 2)
    later = np.concatenate([blocks[1:], np.zeros((1, *blocks.shape[1:]))])
    return np.concatenate([blocks, later], axis=1) @ np.swapaxes(blocks, 1, 2)


def traces(one: Floats, others: Floats) -> Floats:
    """Traces (k,) of the products of one matrix with others (k, D, 6, 3)."""
    return others.reshape(len(others), one.size) @ (_TWICE[: one.shape[1]] * one).ravel()


def products(columns: Floats, vector: Floats) -> Floats:
    """Products (3 D, k) of matrices (k, D, 6, 3) with a vector (3 D,)."""
    blocks = vector.reshape(-1, 3)
    both = columns @ blocks[:, :, None]
    sums = both[:, :, :3, 0]
    if columns.shape[2] == 3:
        return sums.reshape(len(columns), vector.size).T
    sums[:, 1:] += both[:, :-1, 3:, 0]
    sums[:, :-1] += (blocks[1:, None, :] @ columns[:, :-1, 3:])[:, :, 0]
    return sums.reshape(len(columns), vector.size).T


def _reversed(columns: Floats) -> Floats:
    """Return the matrix with the order of all numbers reversed."""
    turned_round = np.zeros_like(columns)
    turned_round[:, :3] = columns[::-1, 2::-1, ::-1]
    turned_round[:-1, 3:] = np.swapaxes(columns[-2::-1, 3:], 1, 2)[:, ::-1, ::-1]
    return turned_round


def _unbanded(lower: Floats) -> Floats:
    """Return the storage by columns (D, 6, 3) from LAPACK's band storage of a lower triangular matrix."""
    return np.where(_KEPT, lower.T.reshape(-1, 3, 6)[:, np.arange(3), _BAND], 0.0)


@lru_cache(maxsize=2)
def _lapack(name: str) -> Callable[..., Any]:
    """Return a LAPACK routine for doubles."""
    from scipy.linalg import get_lapack_funcs

    return cast("Callable[..., Any]", get_lapack_funcs(name, dtype=np.float64))
