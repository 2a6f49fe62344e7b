"""The means of the readings and of a model's columns over each dwell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import DwellFactor, alike


@dataclass(frozen=True, repr=False)
class Means:
    """Means over each of D dwells.

    - design (D, 3, p): the model's columns.
    - readings (D, 3), force_mps2 (D, 3): readings and specific force.
    - counts (D,): number of readings, each as many as its weight says.
    - ends_s (D, 2): when each dwell begins and ends.
    - bending (D, 3, 3): by how much effects change the readings per unit of force (``AttitudeError``).
    """

    design: Floats
    readings: Floats
    force_mps2: Floats
    counts: Floats
    ends_s: Floats
    bending: Floats = field(default_factory=lambda: np.zeros((1, 3, 3)))

    def __getitem__(self, part: int | list[int]) -> Means:
        known = {each.name: getattr(self, each.name) for each in fields(self)}
        if len(self.bending) != len(self.counts):
            del known["bending"]
        return Means(**{name: values[part] for name, values in known.items()})

    def sensitivities(self, state: Floats) -> Floats:
        """Change (D, 3, 3) of the mean readings per unit of force at ``state`` (p,), effects included."""
        return state[:STATE_COUNT].reshape(3, 4)[:, :3] + self.bending


def means_of(dwells: Sequence[DwellFactor], columns: Sequence[Floats]) -> Means:
    """The means of dwells with these columns."""
    design = np.zeros((len(dwells), *columns[0].shape[2:]))
    for places in alike(dwells):
        stacked, batch = np.array([columns[k] for k in places]), [dwells[k] for k in places]
        triangles, width = np.array([dwell.triangles for dwell in batch]), batch[0].width
        first = triangles[:, :, 0, :width] / triangles[:, :, :1, 0]  # means of the basis
        weights = np.array([dwell.counts / dwell.count for dwell in batch])
        coefficients = on_basis(stacked.reshape(*stacked.shape[:3], -1))
        design[places] = np.einsum("db,dbk,dbkc->dc", weights, first, coefficients).reshape(-1, *stacked.shape[3:])
    means = np.array([dwell.means for dwell in dwells])
    forces = np.array([dwell.felt_force(stacked[1:4]) for dwell, stacked in zip(dwells, means, strict=True)])
    counts = np.array([dwell.weight * dwell.count for dwell in dwells], float)
    ends = np.array([(dwell.start_s, dwell.end_s) for dwell in dwells])
    return Means(design, means[:, 4:], forces, counts, ends, np.array([bending_of(dwell) for dwell in dwells]))


def bending_of(dwell: DwellFactor) -> Floats:
    """By how much effects change the mean readings of a dwell per unit of force, (3, 3)."""
    known = None if dwell.attitude is None else dwell.attitude.bending
    return np.zeros((3, 3)) if known is None else known
