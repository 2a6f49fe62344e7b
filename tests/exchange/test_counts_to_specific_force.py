"""From int32 counts on a link to specific force: what the device sends is stated once. The truth is made here.

Accelerometers 1, 2, 3 are wired to channels 3, 2 reversed, and 1. A count is 3.9 ug (of standard gravity).
"""

import json
import re
import socket
import threading
from contextlib import chdir
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner
from exchange.test_raw_input import forces_in_csv
from exports.test_c_header import compiled, compiled_only
from helpers import sent_frames
from helpers.long_runs import slow

from kf_calib.cli import cli
from kf_calib.sources.live import frames

GRAVITY_MPS2, COUNT_MPS2, NOISE_MPS2 = 9.8123, 3.9e-6 * 9.80665, 2e-4
SENSITIVITY = np.array([[1.0031, 0.0021, -0.0008], [0.0004, 0.9968, 0.0012], [-0.0017, 0.0006, 1.0005]])
BIAS_MPS2 = np.array([0.031, -0.042, 0.018])
STATED = {"channels": "3,-2,1", "accel_scale": 3.9e-6, "accel_unit": "g"}
BENCH = {"axes": "y z x", "gravity_mps2": GRAVITY_MPS2, "angle_sigma_deg": 0.0}
AT_REST, RATE_HZ = 150, 50.0


def counts_of(force: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
    """What the device sends, (n, 3) int32: channel 1 is accelerometer 3, channel 2 minus accelerometer 2, channel 3
    accelerometer 1."""
    readings = force @ SENSITIVITY.T + BIAS_MPS2
    if rng is not None:
        readings = readings + rng.normal(0.0, NOISE_MPS2, readings.shape)
    return np.rint(np.column_stack([readings[:, 2], -readings[:, 1], readings[:, 0]]) / COUNT_MPS2).astype(np.int32)


class Run(NamedTuple):
    """A run on the bench: stamps (n,), counts (n, 3), angles (n, 3), and the standard error of corrected readings that
    least squares of all of its readings would have, at most over directions of gravity, along each axis (3,)."""

    time_ns: np.ndarray
    counts: np.ndarray
    angles_deg: np.ndarray
    least_sigma_mps2: np.ndarray


def made_run(seed: int) -> Run:
    """24 orientations of gimbals z and x, y up: turned by m about z, then by i about x of the platform."""
    turns = np.array([(0.0, m, i) for i in range(0, 360, 90) for m in (0, 50, 90, 140, 180, 270)])
    m, i = np.radians(turns[:, 1:]).T
    about_z = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in m])
    about_x = np.array([[[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]] for a in i])
    turned = about_z @ about_x  # from the platform to the bench
    force = GRAVITY_MPS2 * turned.transpose(0, 2, 1) @ np.array([0.0, 1.0, 0.0])
    counts = counts_of(np.repeat(force, AT_REST, axis=0), np.random.default_rng(seed))
    dwell, sample = np.divmod(np.arange(len(counts)), AT_REST)
    time_ns = ((dwell * (AT_REST / RATE_HZ + 1.0) + sample / RATE_HZ) * 1e9).round().astype(np.int64)

    columns = np.column_stack([force, np.ones(len(force))])
    inverse = np.linalg.inv(AT_REST * columns.T @ columns)
    anywhere = np.random.default_rng(0).normal(size=(5000, 3))
    there = np.column_stack([GRAVITY_MPS2 * anywhere / np.linalg.norm(anywhere, axis=1)[:, None], np.ones(5000)])
    worst = np.sqrt(np.einsum("ni,ij,nj->n", there, inverse, there).max())
    noise_mps2 = np.hypot(NOISE_MPS2, COUNT_MPS2 / np.sqrt(12.0))
    return Run(time_ns, counts, np.repeat(turns, AT_REST, axis=0), np.full(3, worst * noise_mps2))


def as_csv(run: Run) -> bytes:
    rows = (
        f"{time_ns},{','.join(map(str, counts))},{','.join(map(str, angles))}\n"
        for time_ns, counts, angles in zip(*(part.tolist() for part in run[:3]), strict=True)
    )
    return "".join(["time_ns,ax,ay,az,outer_deg,middle_deg,inner_deg\n", *rows]).encode()


def as_json_lines(run: Run) -> bytes:
    return b"".join(
        json.dumps({"time_ns": time_ns, "accel_counts": counts, "angles_deg": angles}).encode() + b"\n"
        for time_ns, counts, angles in zip(*(part.tolist() for part in run[:3]), strict=True)
    )


