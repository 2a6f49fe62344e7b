"""The simulator in real time, or faster."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, bench_without_angles, without_poses
from kf_calib.sources.live.feed import Feed, nothing
from kf_calib.sources.simulation.simulator import Simulation

BATCH_S = 0.01
"""How much of the time on the wall one batch of a simulated bench holds."""

_NAP_S = 0.1


class SimulatedFeed(Feed):
    """A simulated run at ``speed`` times real time (infinity: as fast as it can be made).

    angles: False for its readings only.
    """

    patient = True

    def __init__(self, run: Simulation, speed: float, angles: bool = True) -> None:
        super().__init__("the simulated bench")
        self._run, self._speed, self._angles = run, speed, angles
        self._bench = run.bench if angles else bench_without_angles(self.name, run.bench.to_metadata())[0]

    def begin(self) -> Bench:
        self.link = "live"
        return self._bench

    def __iter__(self) -> Iterator[Batch]:
        started_s, first_ns = time.monotonic(), None
        for batch in self._run:
            last_ns = int(batch.accel.time_ns[-1])
            first_ns = int(batch.accel.time_ns[0]) if first_ns is None else first_ns
            due_s = started_s + (last_ns - first_ns) * 1e-9 / self._speed
            while not self.stopping and (left_s := due_s - time.monotonic()) > 0.0:
                time.sleep(min(left_s, _NAP_S))
                if left_s > _NAP_S:
                    yield nothing(self._bench.pose_width)
            if self.stopping:
                return
            self.fraction = self._run.fraction
            yield batch if self._angles else without_poses(batch)
        self.fraction = 1.0


def batch_samples(sample_hz: float, speed: float) -> int:
    """Readings of a batch at that speed."""
    return max(1, round(sample_hz * speed * BATCH_S)) if math.isfinite(speed) else 65536
