"""The nuisance states of a dwell: a small rotation, the scatter of each accelerometer, and slow waves of 1/f noise.

A rotation about the axis t changes the reading of accelerometer i by t . (f x s_i), with s_i its sensitivity, to which
what effects add per unit of force belongs. Where the attitude of the dwells is not known at all, nor that it stays the
same within a dwell (a hand creeps and trembles), one combination of the three readings is left at every instant: that
along the force, which no rotation changes.

With 1/f noise of spectral density h / f the component sqrt(2) cos(pi k t / T) of a dwell of length T has the variance
h / k, whatever T is. Scatter from dwell to dwell that is 1/f noise goes on within the dwells; scatter of another cause
(a mounting, a creep after each motion) does not. So h is estimated from the waves within dwells that scatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import of_all_pieces
from kf_calib.dwells.rows import REGRESSORS, on_basis
from kf_calib.dwells.stack import DwellStack, Folded
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.noise.noise_model import FLOOR_MPS2, Noise

SLOW = np.arange(1, 5)
"""Numbers of half cycles of the slow waves of 1/f noise in a dwell."""

_GRID = np.geomspace(1e-3, 1e5, 161)  # of h, in variances of the amplitudes by the noise of the readings
_CLEAR = 0.5 * 3.84  # gain in log-likelihood over none: 1/f noise that is less clear changes no sigma


def flicker_waves(folded: Folded) -> Floats:
    """sqrt(2) cos(pi k t / T) over a dwell of length T at the nodes of all pieces, (pieces, nodes, k)."""
    if "flicker_waves" in folded.known:
        return folded.known["flicker_waves"]
    starts_s, ends_s = np.repeat(folded.ends_s, 3 * folded.piece_numbers, axis=0).T
    share = (folded.elapsed_s - starts_s) / np.maximum(ends_s - starts_s, 1e-9)
    waves = (np.sqrt(2.0) * np.cos(np.pi * SLOW * share[:, None])).reshape(-1, 3, len(SLOW))
    return folded.known.setdefault("flicker_waves", waves)


def flicker_sigmas(flicker_mps2: Floats) -> Floats:
    """Prior sigmas (3 k,) of the amplitudes of the slow waves of each accelerometer, from sqrt(h) (3,)."""
    return np.outer(np.maximum(flicker_mps2, FLOOR_MPS2), 1.0 / np.sqrt(SLOW)).ravel()


def tangents(force: Floats) -> Floats:
    """Two unit vectors across each force, as columns (D, 3, 2)."""
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    start = np.eye(3)[np.abs(unit).argmin(axis=1)]
    one = np.cross(unit, start)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.asarray(np.stack([one, np.cross(unit, one)], axis=2), float)


def rotation_map(force_mps2: Floats, sensitivities: Floats, axes: Floats) -> Floats:
    """Columns (D, 3, k) of small rotations about ``axes`` (D, 3, k): S (t x f), for forces (D, 3) and S (D, 3, 3)."""
    turned = np.cross(np.swapaxes(axes, 1, 2), force_mps2[:, None, :])  # (D, k, 3)
    return np.asarray(sensitivities @ np.swapaxes(turned, 1, 2), float)


def along_force(dwells: Sequence[DwellFactor], sensitivities: Floats, some: NDArray[np.intp] | None = None) -> Floats:
    """The weights m (D, 3) of the three channels in the size of the force of each dwell: m = S^-T f / |f|.

    No rotation changes m . reading, which is |f| but for biases; sensitivities S are (D, 3, 3). some (d,): indices of
    the dwells of which alone it is wanted, and their sensitivities (d, 3, 3).
    """
    force = DwellStack.of(dwells).felt_means_mps2
    force = force if some is None else force[some]
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    return np.asarray(np.linalg.solve(np.swapaxes(sensitivities, 1, 2), unit[:, :, None])[:, :, 0], float)


def sensitivities_of(dwells: Sequence[DwellFactor], state: Floats, some: NDArray[np.intp] | None = None) -> Floats:
    """Change (D, 3, 3) of the readings of each dwell per unit of force at ``state`` (p,), effects included.

    some (d,): indices of the dwells of which alone it is wanted.
    """
    bendings = DwellStack.of(dwells).bendings
    return state[:STATE_COUNT].reshape(3, 4)[:, :3] + (bendings if some is None else bendings[some])


def nuisance_sigmas(noise: Noise) -> Floats:
    """Prior sigmas (q,) of the nuisance states: of the rotations, rad, and of the offsets, m/s^2; those that are zero
    are left out, and rotations of an unknown attitude, of which readings along the force are free."""
    rotations = np.full(0 if noise.attitude_unknown else 3, noise.setting_rad)
    return np.concatenate([rotations[rotations > 0], noise.scatter_mps2[noise.scatter_mps2 > 0]])


def nuisance_map(sensitivities: Floats, noise: Noise) -> Floats:
    """The coefficients (D, 3, 4, q) of the nuisance states on the regressors 1, f_x, f_y, f_z, for ``sensitivities_of``
    the dwells (D, 3, 3)."""
    turning = 0.0 < noise.setting_rad < np.inf
    scattering, count = np.flatnonzero(noise.scatter_mps2 > 0), 3 if turning else 0
    coefficients = np.zeros((len(sensitivities), 3, len(REGRESSORS), count + len(scattering)))
    if turning:
        x, y, z = np.moveaxis(sensitivities, 2, 0)
        none = np.zeros_like(x)
        crossing = np.array([[none, -z, y], [z, none, -x], [-y, x, none]])  # (f x s) = f^T [s]
        coefficients[:, :, 1:, :3] = np.moveaxis(crossing, (0, 1), (2, 3))
    coefficients[:, scattering, 0, count + np.arange(len(scattering))] = 1.0
    return coefficients


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
        by_readings = np.einsum("dci,di->dc", ours**2, sigma**2 / stack.folded.weights[shape.dwells])
        spreads = np.maximum(np.einsum("dkk->dk", inverse), 1e-300)[:, :, None] * by_readings[:, None]
        amplitudes[shape.dwells], variances[shape.dwells] = inverse @ (back @ left), spreads
    return amplitudes, variances


def _likeliest(amplitudes: Floats, variances: Floats) -> float:
    """Return sqrt(h) for amplitudes (D, k) of the waves k = 1, 2, ... with these variances by other noise."""
    sizes = np.append(0.0, _GRID * float(np.median(variances)))
    total = variances[..., None] + sizes / SLOW[:, None]
    log = -0.5 * (np.log(total) + amplitudes[..., None] ** 2 / total).sum(axis=(0, 1))
    best = int(log.argmax())
    return float(np.sqrt(sizes[best])) if log[best] - log[0] > _CLEAR else 0.0
