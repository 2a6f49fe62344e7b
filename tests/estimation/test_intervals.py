"""Intervals of 95 %: they hold the truth as often as they say, whatever was stated of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm, t

from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import consistency

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
    return tuple(inside / (12 * runs))


@pytest.mark.slow
@pytest.mark.parametrize("dwells", [8, *slow(6, 12, 24)])
@pytest.mark.parametrize("noise", [{"setting_deg": float(np.degrees(OF_A_MEAN / 9.81))}, *slow(
    {}, {"scatter_mps2": 0.8 * OF_A_MEAN}, {"scatter_mps2": 3.0 * OF_A_MEAN})])  # fmt: skip
def test_noise_that_nobody_stated_is_in_the_intervals(dwells: int, noise: dict[str, float]) -> None:
    """From few dwells it is dropped, or known roughly: 1.96 sigma hold 89 to 94 %."""
    runs = 60
    share, plain = held(dwells, runs, 100, **noise)
    beyond = 3.0 * np.sqrt(0.95 * 0.05 / (3 * runs))  # the twelve of a run are not independent
    assert 0.95 - beyond < share < 0.95 + beyond and plain <= share


def unstated(angles: bool = True, **settings: float) -> Run:
    """A run of twelve dwells on a bench that states no scatter, nor errors of angles."""
    run = Run(seed=3, dwells=12, count=COUNT, white_mps2=WHITE, **settings)
    run.bench = replace(run.bench, angle_sigma_deg=None if angles else 0.0, scatter_sigma_mps2=None)
    return run


def test_noise_that_is_all_estimated_gives_student_s_t() -> None:
    result = calibrate(unstated(angles=False, scatter_mps2=300.0 * OF_A_MEAN))
    np.testing.assert_allclose(result.interval_sigmas, t.ppf(0.975, 3 * 12 - 12), rtol=0.02)


@pytest.mark.parametrize("scatter", [0.3, 1.0, 3.0])
def test_scatter_is_averaged_over_its_posterior(scatter: float) -> None:
    """Against an integral by scipy: of equal noise in all channels x does not depend, and misfit / R is chi-squared."""
    result = calibrate(unstated(angles=False, scatter_mps2=scatter * OF_A_MEAN))
    known = consistency(replace(result.fit, noise=result.noise.without_estimates()))
    size = np.sqrt(known.statistic / known.dof)  # of the misfit, in units of the noise that is known
    of_means = result.noise.effective_sigma_mps2**2 / result.linearised.means.counts
    taken = 1.0 + float(np.mean(result.noise.scatter_mps2**2) / np.mean(of_means))

    def density(log_size: float) -> float:
        ratio = 1.0 + np.exp(2.0 * log_size)
        return float(np.exp(-0.5 * (known.dof * np.log(ratio) + known.statistic / ratio) + 0.5 * known.statistic))

    def outside(sigmas: float) -> float:
        ends, odds = np.log([0.03 * size, 30.0 * size]), 0.75 / np.log(100.0)
        none = 0.25  # times the density at R = 1, which is 1

        def tail(log_size: float) -> float:
            return 2.0 * density(log_size) * float(norm.sf(sigmas * np.sqrt(taken / (1.0 + np.exp(2.0 * log_size)))))

        more, whole = (quad(each, *ends, points=[np.log(size)], limit=200)[0] for each in (tail, density))
        return float((odds * more + none * 2.0 * norm.sf(sigmas * np.sqrt(taken))) / (odds * whole + none) - 0.05)

    expected = brentq(outside, 0.5, 10.0)
    np.testing.assert_allclose(result.interval_sigmas, max(expected, norm.ppf(0.975)), rtol=0.03)


def test_a_cause_that_leaves_no_scatter_in_one_parameter_may_be_scatter_in_the_interval() -> None:
    """Setting errors turn gravity and leave scale factors alone where it is along an axis; scatter does not."""
    result = calibrate(unstated(setting_deg=float(np.degrees(2.0 * OF_A_MEAN / 9.81))))
    assert (result.interval_sigmas >= norm.ppf(0.975)).all()
    assert np.ptp(result.interval_sigmas) > 0.05


def test_noise_that_was_stated_has_the_intervals_of_a_normal_distribution() -> None:
    run = Run(seed=1, dwells=8, count=COUNT)
    run.bench = replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    np.testing.assert_allclose(calibrate(run).interval_sigmas, norm.ppf(0.975))
