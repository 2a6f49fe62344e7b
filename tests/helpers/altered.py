"""A simulated run whose record is altered on its way: as a wrong cable, a wrong unit or a mistyped pose would."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Source, Stream
from kf_calib.sources.simulation.options import simulation
from kf_calib.sources.simulation.settings import SimulationOptions
from kf_calib.sources.simulation.simulator import START_NS, Simulation

Change = Callable[[Floats, Floats], Floats]
"""New values (n, k) of time since the start, s (n,), and values (n, k)."""


def short_run(keys: Mapping[str, str] | None = None, **options: Any) -> Simulation:
    """Twenty-four dwells of 4 s at 50 Hz, or as the options say."""
    usual = {"dwell_s": 4.0, "slew_degps": 90.0, "sample_hz": 50.0}
    return simulation(SimulationOptions.of(**usual | options), keys or {})


class Altered:
    """A source with other raw readings, other poses, or another bench than it was made with."""

    def __init__(
        self, source: Source, readings: Change | None = None, poses: Change | None = None, bench: Bench | None = None
    ) -> None:
        self.source, self.bench = source, bench or source.bench
        self.readings, self.poses = readings or _same, poses or _same
        self.warnings, self.fraction = list[str](), 0.0

    def __iter__(self) -> Iterator[Batch]:
        for batch in self.source:
            raw = Stream(batch.accel.time_ns, self.source.bench.input.raw(batch.accel.values))
            changed = _changed(raw, self.readings)
            accel = Stream(changed.time_ns, self.bench.input.readings(changed.values))
            yield Batch(accel, _changed(batch.pose, self.poses), batch.temperature)


def _same(_: Floats, values: Floats) -> Floats:
    return values


def _changed(stream: Stream, change: Change) -> Stream:
    return Stream(stream.time_ns, change((stream.time_ns - START_NS) * 1e-9, stream.values.copy()))


def mistyped(run: Simulation, number: int, gimbal: int, error_deg: float) -> Change:
    """Poses of dwell ``number`` (from 1) with one gimbal's angle off by so much."""
    begin, end = run.motion.arrive_ns[number - 1] * 1e-9 - 0.5, run.motion.leave_ns[number - 1] * 1e-9 + 0.3

    def change(time_s: Floats, angles_rad: Floats) -> Floats:
        angles_rad[(time_s > begin) & (time_s < end), gimbal] += np.radians(error_deg)
        return angles_rad

    return change