def as_frames(run: Run) -> bytes:
    """With a first frame that says what the bench is and what the device sends."""
    sent = [sent_frames.bench({key: str(value) for key, value in {**BENCH, **STATED}.items()})]
    for number, (time_ns, counts, angles) in enumerate(zip(*(part.tolist() for part in run[:3]), strict=True)):
        sent.append(sent_frames.sample(frames.ANGLES, number, time_ns, np.radians(angles).tolist()))
        sent.append(sent_frames.sample(frames.ACCEL, number, time_ns, counts))
    return b"".join(sent)


def served(content: bytes) -> str:
    """The address of a server that sends this to whoever comes first."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with listening, listening.accept()[0] as client:
            client.sendall(content)

    threading.Thread(target=serve, daemon=True).start()
    return f"socket://127.0.0.1:{listening.getsockname()[1]}?give_up=0.1"


def called(folder: Path, *words: str, given: bytes | None = None) -> str:
    """What the program prints in that folder, in this process: many starts take long."""
    with chdir(folder):
        done = CliRunner(env={"COLUMNS": "200"}).invoke(cli, words, input=given)
    assert done.exit_code == 0, f"{words}: {done.output} {done.exception}"
    return done.stdout


def recorded_by_options(folder: Path, run: Run) -> None:
    """``record`` of lines of CSV in a pipe; options say all."""
    said = {key.replace("_mps2", "").replace("_deg", "").replace("_", "-"): str(value)
            for key, value in {**BENCH, **STATED}.items()}  # fmt: skip
    options = [word for key, value in said.items() for word in (f"--{key}", value)]
    called(folder, "record", "run.mcap", "-", *options, given=as_csv(run))


def live_by_the_bench_file(folder: Path, run: Run) -> None:
    """``live`` of JSON lines on TCP; the bench file says all."""
    (folder / "bench.toml").write_text("".join(f"{key} = {value!r}\n" for key, value in {**BENCH, **STATED}.items()))
    called(folder, "live", served(as_json_lines(run)), "--bench", "bench.toml", "--record", "run.mcap", "--json")


def live_by_the_stream(folder: Path, run: Run) -> None:
    """``live`` of binary frames on TCP; the first of them says all."""
    called(folder, "live", served(as_frames(run)), "--record", "run.mcap", "--json")


@compiled_only
@pytest.mark.parametrize("acquired", [recorded_by_options, *slow(live_by_the_stream, live_by_the_bench_file)])
def test_counts_become_specific_force_with_what_they_are_stated_once(acquired, tmp_path: Path) -> None:
    run = made_run(seed=11)
    acquired(tmp_path, run)
    fit = json.loads(called(tmp_path, "replay", "run.mcap", "--save", "cal.json", "--json"))
    assert fit["dwells"] == 24 and fit["consistency"]["consistent"]
    values = {each["symbol"]: each["value"] for each in fit["parameters"]}
    assert [values[f"K{i}"] for i in (1, 2, 3)] == pytest.approx(np.linalg.norm(SENSITIVITY, axis=1), abs=1e-5)

    rng = np.random.default_rng(12)
    direction = rng.normal(size=(400, 3))
    force = GRAVITY_MPS2 * direction / np.linalg.norm(direction, axis=1)[:, None]
    counts = counts_of(force)
    lines = "".join(f"{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(counts.tolist()))
    (tmp_path / "later.csv").write_text("time_s,ax,ay,az\n" + lines)
    corrected = called(tmp_path, "apply", "cal.json", "-", given=(tmp_path / "later.csv").read_bytes())
    error = forces_in_csv(corrected) - force

    said = called(tmp_path, "apply", "cal.json", "later.csv", "-o", "corrected.csv")
    stated = re.search(r"at 1 g\): (\S+), (\S+), (\S+) µg along x, y, z", said)
    assert stated is not None and (tmp_path / "corrected.csv").read_text() == corrected
    sigma_mps2 = 9.80665e-6 * np.array([float(each) for each in stated.groups()])
    share = sigma_mps2 / run.least_sigma_mps2
    assert ((share > 0.95) & (share < 1.6)).all()  # readings that settle or move, about half of them, are left out
    allowed = 4.0 * sigma_mps2 + 0.51 * COUNT_MPS2 * np.abs(np.linalg.inv(SENSITIVITY)).sum(axis=1)
    assert (np.abs(error) < allowed).all()
    rms = np.sqrt((error**2).mean(axis=0))
    assert (rms > 0.9 * COUNT_MPS2 / np.sqrt(12.0)).all()  # no better than its counts: nothing else told it the truth

    called(tmp_path, "export", "cal.json", "--to", "c", "-o", "correct.h")
    in_c = compiled((tmp_path / "correct.h").read_text(), tmp_path)(counts, np.full(len(counts), np.nan))
    np.testing.assert_allclose(in_c, forces_in_csv(corrected), rtol=0, atol=1e-11)
    assert (np.abs(in_c - force) < allowed).all()
