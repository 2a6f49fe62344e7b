"""The nuisance states of a dwell: its setting error, a small rotation, and the scatter of each accelerometer.

A rotation about the axis t changes the reading of accelerometer i by t . (f x s_i), with s_i its sensitivity, to which
what effects add per unit of force belongs. Where the attitude of the dwells is not known at all, nor that it stays the
same within a dwell (a hand creeps and trembles), one combination of the three readings is left at every instant: that
along the force, which no rotation changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.rows import REGRESSORS
from kf_calib.dwells.stack import DwellStack, Folded
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.noise.noise_model import FLOOR_MPS2, Noise

SLOW = np.arange(1, 5)
"""Numbers of half cycles of the slow waves of 1/f noise in a dwell."""


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
