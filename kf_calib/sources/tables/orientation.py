"""The rows of a table of orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

from kf_calib.bench.arrays import Floats, Ints


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
class Orientations(Sequence[Orientation]):
    """The rows of a table, as columns: 100 000 objects would take ten times the memory.

    Fields are those of ``Orientation``, with a row each, its count in ``counts``; sigma_mps2 is None where no row has
    it.
    """

    mean_mps2: Floats
    pose: Floats
    elapsed_s: Floats
    sigma_mps2: Floats | None
    counts: Ints
    temperature_c: Floats

    def __len__(self) -> int:
        return len(self.elapsed_s)

    @overload
    def __getitem__(self, index: int) -> Orientation: ...
    @overload
    def __getitem__(self, index: slice) -> list[Orientation]: ...
    def __getitem__(self, index: int | slice) -> Orientation | list[Orientation]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        k = range(len(self))[index]
        return Orientation(
            self.mean_mps2[k], self.pose[k], float(self.elapsed_s[k]),
            None if self.sigma_mps2 is None else self.sigma_mps2[k], int(self.counts[k]), float(self.temperature_c[k]),
        )  # fmt: skip
