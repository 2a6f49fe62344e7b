"""The data that a bench delivers: streams of stamped values, and the sources that provide them.

Stamps are integers in nanoseconds (``time_ns``). Readings are specific force in m/s^2, +g if the sensitive axis points
up. Gimbal angles are in rad, outer axis first. A *pose* consists of the gimbal angles (k columns) or, if the bench has
no gimbal axes, of the attitude quaternion from platform to bench (x, y, z, w).

A table of orientations is a source, too: of its dwells only the mean readings are known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import ComputedSequence, Floats, Ints, Times
from kf_calib.bench.bench import Bench
from kf_calib.errors import BenchError, InputError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

SECOND_NS = 1_000_000_000
LEAP_NS = 10 * SECOND_NS  # a stamp this far ahead is a pause or damaged: those after it tell which
LAST_NS = int(np.iinfo(np.int64).max) // 2  # later than any stamp; the sum of two such is one
MOST_KEPT = 1 << 22  # readings that are kept in memory, at most; 32 B each


@dataclass(frozen=True, slots=True)
class Stream:
    """Stamped values of one quantity: ``time_ns`` (n,), ``values`` (n, k)."""

    time_ns: Times
    values: Floats

    @classmethod
    def empty(cls, width: int) -> Stream:
        """A stream without samples."""
        return cls(np.empty(0, np.int64), np.empty((0, width)))

    @classmethod
    def joined(cls, streams: Sequence[Stream]) -> Stream:
        """The concatenation of at least one stream."""
        if len(streams) == 1:
            return streams[0]
        times, values = zip(*((each.time_ns, each.values) for each in streams), strict=True)
        return cls(np.concatenate(times), np.concatenate(values))

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, part: slice | NDArray[np.bool_]) -> Stream:
        return Stream(self.time_ns[part], self.values[part])

    def __add__(self, later: Stream) -> Stream:
        if not len(self):
            return later
        if not len(later):
            return self
        return Stream(np.concatenate([self.time_ns, later.time_ns]), np.concatenate([self.values, later.values]))


@dataclass(frozen=True, slots=True)
class Batch:
    """A stretch of the raw streams as they arrived, each with its own stamps; any of them may be empty."""

    accel: Stream  # readings (n, 3) of accelerometers 1, 2, 3, m/s^2
    pose: Stream  # (m, k) rad, or (m, 4) quaternion x y z w
    temperature: Stream = field(default_factory=lambda: Stream.empty(1))  # (l, 1) degC


def with_accel(batch: Batch, readings_mps2: Floats) -> Batch:
    """The batch with other readings (n, 3) at the same times."""
    return Batch(Stream(batch.accel.time_ns, readings_mps2), batch.pose, batch.temperature)


class Source(Protocol):
    """A source of batches: a recording, a live bench or the simulator.

    ``warnings`` grows while the source is read, and tells what was lost or not understood. ``fraction`` is the share
    that has been read, 0 to 1 (NaN if the end is not known). A recording can be iterated again from its start.
    """

    @property
    def bench(self) -> Bench: ...

    @property
    def warnings(self) -> list[str]: ...

    @property
    def fraction(self) -> float: ...

    def __iter__(self) -> Iterator[Batch]: ...


_SQUARE = {"theta1": 0.0, "theta3": 0.0}


_NO_ORIENTATIONS = (
    "nothing in it tells orientations, so only the size of gravity counts, as with --no-angles: nine parameters."
)


def bench_without_angles(
    name: str, metadata: Mapping[str, Any], *, are_lacking: bool = False
) -> tuple[Bench, list[str]]:
    """The bench by the keys that are stated, and what to know of it; gravity is the standard one where none is stated.

    name: of the source. are_lacking: whether it has no angles, though nobody said that it need not. Raises BenchError
    for a key that cannot be.
    """
    gravity = {} if "latitude_deg" in metadata else {"gravity_mps2": STANDARD_GRAVITY_MPS2}
    try:
        bench = Bench.from_metadata({**gravity, **metadata}, has_angles=False)
    except BenchError as error:
        raise BenchError(f"{name}: {error}") from error
    remarks = [f"{name}: {_NO_ORIENTATIONS}"] if are_lacking else []
    if bench.gravity_mps2 == STANDARD_GRAVITY_MPS2:  # as also a recording made by it states
        remarks.append(
            f"gravity is taken as the standard {STANDARD_GRAVITY_MPS2} m/s^2; the local value differs by up to "
            "0.3 %, and every scale factor with it: state it by --gravity or --latitude."
        )
    square = _SQUARE | dict(bench.nominal)
    return replace(bench, angles=False, reference="base", angle_sigma_deg=None, nominal=square), remarks


def without_poses(batch: Batch) -> Batch:
    """The batch with its readings and temperatures only."""
    return Batch(batch.accel, Stream.empty(4), batch.temperature)


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


class Table:
    """Mean readings of dwells, with the bench they were taken on.

    name: what messages call it. warnings: how it was understood. start_ns: stamp of the first row, if it has a date.
    path: the file that it is from, if it is from one.
    """

    def __init__(
        self,
        name: str,
        bench: Bench,
        orientations: Sequence[Orientation],
        warnings: Sequence[str] = (),
        start_ns: int | None = None,
        path: Path | None = None,
    ) -> None:
        self.name, self.bench, self.orientations = name, bench, Orientations.of(orientations)
        self.warnings, self.fraction, self._start_ns, self.path = list(warnings), 1.0, start_ns, path

    def __repr__(self) -> str:
        return f"<Table {self.name}: {len(self.orientations)} orientations, {self.bench.input}>"

    def begin_ns(self) -> int | None:
        """Stamp of the first row; None where the table has no date."""
        return self._start_ns

    def __iter__(self) -> Iterator[Batch]:
        self.refuse("this")
        yield from ()

    def refuse(self, what: str) -> None:
        """Raise InputError for what means do not show."""
        raise InputError(
            f"{self.name} is a table of mean readings, and {what} needs the readings themselves: evaluate a recording "
            "of the run (docs/own_csv.md)."
        )
