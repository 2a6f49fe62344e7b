"""Intervals of 95 %: they hold the truth as often as they say, whatever was stated of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.stats import norm, t

from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.intervals import _averaged, _student

WHITE, COUNT = 5e-5, 100
OF_A_MEAN = WHITE / np.sqrt(COUNT)


def held(dwells: int, runs: int, seed: int, **noise: float) -> tuple[float, float]:
    """Shares of the twelve in their intervals, and within 1.96 sigma, in runs on a bench that states nothing."""
    inside = np.zeros(2)
    for k in range(runs):
        run = Run(seed=seed + k, dwells=dwells, count=COUNT, white_mps2=WHITE, **noise)
        run.bench = replace(run.bench, angle_sigma_deg=None, scatter_sigma_mps2=None)
        result = calibrate(run)
        for own, truth in zip(list(result.parameters.values())[:12], np.ravel(run.truth), strict=True):
            low, high = result.interval(own)
            assert low is not None and high is not None and own.value is not None and own.sigma is not None
            inside += low <= truth <= high, abs(own.value - truth) < norm.ppf(0.975) * own.sigma
    return tuple(inside / (12 * runs))  # type: ignore[return-value]


@pytest.mark.parametrize("dwells", [8, *slow(6, 12, 24)])
@pytest.mark.parametrize("noise", [{"setting_deg": float(np.degrees(OF_A_MEAN / 9.81))}, *slow(
    {}, {"scatter_mps2": 0.8 * OF_A_MEAN})])  # fmt: skip
def test_noise_that_nobody_stated_is_in_the_intervals(dwells: int, noise: dict[str, float]) -> None:
    """From few dwells it is dropped, or known roughly: 1.96 sigma hold 89 to 94 %."""
    runs = 60
    share, plain = held(dwells, runs, 100, **noise)
    beyond = 3.0 * np.sqrt(0.95 * 0.05 / (3 * runs))  # the twelve of a run are not independent
    assert 0.95 - beyond < share < 0.95 + beyond and plain <= share


def test_without_any_known_noise_it_is_student_s_t() -> None:
    """And so it is where the misfit is many times what is known: all of it was estimated, and is as large."""
    for dof in (3, 12, 60):
        assert _student(dof) == pytest.approx(t.ppf(0.975, dof))
    assert _averaged(24, 25.0, 25.0) == pytest.approx(t.ppf(0.975, 24), rel=0.02)


def test_noise_that_was_stated_has_the_intervals_of_a_normal_distribution() -> None:
    run = Run(seed=1, dwells=8, count=COUNT)
    run.bench = replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    assert calibrate(run).interval_sigmas == pytest.approx(norm.ppf(0.975))
