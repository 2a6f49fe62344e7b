"""Streams to record, and recordings read back whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kf_calib.bench import Bench, axes_of
from kf_calib.samples import Batch, Source, Stream
from kf_calib.sources.recorder import Recorder

START_NS = 1_750_000_000_123_456_789
BENCH = Bench(axes_of("yzx"), gravity_mps2=9.8153, latitude_deg=59.9, angle_sigma_deg=0.01, nominal={"theta1": 0.0})


def made_stream(count: int, step_ns: int, width: int, start_ns: int = START_NS) -> Stream:
    """Values that follow from the stamps, so that any part of the stream can be checked by itself."""
    time_ns = start_ns + step_ns * np.arange(count)
    return Stream(time_ns, values_at(time_ns, width))


def values_at(time_ns: np.ndarray, width: int) -> np.ndarray:
    return np.sin(((time_ns - START_NS) / 1e9)[:, None] * 977.0 + 5 * np.arange(width)) * 9.8


def made_batch(count: int, start_ns: int = START_NS, pose_width: int = 3) -> Batch:
    """``count`` readings at 100 Hz, a tenth as many poses, a twentieth as many temperatures."""
    return Batch(
        made_stream(count, 10_000_000, 3, start_ns),
        made_stream(count // 10, 100_000_000, pose_width, start_ns),
        made_stream(count // 20, 200_000_000, 1, start_ns),
    )


def record(path: Path, batch: Batch, bench: Bench = BENCH, **options: float) -> Path:
    with Recorder(path, bench, **options) as recorder:
        recorder.write(batch)
    return path


def read(source: Source) -> Batch:
    """All batches of a source in one."""
    whole = Batch(Stream.empty(3), Stream.empty(source.bench.pose_width))
    for batch in source:
        whole = Batch(whole.accel + batch.accel, whole.pose + batch.pose, whole.temperature + batch.temperature)
    return whole


def streams_of(batch: Batch) -> tuple[Stream, Stream, Stream]:
    return batch.accel, batch.pose, batch.temperature


def assert_equal(found: Batch, expected: Batch) -> None:
    for one, other in zip(streams_of(found), streams_of(expected), strict=True):
        assert np.array_equal(one.time_ns, other.time_ns)
        assert one.values.tobytes() == other.values.tobytes()


def count_missing(found: Batch, expected: Batch) -> int:
    """How many samples are lost, after making sure that those found are true, in order, and not doubled."""
    missing = 0
    for one, other in zip(streams_of(found), streams_of(expected), strict=True):
        at = np.searchsorted(other.time_ns, one.time_ns)
        assert np.all(np.diff(at) > 0) and (not len(at) or at[-1] < len(other))
        assert np.array_equal(other.time_ns[at], one.time_ns)
        assert other.values[at].tobytes() == one.values.tobytes()
        missing += len(other) - len(one)
    return missing
