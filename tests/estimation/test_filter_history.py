"""Parameters along a run, the innovations beside noise, and the other engines' estimates on their way."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import Run
from scipy.stats import chi2

import kf_calib
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.engine_comparison import compare, least_squares, running_states
from kf_calib.estimation.filter_history import InnovationTests, history_of, innovation_tests, reading_correlation
from kf_calib.estimation.kalman_filterpy import samples_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import PRIORS, Settings

pytestmark = pytest.mark.usefixtures("unmeasured")

HIDDEN, FACES = (ROOT / "recordings" / name for name in ("hidden.mcap", "mems_faces.mcap"))


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(HIDDEN, Settings(effects=("hysteresis",)))


def test_history_ends_at_the_result_and_information_adds_up(result: Calibration) -> None:
    history = history_of(result)
    assert history.numbers.tolist() == [visit.dwell.number for visit in result.visits]
    expected = [(each.symbol, each.value, each.sigma) for each in result.parameters.values()]
    found = [(each.symbol, *own) for each, *own in zip(history.parameters, history.values[-1], history.sigmas[-1],
                                                        strict=True)]  # fmt: skip
    for one, other in zip(found, expected, strict=True):
        assert one[0] == other[0] and one[1:] == pytest.approx(other[1:], rel=1e-12)
    assert history.shares.sum(axis=0) == pytest.approx(1.0)
    assert history.shares_of_accelerometers.sum(axis=0) == pytest.approx(1.0)
    assert not history.deviations[-1].any() and np.isnan(history.values[0]).all()


def test_a_stated_prior_comes_first() -> None:
    history = history_of(calibrate(Run(dwells=5, count=60), Settings(prior=PRIORS["navigation"])))
    assert history.numbers.tolist() == [0, 1, 2, 3, 4, 5]
    assert np.isfinite(history.sigmas).all() and (np.diff(history.sigmas, axis=0) <= 1e-15).all()
    assert history.shares.sum(axis=0) == pytest.approx(1.0) and (history.shares[0] > 0.0).all()


def test_innovations_are_those_of_the_filter_and_more_where_readings_are_predicted() -> None:
    exact = kf_calib.open_recording(FACES, {"angle_sigma_deg": "0"})  # a setting error turns each face a little
    result = calibrate(exact)
    tests, visits = innovation_tests(result), result.visits
    assert tests.ratios[-1] == pytest.approx(visits[-1].innovation_mps2 / visits[-1].innovation_sigma_mps2)
    assert np.isnan(visits[3].innovation_mps2).all() and np.isfinite(tests.ratios[3]).all(), "upside down again"
    assert tests.dof.tolist() == [0, 0, 0, 3, 0, 3]
    assert np.isnan(tests.ratios[[0, 1, 2, 4]]).all() and np.isnan(tests.band[0]).all()
    assert tests.band[-1] == pytest.approx(chi2.ppf([0.025, 0.975], 3))
    assert tests.per_dof[-1] == pytest.approx((tests.nis[3] + tests.nis[5]) / 6)
    assert tests.per_dof_band[-1] == pytest.approx(chi2.ppf([0.025, 0.975], 6) / 6)


def test_autocorrelation_finds_what_is_in_the_innovations() -> None:
    white = np.random.default_rng(4).normal(size=(4000, 3))
    moved = white[1:] + 0.5 * white[:-1]  # r_1 = 0.5 / 1.25
    tests = InnovationTests(np.arange(3999), np.zeros(3999), np.zeros(3999, int), moved)
    assert tests.autocorrelation[0] == pytest.approx(0.4, abs=0.04)
    assert (np.abs(tests.autocorrelation[1:]) < 2.2 * tests.bound[1:, None]).all()
    assert tests.bound == pytest.approx(1.96 / np.sqrt(3999), rel=0.01)


def test_readings_of_white_noise_are_white_and_those_of_coloured_noise_are_not() -> None:
    white = reading_correlation(calibrate(Run(seed=1, dwells=12, count=400)))
    excess = np.abs(white.values - white.white[:, None]) / white.bound[:, None]
    assert len(excess) == 64 and np.mean(excess < 1.0) > 0.9
    coloured = reading_correlation(calibrate(Run(seed=1, dwells=12, count=400, phi=0.8)))
    assert coloured.values[0] == pytest.approx(0.8, abs=0.05)


def test_readings_are_correlated_over_a_quarter_of_a_dwell_where_dwells_are_short() -> None:
    """36 readings each: nine lags; of white noise less its parabola, by 20000 draws."""
    result = calibrate(Run(seed=1, dwells=60, count=64))
    short = reading_correlation(result)
    assert round(np.mean([dwell.count for dwell in result.fit.dwells])) == 36 and short.values.shape == (9, 3)
    assert np.mean(np.abs(short.values - short.white[:, None]) < short.bound[:, None]) > 0.85
    noise, curve = np.random.default_rng(5).normal(size=(20_000, 36)), np.linalg.qr(np.vander(np.arange(36.0), 3))[0]
    left = noise - noise @ curve @ curve.T
    products = np.array([np.mean(left[:, lag:] * left[:, : 36 - lag]) for lag in range(10)])
    assert short.white == pytest.approx(products[1:] / products[0], abs=5e-3)


def test_engines_on_their_way_are_those_of_the_dwells_so_far() -> None:
    run = Run(seed=2, dwells=9, count=80, setting_deg=0.01)
    compared = compare(run)
    for name, differences in compared.running_sigma.items():
        assert differences.shape == (9, 12)
        assert np.isnan(differences[:2]).all() and np.nanmax(np.abs(differences[4:])) < 1e-5
        assert np.abs(differences[-1]).max() == pytest.approx(compared.ways[name].max_difference_sigma, abs=3e-8)


def test_running_batch_least_squares_is_that_of_the_first_dwells() -> None:
    run = Run(seed=2, dwells=9, count=80, setting_deg=0.01)
    result = calibrate(run)
    samples = list(samples_of(Pass(run, result.settings).rows(), result.linearised, result.noise.weights))
    around = result.model.nominal_state()
    states = running_states(samples, around)
    for count in (5, 9):
        alone, covariance = least_squares([each for each in samples if each.dwell <= count], around)
        assert np.abs(states[count - 1] - alone).max() < 1e-6 * np.sqrt(np.diag(covariance)).min()


@pytest.mark.slow
def test_faces_do_not_determine_more_than_they_show() -> None:
    """Columns of rounding size determined the batch's estimate after some dwells."""
    compared = compare(FACES)
    assert np.nanmax(np.abs(compared.running_sigma["batch"])) < 1e-6
