"""1/f noise that goes on within the dwells: its likeliest size, from the slow waves in dwells that scatter.

Scatter from dwell to dwell that is 1/f noise goes on within the dwells; scatter of another cause (a mounting, a creep
after each motion) does not. So the spectral density h / f is estimated from the waves within dwells that scatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.pieces import of_all_pieces
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.rotations import along_force, sensitivities_of
from kf_calib.noise.terms import SLOW, SlowWaves, waves_in_dwells
from kf_calib.support.tail_probabilities import SIGMAS_95

_GRID = np.geomspace(1e-3, 1e5, 161)  # of h, in variances of the amplitudes by the noise of the readings


def with_waves_in_dwells(noise: Noise, dwells: Sequence[Dwell], columns: Sequence[Floats], state: Floats) -> Noise:
    """The noise with 1/f noise within dwells; without where the dwells do not scatter, or show no slow waves.

    The likeliest h of each accelerometer; one for all three where attitudes are not known. ``columns`` are those of the
    model at the nodes of each dwell, (pieces, nodes, 3, p), ``state`` (p,) its estimate.
    """
    table = DwellTable.of(dwells)
    if not noise.scatter_mps2.any() or noise.walk.steps or table.folded.carrier_hz:
        return noise
    if table.folded.shows_means_only:
        return noise
    channels = np.eye(3)[None].repeat(len(dwells), axis=0)
    if noise.attitude_unknown:
        along = along_force(table, sensitivities_of(table, state))
        channels = (along / np.linalg.norm(along, axis=1, keepdims=True))[:, None]
    amplitudes, variances = _amplitudes(table, of_all_pieces(columns) @ state, noise.effective_sigma_mps2, channels)
    sizes = [_likeliest(amplitudes[..., i], variances[..., i]) for i in range(channels.shape[1])]
    return noise.with_terms(SlowWaves(np.broadcast_to(sizes, 3))) if any(sizes) else noise


def _amplitudes(table: DwellTable, predicted: Floats, sigma: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the amplitudes (D, k, c) of the slow waves in what a prediction (pieces, nodes, 3) leaves of each dwell
    beside its mean, and their variances (D, k, c) by the noise of the readings, in channels with ``weights`` (D, c,
    3)."""
    amplitudes, courses = np.empty((len(table), len(SLOW), weights.shape[1])), on_basis(waves_in_dwells(table.folded))
    variances, coefficients = np.empty_like(amplitudes), on_basis(predicted)
    for shape in table.folded.shapes:
        triangles = table.triangles[shape.pieces]
        upper, many = triangles[:, :, :3, :3], len(shape.dwells)
        ours = weights[shape.dwells]
        left = triangles[:, :, :3, 3:] - upper @ coefficients[shape.pieces]
        level, waves, left = (part.reshape(many, -1, part.shape[-1]) for part in (
            upper[..., :1], upper @ courses[shape.pieces], left))  # fmt: skip
        left = left @ np.swapaxes(ours, 1, 2)
        unit = level / np.linalg.norm(level, axis=1, keepdims=True)
        along = np.swapaxes(unit, 1, 2)
        waves, left = waves - unit @ (along @ waves), left - unit @ (along @ left)
        back = np.swapaxes(waves, 1, 2)
        inverse = np.linalg.pinv(back @ waves, rcond=1e-9, hermitian=True)
        by_readings = np.einsum("dci,di->dc", ours**2, sigma**2 / table.folded.weights[shape.dwells])
        spreads = np.maximum(np.einsum("dkk->dk", inverse), 1e-300)[:, :, None] * by_readings[:, None]
        amplitudes[shape.dwells], variances[shape.dwells] = inverse @ (back @ left), spreads
    return amplitudes, variances


def _likeliest(amplitudes: Floats, variances: Floats) -> float:
    """Return sqrt(h) for amplitudes (D, k) of the waves k = 1, 2, ... with these variances by other noise."""
    sizes = np.append(0.0, _GRID * float(np.median(variances)))
    total = variances[..., None] + sizes / SLOW[:, None]
    log = -0.5 * (np.log(total) + amplitudes[..., None] ** 2 / total).sum(axis=(0, 1))
    best = int(log.argmax())
    clear = log[best] - log[0] > 0.5 * SIGMAS_95**2  # 1/f noise that is less clear changes no sigma
    return float(np.sqrt(sizes[best])) if clear else 0.0
