"""Small rotations of a dwell, the change of the readings that they make, and what they leave.

A rotation about the axis t changes the reading of accelerometer i by t . (f x s_i), with s_i its sensitivity, to which
what effects add per unit of force belongs. One combination of the three readings is not changed by any: that along the
force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable


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


def along_force(dwells: Sequence[Dwell], sensitivities: Floats, some: NDArray[np.intp] | None = None) -> Floats:
    """The weights m (D, 3) of the three channels in the size of the force of each dwell: m = S^-T f / |f|.

    No rotation changes m . reading, which is |f| but for biases; sensitivities S are (D, 3, 3). some (d,): indices of
    the dwells of which alone it is wanted, and their sensitivities (d, 3, 3).
    """
    force = DwellTable.of(dwells).felt_means_mps2
    force = force if some is None else force[some]
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    return np.asarray(np.linalg.solve(np.swapaxes(sensitivities, 1, 2), unit[:, :, None])[:, :, 0], float)


def sensitivities_of(dwells: Sequence[Dwell], state: Floats, some: NDArray[np.intp] | None = None) -> Floats:
    """Change (D, 3, 3) of the readings of each dwell per unit of force at ``state`` (p,), effects included.

    some (d,): indices of the dwells of which alone it is wanted.
    """
    bendings = DwellTable.of(dwells).bendings
    return state[:STATE_COUNT].reshape(3, 4)[:, :3] + (bendings if some is None else bendings[some])
