"""The likelihood of terms against scipy's densities with dense covariances, and its integrals against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import Run
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.noise_sizes import NoiseSizes
from kf_calib.diagnosis.posterior import RunPosterior
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.run_likelihood import Sizes, integrated, log_bayes, log_bayes_together
from kf_calib.estimation.calibration import calibrate


def sizes(*values: float) -> Sizes:
    """These sizes, all as likely."""
    return Sizes(np.array(values), np.full(len(values), -np.log(len(values))))


def density(columns: np.ndarray, size: float, readings: np.ndarray) -> float:
    """Log density of readings in unit noise and a term of this size."""
    covariance = np.eye(len(readings)) + size**2 * columns @ columns.T
    return float(multivariate_normal(cov=covariance).logpdf(readings))


@pytest.mark.parametrize("centre", [0.0, 0.7])
def test_a_term_multiplies_the_density_by_its_bayes_factor(centre: float) -> None:
    rng = np.random.default_rng(1)
    columns, readings, tried = rng.normal(size=(5, 12, 3)), rng.normal(size=12) * 3.0, (0.3, 2.0, 15.0)
    gram, along = np.swapaxes(columns, 1, 2) @ columns, np.swapaxes(columns, 1, 2) @ readings
    squares, logs = np.tile(np.square(tried), (5, 1)), np.full((5, 3), -np.log(3.0))
    found = log_bayes(gram, along, squares, logs, np.full(5, centre))
    for k in range(5):
        about = readings - centre * columns[k].sum(axis=1)
        expected = np.logaddexp.reduce([density(columns[k], size, about) for size in tried]) - np.log(3.0)
        assert found[k] == pytest.approx(expected - density(columns[k], 0.0, readings), abs=1e-9)


def test_two_terms_have_the_density_of_both_and_a_column_twice_is_one() -> None:
    rng = np.random.default_rng(2)
    one, other, readings = rng.normal(size=(10, 2)), rng.normal(size=(10, 3)), rng.normal(size=10) * 2.0
    both = log_bayes_together([one, other], readings, [sizes(0.5, 4.0), sizes(1.5)])
    expected = np.logaddexp.reduce([density(np.hstack([s * one, 1.5 * other]), 1.0, readings) for s in (0.5, 4.0)])
    assert both == pytest.approx(expected - np.log(2.0) - density(one, 0.0, readings), abs=1e-9)
    twice = log_bayes_together([one, one], readings, [sizes(1.0), sizes(1.0)])
    assert twice == pytest.approx(log_bayes_together([np.sqrt(2.0) * one], readings, [sizes(1.0)]), abs=1e-9)


def test_an_integral_over_sizes_is_that_of_quadrature() -> None:
    """Of the likelihood of a variance, for which 24 readings are as narrow as any noise of few dwells is."""
    step = 0.25
    log_sizes = np.arange(-8.0, 8.0, step)

    def log_likelihood(log_size: float) -> float:
        variance = 1.0 + np.exp(2.0 * log_size)
        return float(-12.0 * np.log(variance) - 60.0 / variance)

    expected = quad(lambda x: np.exp(log_likelihood(x)), -8.0, 8.0 - step, points=[1.0], limit=200)[0]
    found = integrated(np.array([[log_likelihood(x) for x in log_sizes]]), step)[0]
    assert found == pytest.approx(np.log(expected), abs=0.01)


@pytest.fixture(scope="module")
def posterior() -> RunPosterior:
    run = Run(seed=4, dwells=12, count=60, white_mps2=1e-4, scatter_mps2=3e-5)
    before = calibrate(run)
    return RunPosterior(Refits(), before, assess_candidates(before.fit))


def test_noise_beside_the_model_has_its_restricted_likelihood(posterior: RunPosterior) -> None:
    """Differences over the sizes of scatter: the coefficients integrated out with scipy, on what the model leaves."""
    likelihood = posterior._run.likelihood
    noises: NoiseSizes = posterior._sizes
    design, readings = likelihood._model.reshape(36, -1), likelihood._readings.ravel()
    rest = np.linalg.svd(design / np.linalg.norm(design, axis=0))[0][:, design.shape[1] :]
    found, expected = [], []
    for covariance in noises.covariances[1:12]:
        assert covariance is not None
        dense = np.eye(36)
        for k in range(12):
            dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariance[k]
        expected.append(multivariate_normal(cov=rest.T @ dense @ rest).logpdf(rest.T @ readings))
        found.append(likelihood.projected(covariance).log)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), atol=1e-6)


def test_probabilities_are_those_of_the_evidence_and_families_add_up(posterior: RunPosterior) -> None:
    table = posterior.table(refitted=False)
    logs = np.array([row.log_evidence for row in table.rows])
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    np.testing.assert_allclose([row.probability for row in table.rows], shares, rtol=1e-9, atol=1e-15)
    assert sum(shares) == pytest.approx(1.0) and (np.diff(shares) <= 0.0).all()
    assert set(table.families) == {family for row in table.rows for family in row.families}
