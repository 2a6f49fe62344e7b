"""Batch least squares with the same columns: all rows of a recording in one dense system.

This is the textbook alternative to the filter and the reference for it: generalised least squares with the covariance
of the noise model, solved by one QR decomposition. Its memory grows with the length of the recording, while that of the
filter does not.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.samples import Samples
from kf_calib.estimation.square_root_information import scale_columns

_SEEN = 1e-9  # singular values that are smaller relative to the largest are rounding


def least_squares(samples: Iterable[Samples], around: Floats) -> tuple[Floats, Floats]:
    """State (p,) and covariance (p, p) from all samples, with a diffuse prior and without process noise.

    Combinations of the state that the samples do not determine keep their value in ``around`` (p,), and their variance
    is not in the covariance.

    After division by the white sigma, the rows of a dwell have the covariance V = I + B B^T, where B holds the dwell's
    nuisance columns times their sigmas. They are whitened by V^(-1/2) = I - U (1 - (1 + s^2)^(-1/2)) U^T from the thin
    SVD of B.
    """
    by_dwell: dict[tuple[int, bool], list[Samples]] = {}
    for piece in samples:
        by_dwell.setdefault((piece.dwell, piece.moving), []).append(piece)
    whitened = (_whitened(pieces) for pieces in by_dwell.values())
    stacked = np.concatenate(list(whitened))
    scale = np.linalg.norm(stacked[:, :-1], axis=0)
    return _solution(stacked, np.where(scale > 0, scale, 1.0), around)


def running_states(samples: Iterable[Samples], around: Floats) -> Floats:
    """States (D, p) from the samples of the first dwell alone, the first two, ... all D; slews belong to the dwell
    before. Each is the least-squares solution as in ``least_squares``; the rows so far are kept as a triangle."""

    def solved(upper: Floats) -> Floats:
        """Return the state; a column of rounding size alone does not determine what other dwells may."""
        return _solution(upper, scale_columns(upper)[1], around)[0]

    upper, states = np.zeros((0, len(around) + 1)), list[Floats]()
    for (_, moving), pieces in itertools.groupby(samples, key=lambda piece: (piece.dwell, piece.moving)):
        if not moving and len(upper):
            states.append(solved(upper))
        rows = _whitened(list(pieces))
        upper = triangle(np.vstack([upper, rows]))
    return np.array([*states, solved(upper)])


def _solution(rows: Floats, scale: Floats, around: Floats) -> tuple[Floats, Floats]:
    """Return state (p,) and covariance (p, p) from whitened rows [H | z] (n, p + 1), columns divided by ``scale``."""
    design, readings = rows[:, :-1], rows[:, -1]
    left, upper = np.linalg.qr(design / scale)
    rotated, singular, right = np.linalg.svd(upper, full_matrices=False)  # fewer rows than columns at first
    seen = singular > _SEEN * singular[0]
    inverse = (right[seen].T / singular[seen]) / scale[:, None]
    solution = around + inverse @ (rotated[:, seen].T @ (left.T @ (readings - design @ around)))
    return np.asarray(solution, float), np.asarray(inverse @ inverse.T, float)


def _whitened(pieces: list[Samples]) -> Floats:
    """Return the whitened rows [H | z] (3 n, p + 1) of one dwell's samples."""
    rows = np.concatenate([np.concatenate([p.observation, p.readings[:, :, None]], axis=2) for p in pieces])
    sigma = np.concatenate([np.repeat(p.sigma_mps2[None], len(p.readings), axis=0) for p in pieces])[:, :, None]
    flat = (rows / sigma).reshape(-1, rows.shape[2])
    if pieces[0].nuisance_sigmas.size:
        shared = np.concatenate([p.nuisances * p.nuisance_sigmas for p in pieces])
        shared = (shared / sigma).reshape(len(flat), -1)
        left, singular, _ = np.linalg.svd(shared, full_matrices=False)
        flat = flat - left @ ((1 - 1 / np.sqrt(1 + singular**2))[:, None] * (left.T @ flat))
    return flat
