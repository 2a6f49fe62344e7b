"""Noise that accelerometers share: the correlations of their means, coverage, and the rate of alarms."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.signal import lfilter
from scipy.stats import binom, kstest

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import consistency
from kf_calib.noise.cross_spectrum import correlations

DWELLS, COUNT, BEFORE = 20, 1500, 300


def told(dwells: list[Floats]) -> Floats:
    """Correlations (D, 3, 3) of the means as told by the readings (3, n) of each dwell."""
    sums = [Autocovariance.of(readings - readings.mean(axis=1, keepdims=True)) for readings in dwells]
    return correlations(sums, sum(sums[1:], sums[0]))


def correlation(covariance: Floats) -> Floats:
    sizes = np.sqrt(np.diag(covariance))
    return covariance / np.outer(sizes, sizes)


def test_an_autoregression_of_three_channels_gives_their_means_the_correlation_of_its_density_at_frequency_zero() -> (
    None
):
    """x_t = A x_(t-1) + L e_t: in proportion to B L L^T B^T with B = (1 - A)^-1."""
    random = np.random.default_rng(1)
    memory = np.array([[0.5, 0.2, 0.0], [0.1, 0.3, 0.2], [0.0, 0.0, 0.7]])
    root = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.2, 0.3, 1.0]])
    dwells = []
    for _ in range(DWELLS):
        readings = np.zeros((COUNT + BEFORE, 3))
        for t, white in enumerate(random.normal(size=(COUNT + BEFORE - 1, 3)) @ root.T, start=1):
            readings[t] = memory @ readings[t - 1] + white
        dwells.append(readings[BEFORE:].T)
    gain = np.linalg.inv(np.eye(3) - memory) @ root
    assert told(dwells) == pytest.approx(np.tile(correlation(gain @ gain.T), (DWELLS, 1, 1)), abs=0.06)


def test_a_quick_vibration_that_all_feel_leaves_their_means_uncorrelated() -> None:
    """Of each reading it is most of the variance, at frequency zero less than a quarter."""
    random = np.random.default_rng(2)
    poles = [1.0, -1.8 * np.cos(2.0 * np.pi * 0.3), 0.81]
    vibration = [lfilter([1.0], poles, random.normal(size=COUNT + BEFORE))[BEFORE:] for _ in range(DWELLS)]
    dwells = [0.8 * random.normal(size=(3, COUNT)) + shared for shared in vibration]
    of_readings = np.corrcoef(np.hstack(dwells))[0, 1]
    assert of_readings > 0.7
    expected = (1.0 / sum(poles) ** 2) / (1.0 / sum(poles) ** 2 + 0.64)
    assert np.abs(told(dwells)[:, [0, 0, 1], [1, 2, 2]] - expected).max() < 0.1


@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_channels_that_share_nothing_are_not_correlated(phi: float) -> None:
    """Exactly: in 97 of 100 runs at least no digit of a result depends on what they might share."""
    random = np.random.default_rng(3)
    alone = 0
    for _ in range(100):
        white = random.normal(size=(8, 3, 300 + BEFORE))
        alone += bool((told(list(lfilter([1.0], [1.0, -phi], white)[..., BEFORE:])) == np.eye(3)).all())
    assert alone >= 97


def test_what_shakes_along_another_direction_in_each_dwell_is_told_of_each() -> None:
    random = np.random.default_rng(4)
    along = random.normal(size=(DWELLS, 3))
    dwells = [random.normal(size=(3, COUNT)) + np.outer(own, random.normal(size=COUNT)) for own in along]
    true = np.array([correlation(np.eye(3) + np.outer(own, own)) for own in along])
    assert np.abs(told(dwells) - true).max() < 0.15


def test_few_readings_tell_no_correlation() -> None:
    random = np.random.default_rng(5)
    shared = random.normal(size=(10, 1, 12))
    assert (told(list(np.tile(shared, (1, 3, 1)) + random.normal(size=(10, 3, 12)))) == np.eye(3)).all()


@pytest.mark.parametrize("kind", slow("shared_mps2", "shaken_mps2"))
def test_p_is_uniform_and_intervals_cover_where_accelerometers_share_noise(kind: str) -> None:
    """Of 120 runs each. With channels taken for independent, p was below one percent in 8 % of the first."""
    p_values, covered, parameters = [], 0, 0
    for seed in range(120):
        run = Run(seed=seed, white_mps2=3e-4, **{kind: 9e-4})
        result = calibrate(run)
        p_values.append(consistency(result.fit).p_value)
        errors = result.estimate.parameters - run.truth
        covered += int((np.abs(errors) < 1.959964 * np.sqrt(np.diag(result.estimate.parameter_covariance))).sum())
        parameters += len(errors)
    assert kstest(p_values, "uniform").pvalue > 1e-3
    assert sum(p < 0.01 for p in p_values) <= binom.ppf(0.999, len(p_values), 0.01)
    assert covered / parameters == pytest.approx(0.95, abs=0.03)
