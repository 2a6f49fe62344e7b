"""The rows of a table of orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Ints
from kf_calib.support.computed_sequence import ComputedSequence


@dataclass(frozen=True, slots=True)
class Orientation:
    """A dwell as a table has it: conditions and mean readings.

    - mean_mps2 (3,): mean readings of accelerometers 1, 2, 3.
    - pose (k,): gimbal angles, rad, or quaternion.
    - elapsed_s: time of its middle since the first row.
    - sigma_mps2 (3,): standard deviation of the readings about their mean; None where it is not known.
    - count: number of readings behind the mean; 1 where the standard deviation is not known.
    - temperature_c: NaN where it was not measured.
    """

    mean_mps2: Floats
    pose: Floats
    elapsed_s: float
    sigma_mps2: Floats | None
    count: int
    temperature_c: float


@dataclass(frozen=True, eq=False)
class Orientations(ComputedSequence[Orientation]):
    """The rows of a table, as columns: 100 000 objects would take ten times the memory.

    Fields are those of ``Orientation``, with a row each, its count in ``counts``; sigma_mps2 is None where no row has
    it, and NaN in a row that has none.
    """

    mean_mps2: Floats
    pose: Floats
    elapsed_s: Floats
    sigma_mps2: Floats | None
    counts: Ints
    temperature_c: Floats

    @classmethod
    def of(cls, rows: Sequence[Orientation]) -> Orientations:
        """Any rows as columns; columns as they are."""
        if isinstance(rows, Orientations):
            return rows
        sigmas = np.array([np.full(3, np.nan) if row.sigma_mps2 is None else row.sigma_mps2 for row in rows])
        return cls(
            np.array([row.mean_mps2 for row in rows]), np.array([row.pose for row in rows]),
            np.array([row.elapsed_s for row in rows]), None if np.isnan(sigmas).all() else sigmas,
            np.array([row.count for row in rows], np.int64), np.array([row.temperature_c for row in rows], float),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.elapsed_s)

    def item(self, k: int) -> Orientation:
        """The row at an index."""
        sigmas = np.full(3, np.nan) if self.sigma_mps2 is None else self.sigma_mps2[k]
        return Orientation(
            self.mean_mps2[k], self.pose[k], float(self.elapsed_s[k]), None if np.isnan(sigmas).any() else sigmas,
            int(self.counts[k]), float(self.temperature_c[k]),
        )  # fmt: skip
