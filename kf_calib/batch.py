"""Batch least squares on the same columns: every row of the recording in one dense system.

The textbook's alternative to the filter, and its judge: generalised least squares with the noise model's covariance,
solved by one call of LAPACK. Its memory grows with the recording; the filter's does not.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kf_calib.model import STATE_COUNT, Rows, dwell_map, state_map
from kf_calib.noise import Noise
from kf_calib.samples import Floats


def least_squares(rows: Iterable[Rows], noise: Noise, linearised_at: Floats) -> tuple[Floats, Floats]:
    """Affine state (12,) and covariance (12, 12) of all rows; diffuse prior, no process noise.

    Rows of a dwell have covariance V = I + B B^T after division by the white sigma, B the dwell's nuisance columns
    times their sigmas; V^(-1/2) = I - U (1 - (1 + s^2)^(-1/2)) U^T from the thin SVD of B.
    """
    by_dwell: dict[int, list[Floats]] = {}
    for block in rows:
        by_dwell.setdefault(block.dwell, []).append(np.concatenate([block.columns, block.readings], axis=1))
    stacked = np.concatenate([_whitened(np.concatenate(part), noise, linearised_at) for part in by_dwell.values()])
    design, readings = stacked[:, :-1], stacked[:, -1]
    scale = np.linalg.norm(design, axis=0)
    design = design / scale
    solution = np.linalg.lstsq(design, readings, rcond=None)[0]
    return solution / scale, np.linalg.inv(design.T @ design) / np.outer(scale, scale)


def _whitened(samples: Floats, noise: Noise, linearised_at: Floats) -> Floats:
    """Whitened rows [H | z] (3 n, 13) of one dwell's samples (n, 7)."""
    columns, count = samples[:, :4], len(samples)
    sigma, used = noise.effective_sigma_mps2, noise.dwell_sigmas > 0
    maps, nuisances = state_map(), dwell_map(linearised_at)[:, :, used] * noise.dwell_sigmas[used]
    out = np.empty((3, count, STATE_COUNT + 1))
    shared = np.empty((3, count, int(used.sum())))
    for i in range(3):
        out[i, :, :-1] = columns @ maps[i] / sigma[i]
        out[i, :, -1] = samples[:, 4 + i] / sigma[i]
        shared[i] = columns @ nuisances[i] / sigma[i]
    flat, common = out.reshape(3 * count, -1), shared.reshape(3 * count, -1)
    if common.shape[1]:
        left, singular, _ = np.linalg.svd(common, full_matrices=False)
        flat = flat - left @ ((1 - 1 / np.sqrt(1 + singular**2))[:, None] * (left.T @ flat))
    return flat
