"""1/f noise within dwells: slow waves in the readings, whose size is estimated where the dwells scatter.

With 1/f noise of spectral density h / f the component sqrt(2) cos(pi k t / T) of a dwell of length T has the variance
h / k, whatever T is. Scatter from dwell to dwell that is 1/f noise goes on within the dwells; scatter of another cause
(a mounting, a creep after each motion) does not. The waves within the dwells tell which it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.piece_values import of_all_pieces
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.stack import DwellStack
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.nuisance_states import SLOW, along_force, flicker_waves, sensitivities_of

_GRID = np.geomspace(1e-3, 1e5, 161)  # of h, in variances of the amplitudes by the noise of the readings
_CLEAR = 0.5 * 3.84  # gain in log-likelihood over none: 1/f noise that is less clear changes no sigma


def flicker_within(dwells: Sequence[DwellFactor], columns: Sequence[Floats], state: Floats, noise: Noise) -> Floats:
    """sqrt(h) (3,) of the 1/f noise within dwells; zeros where the dwells do not scatter, or show no slow waves.

    The likeliest h of each accelerometer; one for all three where attitudes are not known. ``columns`` are those of the
    model at the nodes of each dwell, (pieces, nodes, 3, p), ``state`` (p,) its estimate.
    """
    stack = DwellStack.of(dwells)
    if not noise.scatter_mps2.any() or noise.walk_mps2_per_sqrt_s or stack.folded.dwells[0].carrier_hz:
        return np.zeros(3)
    if stack.folded.shows_means_only:
        return np.zeros(3)
    channels = np.eye(3)[None].repeat(len(dwells), axis=0)
    if noise.attitude_unknown:
        along = along_force(stack, sensitivities_of(stack, state))
        channels = (along / np.linalg.norm(along, axis=1, keepdims=True))[:, None]
    amplitudes, variances = _amplitudes(stack, of_all_pieces(columns) @ state, noise.effective_sigma_mps2, channels)
    return np.broadcast_to([_likeliest(amplitudes[..., i], variances[..., i]) for i in range(channels.shape[1])], 3)


def _amplitudes(stack: DwellStack, predicted: Floats, sigma: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the amplitudes (D, k, c) of the slow waves in what a prediction (pieces, nodes, 3) leaves of each dwell
    beside its mean, and their variances (D, k, c) by the noise of the readings, in channels with ``weights`` (D, c,
    3)."""
    amplitudes, courses = np.empty((len(stack), len(SLOW), weights.shape[1])), on_basis(flicker_waves(stack.folded))
    variances, coefficients = np.empty_like(amplitudes), on_basis(predicted)
    for shape, triangles in zip(stack.folded.shapes, stack.triangles, strict=True):
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
        spreads = np.maximum(np.einsum("dkk->dk", inverse), 1e-300)[:, :, None] * (ours**2 @ sigma**2)[:, None]
        spreads /= stack.folded.weights[shape.dwells, None, None]
        amplitudes[shape.dwells], variances[shape.dwells] = inverse @ (back @ left), spreads
    return amplitudes, variances


def _likeliest(amplitudes: Floats, variances: Floats) -> float:
    """Return sqrt(h) for amplitudes (D, k) of the waves k = 1, 2, ... with these variances by other noise."""
    sizes = np.append(0.0, _GRID * float(np.median(variances)))
    total = variances[..., None] + sizes / SLOW[:, None]
    log = -0.5 * (np.log(total) + amplitudes[..., None] ** 2 / total).sum(axis=(0, 1))
    best = int(log.argmax())
    return float(np.sqrt(sizes[best])) if log[best] - log[0] > _CLEAR else 0.0
