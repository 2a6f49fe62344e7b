"""Damaged recordings: a result with a warning, or one clear sentence; never a silently wrong number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run

from kf_calib.bench.streams import Stream
from kf_calib.errors import KfCalibError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording

RUN = Run(seed=1, dwells=14, count=100, batch=100)
PAGE = 512  # bytes that a disk loses or mixes up at once


@pytest.fixture(scope="module", params=["finished", "killed"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with a chunk a dwell; of one that was killed, what was on the disk before its end was written."""
    path = tmp_path_factory.mktemp("damage") / "whole.mcap"
    with Recorder(path, RUN.bench) as recorder:
        for batch in RUN:
            recorder.write(batch)
            recorder.end_dwell()
        killed = path.read_bytes()
    if request.param == "killed":
        path.write_bytes(killed)
    return path


def outcome(path: Path) -> Calibration | str:
    """What is made of a file, or the sentence by which it is refused; each sample in it is one that was recorded."""
    try:
        for batch in Recording(path):
            assert_recorded(batch.accel, RUN.accel)
            assert_recorded(batch.pose, RUN.pose)
        return calibrate(Recording(path))
    except KfCalibError as error:
        assert "\n" not in str(error)
        return str(error)


def assert_recorded(found: Stream, recorded: Stream) -> None:
    at = np.searchsorted(recorded.time_ns, found.time_ns)
    np.testing.assert_array_equal(recorded.time_ns[np.minimum(at, len(recorded) - 1)], found.time_ns)
    np.testing.assert_array_equal(recorded.values[at], found.values)


def damaged(content: bytes, rng: np.random.Generator, how: str) -> bytes:
    place = int(rng.integers(len(content)))
    match how:
        case "truncated":
            return content[:place]
        case "flipped":
            return content[:place] + bytes([content[place] ^ (1 << int(rng.integers(8)))]) + content[place + 1 :]
        case "cut out":
            return content[:place] + content[place + int(rng.integers(1, 4 * PAGE)) :]
        case _:
            one, other = sorted(PAGE * rng.choice(len(content) // PAGE, 2, replace=False))
            pages = content[other : other + PAGE], content[one + PAGE : other], content[one : one + PAGE]
            return b"".join([content[:one], *pages, content[other + PAGE :]])


@pytest.mark.parametrize("trials", [4, *slow(750)])
@pytest.mark.parametrize("how", ["truncated", "flipped", "cut out", "pages exchanged"])
def test_damage_is_told_or_harmless(whole: Path, tmp_path: Path, how: str, trials: int) -> None:
    expected, content, rng = outcome(whole), whole.read_bytes(), np.random.default_rng(5)
    assert isinstance(expected, Calibration)
    told = 0
    for trial in range(trials):
        path = tmp_path / f"{trial}.mcap"
        path.write_bytes(damaged(content, rng, how))
        got = outcome(path)
        if isinstance(got, str):
            told += 1
        elif len(got.warnings) > len(expected.warnings):
            told += 1
            error = np.abs(got.estimate.parameters - expected.estimate.parameters) / got.estimate.sigma
            assert np.nanmax(error, initial=0.0) < 6, got.warnings
        elif how != "truncated" or not expected.warnings:  # where a killed file ends is told as before
            np.testing.assert_array_equal(got.estimate.state, expected.estimate.state)
            assert got.counts.used == expected.counts.used
        path.unlink()
    assert told >= trials / 2
