"""1/f noise within dwells: slow waves in the readings, whose size is estimated where the dwells scatter.

With 1/f noise of spectral density h / f the component sqrt(2) cos(pi k t / T) of a dwell of length T has the variance
h / k, whatever T is. Scatter from dwell to dwell that is 1/f noise goes on within the dwells; scatter of another cause
(a mounting, a creep after each motion) does not. The waves within the dwells tell which it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.rows import on_basis
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
    without = dwells[0].carrier_hz or not any(map(_shows_course, dwells))
    if without or not noise.scatter_mps2.any() or noise.walk_mps2_per_sqrt_s:
        return np.zeros(3)
    channels = np.eye(3)[None].repeat(len(dwells), axis=0)
    if noise.attitude_unknown:
        along = along_force(dwells, sensitivities_of(dwells, state))
        channels = (along / np.linalg.norm(along, axis=1, keepdims=True))[:, None]
    pairs = [
        _amplitudes(dwell, design @ state, noise.effective_sigma_mps2 / np.sqrt(dwell.weight), weights)
        for dwell, design, weights in zip(dwells, columns, channels, strict=True)
    ]
    amplitudes, variances = (np.array(values) for values in zip(*pairs, strict=True))  # (D, k, c) each
    return np.broadcast_to([_likeliest(amplitudes[..., i], variances[..., i]) for i in range(channels.shape[1])], 3)


def _shows_course(dwell: DwellFactor) -> bool:
    """Tell whether more than the mean of a dwell is known."""
    return len(dwell.pieces) > 1 or bool(dwell.triangles[:, 1:3].any())


def _amplitudes(dwell: DwellFactor, predicted: Floats, sigma: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the amplitudes (k, c) of the slow waves in what a prediction (pieces, nodes, 3) leaves of a dwell beside
    its mean, and their variances (k, c) by the noise of the readings, in channels with ``weights`` (c, 3)."""
    upper = dwell.triangles[:, :3, :3]
    left = (dwell.triangles[:, :3, 3:] - upper @ on_basis(predicted)) @ weights.T
    waves = upper @ on_basis(flicker_waves(dwell))
    level, waves, left = (part.reshape(-1, part.shape[-1]) for part in (upper[..., :1], waves, left))
    unit = level / np.linalg.norm(level)
    waves, left = waves - unit @ (unit.T @ waves), left - unit @ (unit.T @ left)
    inverse = np.linalg.pinv(waves.T @ waves, rcond=1e-9, hermitian=True)
    variances = np.outer(np.maximum(np.diag(inverse), 1e-300), weights**2 @ sigma**2)
    return inverse @ (waves.T @ left), variances


def _likeliest(amplitudes: Floats, variances: Floats) -> float:
    """Return sqrt(h) for amplitudes (D, k) of the waves k = 1, 2, ... with these variances by other noise."""
    sizes = np.append(0.0, _GRID * float(np.median(variances)))
    total = variances[..., None] + sizes / SLOW[:, None]
    log = -0.5 * (np.log(total) + amplitudes[..., None] ** 2 / total).sum(axis=(0, 1))
    best = int(log.argmax())
    return float(np.sqrt(sizes[best])) if log[best] - log[0] > _CLEAR else 0.0
