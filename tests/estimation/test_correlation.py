"""Correlations of parameters and coefficients, against samples drawn from the estimate's distribution."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.paths import ROOT

from kf_calib.bench import paper_parameters
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.estimate import correlation
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.sources.files.recording import Recording


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(Recording(ROOT / "recordings" / "hidden.mcap"), Settings(effects=("second-order",)))


def test_they_are_those_of_samples(result: Calibration) -> None:
    estimate = result.estimate
    states = np.random.default_rng(1).multivariate_normal(estimate.state, estimate.covariance, size=4000)
    samples = [np.concatenate([paper_parameters.parameters_of(state[:12]), state[12:]]) for state in states]
    found = correlation(estimate)
    assert found.shape == (len(estimate.state),) * 2
    np.testing.assert_allclose(found, np.corrcoef(np.array(samples).T), atol=0.08)
    np.testing.assert_allclose(np.diag(found), 1.0)


def test_what_is_not_determined_has_none(result: Calibration) -> None:
    early = result.visits[2].estimate
    lost = np.isnan(np.concatenate([early.sigma, early.effect_sigma]))
    assert lost.any()
    np.testing.assert_array_equal(np.isnan(np.diag(correlation(early))), lost)
