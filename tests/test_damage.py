"""Damaged recordings: a result with a warning, or one clear sentence; never a silently wrong number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from long_runs import slow
from synthetic import Run

from kf_calib.calibration import Calibration, calibrate
from kf_calib.errors import KfCalibError
from kf_calib.samples import Batch
from kf_calib.sources.recorder import Recorder
from kf_calib.sources.recording import Recording


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("damage") / "whole.mcap"
    run = Run(seed=1, dwells=14, count=100, batch=100)
    with Recorder(path, run.bench) as recorder:
        for batch in run:
            recorder.write(batch)
            recorder.end_dwell()  # a chunk a dwell
            assert isinstance(batch, Batch)
    return path


def outcome(path: Path) -> Calibration | str:
    try:
        return calibrate(Recording(path))
    except KfCalibError as error:
        assert "\n" not in str(error)
        return str(error)


def damaged(content: bytes, rng: np.random.Generator, how: str) -> bytes:
    place = int(rng.integers(len(content)))
    if how == "truncated":
        return content[:place]
    return content[:place] + bytes([content[place] ^ (1 << int(rng.integers(8)))]) + content[place + 1 :]


@pytest.mark.parametrize("trials", [20, *slow(1000)])
@pytest.mark.parametrize("how", ["truncated", "flipped"])
def test_damage_is_told_or_harmless(whole: Path, tmp_path: Path, how: str, trials: int) -> None:
    expected, content, rng = outcome(whole), whole.read_bytes(), np.random.default_rng(5)
    assert isinstance(expected, Calibration) and not expected.warnings
    told = 0
    for trial in range(trials):
        path = tmp_path / f"{trial}.mcap"
        path.write_bytes(damaged(content, rng, how))
        got = outcome(path)
        if isinstance(got, str):
            told += 1
        elif got.warnings:
            told += 1
            error = np.abs(got.estimate.parameters - expected.estimate.parameters) / got.estimate.sigma
            assert np.nanmax(error, initial=0.0) < 6, got.warnings
        else:
            np.testing.assert_array_equal(got.estimate.state, expected.estimate.state)
            assert got.tally.used == expected.tally.used
    assert told > trials / 2
