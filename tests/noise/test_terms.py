"""A term of the noise is one class: what is computed in a noise goes over the list, terms of a stranger included."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from helpers.synthetic import Run

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation import kalman_filterpy, whitened_rows
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.settings import Settings
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, mean_covariances
from kf_calib.noise.terms import NoiseTerm, RandomWalk, Scatter, Scope, SettingError, SlowWaves, WavesOverRun


@dataclass(frozen=True)
class ScaleJitter(NoiseTerm):
    """A scale factor that is another one in each dwell, as of a supply that is switched on anew: no term of the
    package."""

    size: float
    scope: ClassVar[Scope] = "dwell"

    @property
    def sizes(self) -> Floats:
        return np.array([self.size])

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        force_mps2 = dwells.felt_force_mps2.reshape(-1, 3, 3)
        return self.size * force_mps2[:, :, :, None] * np.eye(3)

    def covariances(self, means: Means, state: Floats) -> Floats:
        return (self.size * means.force_mps2)[:, :, None] ** 2 * np.eye(3)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return calibrate(Run(seed=3, dwells=14, count=60, setting_deg=0.002)).fit


def information(fit: Fit, noise: Noise) -> Floats:
    """A^T V^-1 A (12, 12) of the dwells' means."""
    means, state = fit.linearised.means, fit.linearised.state
    weights = np.linalg.inv(mean_covariances(noise, means, state))
    return np.einsum("dip,dij,djq->pq", means.design, weights, means.design)


@pytest.mark.parametrize(
    "term", [ScaleJitter(3e-5), Scatter(np.array([0.0, 1e-5, 2e-4])), SettingError(2e-5)], ids=repr
)
def test_whitened_rows_have_the_information_of_means_with_the_covariance_of_all_terms(
    fitted: Fit, term: NoiseTerm
) -> None:
    """Of rows that are eliminated by QR, and of covariances that are inverted."""
    noise = fitted.noise.with_terms(term)
    linearised = fitted.linearised
    for reduced in (True, False):
        rows = np.concatenate(
            whitened_rows.whiten(
                linearised.dwells_at_state, linearised.columns, noise, linearised.state, reduced=reduced
            )
        )
        found, expected = rows[:, :-1].T @ rows[:, :-1], information(fitted, noise)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert np.abs(information(fitted, fitted.noise) / expected - 1.0).max() > 1e-3, "the term matters"


def test_the_reference_filter_allows_for_a_term_that_it_has_never_seen() -> None:
    """Sample by sample with one more state for each of its errors, against the whitened rows."""
    run = Run(seed=3, dwells=14, count=60, setting_deg=0.002)
    result = calibrate(run)
    noise, linearised = result.noise.with_terms(ScaleJitter(1e-4)), result.linearised
    samples = kalman_filterpy.samples_of(Pass(run, Settings()).rows(), linearised, noise)
    scale = np.tile([9.81, 9.81, 9.81, 1.0], 3)
    posterior = kalman_filterpy.estimate(samples, noise, linearised.model.nominal_state(), None, scale)
    expected = np.linalg.inv(information(result.fit, noise))
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.sqrt(np.diag(posterior.covariance)) / sigma, 1.0, rtol=1e-5)
    alone = np.sqrt(np.diag(np.linalg.inv(information(result.fit, result.noise))))
    assert (sigma / alone).max() > 1.1, "the term matters"


def test_noises_differ_by_which_terms_are_in_the_list() -> None:
    """What was estimated from the misfit does not judge it; a setting error that is considered does not weight."""
    sigma, scatter = np.full(3, 1e-4), Scatter(np.full(3, 1e-5))
    walk = RandomWalk(np.array([1e-6, 2e-6, 5e-7]))
    noise = Noise(sigma, np.ones(3), (SettingError(1e-5), scatter, walk, SlowWaves(sigma)))

    def kinds(some: Noise) -> set[type[NoiseTerm]]:
        return {type(term) for term in some.terms}

    assert kinds(noise.for_goodness_of_fit) == {RandomWalk, SlowWaves}
    assert kinds(noise.with_terms(SettingError(1e-5, judged=True)).for_goodness_of_fit) >= {SettingError}
    assert kinds(noise.with_terms(SettingError(1e-5, considered=True)).weights) == {Scatter, RandomWalk, SlowWaves}
    stated = noise.with_terms(Scatter(np.full(3, 1e-5), stated=True)).for_goodness_of_fit
    assert kinds(stated) == {Scatter, RandomWalk, SlowWaves}
    assert kinds(stated.with_scatter_as_flicker(24)) >= {SlowWaves, WavesOverRun}
    assert not kinds(stated.with_scatter_as_flicker(3)) & {SlowWaves, WavesOverRun}
