"""Real recordings of boards in the hand, with their nine parameters by scipy.

No number comes from kf_calib but when the body stood still.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

import kf_calib
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Source, with_accel

GRAVITY_MPS2 = 9.80665
FEWEST_POSES = 18  # for an injection beside nine parameters
_STEP = 1e-6  # of the parameters, for differences
_ARRAY_COUNT_MPS2 = "0.0047884033203125"  # of the boards of the MIMU4444 array, which are recorded in counts


@dataclass
class Altered:
    """A recording with other readings; a source of kf_calib."""

    bench: Bench
    batches: list[Batch]
    warnings: list[str] = field(default_factory=list[str])
    fraction: float = 1.0

    def __iter__(self) -> Iterator[Batch]:
        return iter(self.batches)


@dataclass(frozen=True)
class RealRecording:
    """A recording at a path, read whole."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name.partition(".")[0]

    @cached_property
    def _source(self) -> Source:
        keys = {"gravity_mps2": str(GRAVITY_MPS2)}
        if self.path.suffix == ".mcap":
            return kf_calib.open_recording(self.path, keys, angles=False)
        if self.name.startswith("array_"):
            keys["accel_scale"] = _ARRAY_COUNT_MPS2
        return kf_calib.open_log(self.path, keys, angles=False)

    @cached_property
    def batches(self) -> list[Batch]:
        return list(self._source)

    @cached_property
    def time_s(self) -> Floats:
        """Times (n,) of the readings from the first."""
        time_ns = np.concatenate([batch.accel.time_ns for batch in self.batches])
        return (time_ns - time_ns[0]) / 1e9

    @cached_property
    def readings_mps2(self) -> Floats:
        return np.concatenate([batch.accel.values for batch in self.batches])

    @cached_property
    def _poses(self) -> Floats:
        dwells = kf_calib.calibrate(self.altered(np.zeros(3))).fit.dwells
        arrivals = [nodes.elapsed_s[0] - nodes.since_arrival_s[0] for nodes in (dwell.pieces.nodes for dwell in dwells)]
        return np.array([(at, dwell.start_s, dwell.end_s) for at, dwell in zip(arrivals, dwells, strict=True)])

    @property
    def dwells_s(self) -> Floats:
        """Begin and end (D, 2) of what is used of the poses."""
        return self._poses[:, 1:]

    @property
    def arrivals_s(self) -> Floats:
        """When the body came to rest in the poses, (D,)."""
        return self._poses[:, 0]

    def altered(self, added_mps2: Floats) -> Altered:
        """The recording with something added to its readings, (n, 3) or (3,)."""
        added = np.broadcast_to(added_mps2, self.readings_mps2.shape)
        cuts = np.cumsum([len(batch.accel) for batch in self.batches])[:-1]
        parts = zip(self.batches, np.split(added, cuts), strict=True)
        return Altered(self._source.bench, [with_accel(batch, batch.accel.values + part) for batch, part in parts])

    def means(self, values: Floats) -> Floats:
        """Means (D, ...) over the poses of what is known at each reading, (n, ...)."""
        pairs = ((self.time_s >= start) & (self.time_s <= end) for start, end in self.dwells_s)
        return np.array([values[inside].mean(axis=0) for inside in pairs])

    @cached_property
    def nine(self) -> Floats:
        """The nine parameters: the upper triangle of the inverse sensitivities by rows, and the biases."""
        means = self.means(self.readings_mps2)
        start = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        return least_squares(lambda nine: _sizes(means, nine) - GRAVITY_MPS2, start, x_scale="jac").x

    @cached_property
    def force_mps2(self) -> Floats:
        """Specific force (n, 3) at each reading."""
        return _force(self.readings_mps2, self.nine)

    @cached_property
    def scatter_mps2(self) -> float:
        """What |f| of the poses scatters by about g beside the nine parameters."""
        left = _sizes(self.means(self.readings_mps2), self.nine) - GRAVITY_MPS2
        return float(np.sqrt(np.sum(left**2) / (len(left) - 9)))

    @cached_property
    def left(self) -> Floats:
        """What the nine parameters leave of |f| of the poses as they were recorded, over the scatter, (D,)."""
        return (_sizes(self.means(self.readings_mps2), self.nine) - GRAVITY_MPS2) / self.scatter_mps2

    def seen(self, added_mps2: Floats) -> Floats:
        """What a change of the readings, (n, 3), changes of |f| in each pose (D,) that the nine parameters do not
        take, over the scatter: its norm is the size of the change in sigmas."""
        means = self.means(self.readings_mps2)
        columns = np.array([
            (_sizes(means, self.nine + step) - _sizes(means, self.nine - step)) / (2.0 * _STEP)
            for step in _STEP * np.eye(9)
        ]).T  # fmt: skip
        change = _sizes(means + self.means(added_mps2), self.nine) - _sizes(means, self.nine)
        basis = np.linalg.qr(columns)[0]
        return (change - basis @ (basis.T @ change)) / self.scatter_mps2


def _force(readings_mps2: Floats, nine: Floats) -> Floats:
    inverse = np.zeros((3, 3))
    inverse[np.triu_indices(3)] = nine[:6]
    return (readings_mps2 - nine[6:]) @ inverse.T


def _sizes(readings_mps2: Floats, nine: Floats) -> Floats:
    return np.linalg.norm(_force(readings_mps2, nine), axis=1)
