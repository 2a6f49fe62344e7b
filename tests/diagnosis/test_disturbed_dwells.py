"""One dwell of 27 that something disturbed: it is told, and changes neither the noise of the others nor the verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from helpers.long_runs import slow
from unknown_trials.small_bench import RATE_HZ, WHITE_MPS2, SmallRun, visits

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.estimation.calibration import calibrate
from kf_calib.views.diagnosis import disturbed_dwells, verdict

DWELLS, READINGS, DISTURBED = 27, 240, 10

COURSES: dict[str, Callable[[Floats], Floats]] = {
    "swing of 11 s": lambda u: np.sin(2.0 * np.pi * 0.09 * READINGS / RATE_HZ * u + 1.0),
    "swing of 1.4 s": lambda u: np.sin(2.0 * np.pi * 0.7 * READINGS / RATE_HZ * u),
    "slip": lambda u: 1.0 * (u >= 0.5),
    "late slip": lambda u: 1.0 * (u >= 0.8),
    "creep": lambda u: u,
    "decay": lambda u: np.exp(-4.0 * u),
    "knock": lambda u: np.exp(-(((u - 0.5) / 0.05) ** 2)),
}

FEW = ("swing of 11 s", "late slip")


def disturbed(course: str, size_mps2: float, seed: int) -> SmallRun:
    """A run in which one dwell has this course beside its level, in each accelerometer by another amount."""
    at = visits(seed, DWELLS)
    hidden = np.zeros((DWELLS, READINGS, 3))
    shape = COURSES[course](np.arange(READINGS) / READINGS)
    hidden[DISTURBED - 1] = size_mps2 * shape[:, None] * np.array([1.0, 0.5, -0.3])
    return SmallRun(at, hidden, seed)


@pytest.mark.parametrize("size_mps2", [3e-3, *slow(3e-4)])
@pytest.mark.parametrize("course", [*FEW, *slow(*(name for name in COURSES if name not in FEW))])
def test_a_disturbed_dwell_is_named_and_nothing_else(course: str, size_mps2: float) -> None:
    """It was a vibration, a warm-up or a walk with 95 % and more, or inflated the noise tenfold and agreed."""
    diagnosis = diagnose(disturbed(course, size_mps2, 3))
    assert diagnosis.missing == () and not diagnosis.noise
    if diagnosis.consistent is False or size_mps2 > 1e-3:
        assert disturbed_dwells(diagnosis) == [DISTURBED]
        assert f"dwell {DISTURBED}" in verdict(diagnosis)


@pytest.mark.parametrize("course", [*COURSES])
def test_the_noise_of_the_others_is_as_without_it(course: str) -> None:
    noise = calibrate(disturbed(course, 3e-3, 4)).noise
    assert noise.inflation.max() < 1.3
    np.testing.assert_allclose(noise.sigma_mps2, WHITE_MPS2, rtol=0.1)


def test_a_run_has_one_p_where_its_readings_change_within_a_dwell() -> None:
    """The means agree with p = 0.01 by their misfit: replay said so beside a diagnosis of p < 1e-300."""
    run = calibrate(disturbed("swing of 11 s", 3e-4, 3))
    assert run.consistency.consistent is False
    assert run.consistency.p_value == diagnose(run).test.p_value
    assert any(f"most in dwell {DISTURBED}, accelerometer 1" in remark for remark in run.warnings)
    quiet = calibrate(replace(disturbed("swing of 11 s", 3e-4, 3), hidden_mps2=np.zeros((DWELLS, READINGS, 3))))
    assert quiet.consistency.consistent and quiet.consistency.trend is None


def test_the_parameters_are_as_without_it() -> None:
    run = disturbed("swing of 1.4 s", 3e-3, 5)
    quiet = calibrate(replace(run, hidden_mps2=np.zeros_like(run.hidden_mps2)))
    errors = calibrate(run).estimate.parameters - quiet.estimate.parameters
    assert (np.abs(errors) < 2.0 * quiet.estimate.sigma).all()


@pytest.mark.parametrize("seed", [1, *slow(2, 3, 4)])
def test_a_swing_of_all_dwells_is_one_of_the_run(seed: int) -> None:
    """It is looked for as before: the loudest dwell alone does not decide."""
    at = visits(seed, DWELLS)
    time_s = at.time_s[:, :, None]
    swing = 3e-5 * np.sin(2.0 * np.pi * 0.7 * time_s + np.array([0.0, 1.0, 2.0]))
    assert diagnose(SmallRun(at, swing, seed)).missing == ("sinusoid",)
