"""The data that a bench delivers: streams of stamped values, and the sources that provide them.

Stamps are integers in nanoseconds (``time_ns``). Readings are specific force in m/s^2, +g if the sensitive axis points
up. Gimbal angles are in rad, outer axis first. A *pose* consists of the gimbal angles (k columns) or, if the bench has
no gimbal axes, of the attitude quaternion from platform to bench (x, y, z, w).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
from kf_calib.bench.arrays import Floats, Times


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
