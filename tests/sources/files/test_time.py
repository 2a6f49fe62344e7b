"""Stamps that were never filled, messages out of order, clocks that go back, and rows without a time."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import BENCH, START_NS, made_stream
from mcap.writer import Writer

from kf_calib.bench.streams import Stream
from kf_calib.sources.files import cdr
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.files.time_order import TimeOrder
from kf_calib.sources.opening import opened

G = 9.80665
READINGS = made_stream(2000, 10_000_000, 3)


def written(path: Path, stream: Stream, log_times: np.ndarray) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8_000)
        writer.start(profile="ros2")
        writer.add_metadata("kf_calib.bench", BENCH.to_metadata())
        schema = writer.register_schema(cdr.IMU.name, "ros2msg", cdr.IMU.schema.encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        packed = cdr.pack(cdr.IMU, cdr.imu_message("imu"), stream)
        for at_ns, data in zip(log_times.tolist(), packed, strict=True):
            writer.add_message(channel, log_time=at_ns, data=data, publish_time=at_ns)
        writer.finish()
    return path


def test_receipts_stand_for_stamps_that_nobody_has_filled(tmp_path: Path) -> None:
    stream = Stream(np.zeros(len(READINGS), np.int64), READINGS.values)
    recording = Recording(written(tmp_path / "zero.mcap", stream, READINGS.time_ns), angles=False)
    times = np.concatenate([batch.accel.time_ns for batch in recording])
    np.testing.assert_array_equal(times, READINGS.time_ns)
    assert any("its stamps (header.stamp) are all 0, so the times of receipt" in said for said in recording.warnings)


def test_a_stamp_of_zero_among_others_is_a_stamp(tmp_path: Path) -> None:
    stream = Stream(READINGS.time_ns - START_NS, READINGS.values)
    recording = Recording(written(tmp_path / "simulated.mcap", stream, READINGS.time_ns), angles=False)
    times = np.concatenate([batch.accel.time_ns for batch in recording])
    np.testing.assert_array_equal(times, stream.time_ns)
    assert not any("receipt" in said for said in recording.warnings)


def shuffled(count: int, reach: int) -> np.ndarray:
    """Numbers to count, none of them further than ``reach`` from its place."""
    return np.argsort(np.arange(count) + np.random.default_rng(4).uniform(0, reach, count), kind="stable")


def test_messages_out_of_order_are_sorted_and_told(tmp_path: Path) -> None:
    order = shuffled(len(READINGS), 40)
    path = written(tmp_path / "late.mcap", READINGS[order], READINGS.time_ns[order])
    recording = Recording(path, angles=False)
    batches = [batch.accel for batch in recording]
    np.testing.assert_array_equal(np.concatenate([each.time_ns for each in batches]), READINGS.time_ns)
    np.testing.assert_array_equal(np.concatenate([each.values for each in batches]), READINGS.values)
    assert any("came after later ones of their topic, and were sorted" in said for said in recording.warnings)


@pytest.mark.parametrize("size", [50, 100, 2000])
def test_order_is_made_with_little_memory(size: int) -> None:
    order, sorting, out = shuffled(len(READINGS), 40), TimeOrder(), list[int]()
    mixed = READINGS[np.concatenate([[0], order[order > 0]])]
    for k in range(0, len(mixed), size):
        out += sorting(mixed[k : k + size]).time_ns.tolist()
        assert k + size - len(out) < 350 or k + size > len(mixed)  # two seconds and what comes at once
    out += sorting.rest(3).time_ns.tolist()
    assert len(out) == len(READINGS)
    assert np.mean(np.diff(out) > 0) > 0.99


def test_a_clock_that_was_set_back_is_no_disorder() -> None:
    back = np.r_[0:800, 300:1500]
    sorting = TimeOrder()
    np.testing.assert_array_equal(sorting(READINGS[back]).time_ns, READINGS.time_ns[back])
    assert not sorting.late


def log(path: Path, stamps: list[str], header: str, delimiter: str = ";") -> Path:
    """Six faces and twelve edges, at 20 Hz."""
    rng = np.random.default_rng(2)
    faces = [sign * np.eye(3)[k] for k in range(3) for sign in (1, -1)]
    edges = [0.6 * a * np.eye(3)[k] + 0.8 * np.eye(3)[(k + 1) % 3] * b for k in range(3) for a in (1, -1)
             for b in (1, -1)]  # fmt: skip
    count = len(stamps) // 18
    values = np.repeat(G * np.array([*faces, *edges]), count, axis=0) + rng.normal(0, 1e-3, (18 * count, 3))
    rows = (delimiter.join([*([stamp] if stamp else []), *(f"{value:.5f}" for value in own)])
            for stamp, own in zip(stamps, values.tolist(), strict=False))  # fmt: skip
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    return path


def test_a_local_clock_that_goes_back_by_an_hour_goes_on(tmp_path: Path) -> None:
    begin = datetime(2026, 10, 25, 0, 58, 30, tzinfo=UTC)  # three minutes, summer time ends after half of it
    times = [begin + timedelta(seconds=0.05 * k) for k in range(3600)]
    turn = datetime(2026, 10, 25, 1, tzinfo=UTC)
    stamps = [f"{t + timedelta(hours=2 if t < turn else 1):%d.%m.%Y %H:%M:%S.%f}" for t in times]
    source = opened(log(tmp_path / "log.csv", stamps, "Zeit;ax;ay;az"), {"gravity_mps2": str(G)}, angles=False)
    read = np.concatenate([batch.accel.time_ns for batch in source])
    np.testing.assert_allclose(np.diff(read), 5e7, atol=2e3)
    assert any("its stamps go back by an hour" in said for said in source.warnings)


def test_rows_without_a_time_have_a_rate(run: Any, tmp_path: Path) -> None:
    path = log(tmp_path / "log.csv", [""] * 3600, "ax,ay,az", ",")
    code, out, err = run("replay", path, "--gravity", G, "--no-angles", "--rate", 20)
    assert code == 0 and "20 of them a second (--rate)" in out + err
    assert "--rate 100" in run.refused("replay", path, "--gravity", G, "--no-angles")


def refusal(run: Any, path: Path) -> str:
    err = run.refused("replay", path, "--gravity", G, "--no-angles")
    assert "no dwell was found" in err
    return err


def test_what_has_no_dwell_says_why(run: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    path = tmp_path / "log.csv"

    def write(times: np.ndarray, values: np.ndarray) -> Path:
        rows = (",".join([f"{t:.6f}", *(f"{v:.5f}" for v in own)]) for t, own in zip(times, values, strict=True))
        path.write_text("time_s,ax_mps2,ay_mps2,az_mps2\n" + "\n".join(rows) + "\n")
        return path

    rest = G * np.repeat([(0, 0, 1.0), (0, 1.0, 0), (1.0, 0, 0)], 1000, axis=0)
    times, noise = 0.01 * np.arange(3000), rng.normal(0, 1e-3, (3000, 3))
    moving = np.cumsum(rng.normal(0, 0.5, (3000, 3)), axis=0)
    assert "it never lay still" in refusal(run, write(times, moving))
    assert "jump back" in refusal(run, write(times % 0.5, rest + noise))
    apart = rest + noise + np.where(np.arange(3000) % 2, 4.0, -4.0)[:, None]
    assert "two sensors that take turns" in refusal(run, write(times, apart))
    assert "a thousand" in refusal(run, write(1e-3 * times, rest + noise))
