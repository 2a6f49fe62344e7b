"""The nuisance states of a dwell: its setting error, a small rotation, and the scatter of each accelerometer.

A rotation about the axis t changes the reading of accelerometer i by t . (f x s_i), with s_i its sensitivity, to which
what effects add per unit of force belongs. Where the attitude of the dwells is known but for a setting error, t are the
three axes of the platform; where it is not known at all, two axes across f, since a rotation about f shows in nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.rows import REGRESSORS
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.dwell_columns import bending_of
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.noise_model import Noise

UNBOUNDED_RAD = 10.0
"""Prior sigma of a rotation in the engines that need a finite one: what it tells is 1e-8 of a reading or less."""


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


def nuisance_sigmas(noise: Noise) -> Floats:
    """Prior sigmas (q,) of the nuisance states: of the rotations, rad, and of the offsets, m/s^2; those that are zero
    are left out."""
    rotations = np.full(2, UNBOUNDED_RAD) if noise.attitude_unknown else np.full(3, noise.setting_rad)
    return np.concatenate([rotations[rotations > 0], noise.scatter_mps2[noise.scatter_mps2 > 0]])


def nuisance_map(dwells: Sequence[DwellFactor], noise: Noise, state: Floats) -> Floats:
    """The coefficients (D, 3, 4, q) of the nuisance states on the regressors 1, f_x, f_y, f_z, linearised at
    ``state``."""
    sensitivity = state[:STATE_COUNT].reshape(3, 4)[:, :3]
    axes = np.zeros((3, 0)) if not noise.setting_rad else np.eye(3)
    scattering = np.flatnonzero(noise.scatter_mps2 > 0)
    across = np.repeat(axes[None], len(dwells), axis=0)
    if noise.attitude_unknown:
        across = tangents(np.array([dwell.means[1:4] for dwell in dwells]))
    count = across.shape[2]
    out = np.zeros((len(dwells), 3, len(REGRESSORS), count + len(scattering)))
    for k, dwell in enumerate(dwells):
        for i, (x, y, z) in enumerate(sensitivity + bending_of(dwell)):
            out[k, i, 1:, :count] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ across[k]  # f^T [s] t
    out[:, scattering, 0, count + np.arange(len(scattering))] = 1.0
    return out
