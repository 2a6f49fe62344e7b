"""The likelihood of terms against scipy's densities with dense covariances, and its integrals against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import Run
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.in_noises import ROUNDING
from kf_calib.diagnosis.noise_sizes import NoiseSizes
from kf_calib.diagnosis.posterior import RunPosterior, _gains, _likeliest
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.run_likelihood import (
    RunLikelihood,
    Sizes,
    integrated,
    log_bayes,
    log_bayes_beside,
    log_bayes_together,
    orthonormal_columns,
)
from kf_calib.effects import effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns
from kf_calib.noise.means import means_of
from kf_calib.noise.reml import with_shared_noise
from kf_calib.noise.terms import WavesOverRun

ROUNDED = np.full((1, 1), ROUNDING)


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

    def together(parts: list[np.ndarray], of_terms: list[Sizes]) -> float:
        columns = np.hstack(parts)
        gram, along = columns.T @ columns, columns.T @ readings
        return log_bayes_together(gram[None], along[None], [part.shape[1] for part in parts], of_terms)[0]

    both = together([one, other], [sizes(0.5, 4.0), sizes(1.5)])
    expected = np.logaddexp.reduce([density(np.hstack([s * one, 1.5 * other]), 1.0, readings) for s in (0.5, 4.0)])
    assert both == pytest.approx(expected - np.log(2.0) - density(one, 0.0, readings), abs=1e-9)
    twice = together([one, one], [sizes(1.0), sizes(1.0)])
    assert twice == pytest.approx(together([np.sqrt(2.0) * one], [sizes(1.0)]), abs=1e-9)
    about = together([one], [Sizes(np.array([1.5]), np.zeros(1), 0.4)])
    shifted = readings - 0.4 * one.sum(axis=1)
    assert about == pytest.approx(density(1.5 * one, 1.0, shifted) - density(one, 0.0, readings), abs=1e-9)


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


@pytest.mark.parametrize("misfit", [1e2, 1e6, 1e10])
def test_an_integral_over_sizes_holds_where_the_likelihood_is_steep(misfit: float) -> None:
    """Of chi-squared of a misfit that only a large size explains: a polynomial through values that fall by 1e9 from one
    size to the next swung out above all of them."""
    step = 0.25
    log_sizes = np.arange(-2.0, 16.0, step)

    def log_likelihood(log_size: float) -> float:
        variance = 1.0 + np.exp(2.0 * log_size)
        return float(-12.0 * np.log(variance) - 0.5 * misfit / variance)

    middle, largest = 0.5 * np.log(misfit / 24.0), log_likelihood(0.5 * np.log(misfit / 24.0))
    ends = max(middle - 2.0, -2.0), min(middle + 3.0, 16.0 - step)
    expected = quad(lambda x: np.exp(log_likelihood(x) - largest), *ends, points=[middle], limit=400)[0]
    found = integrated(np.array([[log_likelihood(x) for x in log_sizes]]), step)[0]
    assert found == pytest.approx(np.log(expected) + largest, abs=0.02)


PLACES = np.array([[0, 1, 2], [9, 10, 11], [30, 31, 32]])
"""Columns of three terms."""


@pytest.fixture(scope="module")
def posterior() -> RunPosterior:
    run = Run(seed=4, dwells=12, count=60, white_mps2=1e-4, scatter_mps2=3e-5)
    before = calibrate(run)
    return RunPosterior(Refits(), before, assess_candidates(before.fit))


def test_noise_beside_the_model_has_its_restricted_likelihood(posterior: RunPosterior) -> None:
    """Differences over the sizes of scatter: the coefficients integrated out with scipy, on what the model leaves."""
    likelihood = posterior._run.likelihood
    noises: NoiseSizes = posterior._sizes
    spanned = likelihood.spanned
    used = spanned.more_basis.any(axis=1)
    assert used.sum() == 12  # the wide prior of the twelve; nothing within dwells
    basis = np.vstack([spanned.basis.reshape(36, -1), spanned.more_basis[used]])
    rest = np.linalg.svd(basis)[0][:, basis.shape[1] :]
    found, expected = [], []
    for covariance in noises.covariances[1:12]:
        assert covariance is not None
        dense = np.eye(48)
        for k in range(12):
            dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariance[k]
        readings = rest.T @ np.append(spanned.readings.ravel(), spanned.more_readings[used])
        expected.append(multivariate_normal(cov=rest.T @ dense @ rest).logpdf(readings))
        found.append(likelihood.projected(covariance, np.arange(3)).log)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), atol=1e-6)
    np.testing.assert_allclose(posterior._base[1:12], found, atol=1e-8)


@pytest.mark.parametrize("size_mps2", [1e-7, 1e-5, 1e-3])
def test_noise_that_dwells_share_is_integrated_out_with_its_volume(posterior: RunPosterior, size_mps2: float) -> None:
    """Waves over the run, against scipy's density of what the model leaves, in covariances with and without them."""
    linearised, noise = posterior._run.likelihood.linearised, posterior._noise
    wavy = noise.with_terms(WavesOverRun(np.full(3, size_mps2)))
    effect = posterior._run.terms[0].effect
    assert effect is not None
    found = [
        RunLikelihood(linearised, each, 1e-12, [effect]).projected(None, np.arange(1)).log for each in (noise, wavy)
    ]
    likelihood = RunLikelihood(linearised, noise, 1e-12, [effect])
    means, _ = with_shared_noise(linearised.dwells, wavy, linearised.means, linearised.state)
    waves = (likelihood._root @ means.design[..., linearised.model.count :]).reshape(36, -1)
    rest = np.linalg.svd(likelihood.spanned.basis.reshape(36, -1))[0][:, likelihood.spanned.basis.shape[2] :]
    readings, waves = rest.T @ likelihood.spanned.readings.ravel(), rest.T @ waves
    expected = [multivariate_normal(cov=np.eye(len(rest.T)) + k * waves @ waves.T).logpdf(readings) for k in (0, 1)]
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=1e-5)


def test_courses_are_those_of_the_likeliest_states_wherever_a_fit_has_stopped(posterior: RunPosterior) -> None:
    """A refit that had not come to its end left what it explains within dwells, and that it changes "irregularly" got
    2400 nats. With further noise, beside two columns of 100 sigma and more, against numpy's lstsq."""
    before = Refits().with_effects(posterior._before, ("bias-drift",))
    fitted, model = before.linearised, before.model
    stopped = LinearisedDwells(fitted.dwells, model, fitted.state + np.append(np.zeros(12), [3e-2, -2e-2, 1e-2]))
    places, coefficients = np.arange(2), np.array([2e-4, -1e-4])
    effects = [effect_named("second-order", model.bench)]
    likelihood = RunLikelihood(stopped, posterior._noise, 1e-12, effects)
    likelihood.rescale(np.array([0.5, 2.0, 1.0]))
    covariance = posterior._sizes.covariances[5]
    assert covariance is not None
    lower = np.linalg.cholesky(np.eye(3) + covariance)
    means, root = likelihood.means, likelihood._root
    added = candidate_columns(stopped.dwells_at_state, effects, model.bench, stopped.state)
    made = means_of(stopped.dwells_at_state, added).design[..., places] * likelihood.scales[places]
    design, readings = means.design[..., : model.count], means.readings - made @ coefficients
    white = [np.linalg.solve(lower, root @ part).reshape(36, -1) for part in (design, readings[..., None])]
    expected = np.linalg.lstsq(white[0], white[1][:, 0])[0]
    found = likelihood.states_beside(covariance, places, coefficients)
    sigma = np.sqrt(np.diag(np.linalg.inv(white[0].T @ white[0])))
    assert np.abs((found - before.fit.state) / sigma).max() > 50.0
    np.testing.assert_allclose((found - expected) / sigma, 0.0, atol=0.3)  # rows within dwells tell a little
    none = np.zeros(0, np.intp), np.zeros(0)
    here, there = (
        likelihood.courses_at(state, np.zeros(0)) for state in (likelihood.states_beside(None, *none), before.fit.state)
    )
    np.testing.assert_allclose(here.squares, there.squares, rtol=0.02)
    assert likelihood.courses.squares.sum() > 10.0 * here.squares.sum()


def test_products_in_all_noises_are_those_of_rows_in_each(posterior: RunPosterior) -> None:
    """Whitened and projected by numpy's QR in each noise alone, of a few columns."""
    likelihood, terms = posterior._run.likelihood, posterior._run.terms
    noises = likelihood.in_noises(posterior._sizes.families[2].shapes, posterior._sizes.squares, [PLACES])
    for k in (0, 5, len(posterior._sizes.squares) - 1):
        rows = likelihood.projected(posterior._sizes.squares[k] * posterior._sizes.families[2].shapes, PLACES.ravel())
        for gram, place in zip(noises.gram(0, np.array([k]), np.arange(len(PLACES)))[0], PLACES, strict=True):
            columns = rows.of(place)
            np.testing.assert_allclose(gram, columns.T @ columns, rtol=1e-6, atol=1e-9 * np.abs(gram).max())
            np.testing.assert_allclose(noises.along[k, place], columns.T @ rows.readings, rtol=1e-6, atol=1e-6)
    assert max(term.columns.max() for term in terms) < likelihood.spanned.columns.shape[2]


def test_what_is_rounding_beside_others_explains_nothing() -> None:
    """Two columns that are nearly one, of which another has been subtracted, and readings of 1e6 sigma."""
    rng = np.random.default_rng(3)
    one = rng.normal(size=(40, 1))
    columns, readings = np.hstack([one, one * (1.0 + 1e-9)]), 1e6 * rng.normal(size=40)
    basis = one / np.linalg.norm(one)
    gram, along = columns.T @ columns, columns.T @ readings
    left = gram - columns.T @ basis @ basis.T @ columns
    along_left = along - columns.T @ basis @ (basis.T @ readings)
    squares, logs = np.geomspace(1e-4, 1e14, 40)[None], np.full((1, 40), -np.log(40.0))
    lengths = np.array([gram.diagonal().max()])
    found = log_bayes(left[None], along_left[None], squares, logs, np.zeros(1), lengths)
    assert found[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stated", [True, False])
def test_beside_causes_that_nobody_knows_half_of_a_gain_counts(stated: bool, posterior: RunPosterior) -> None:
    """Beyond stated noise; where it was not stated it is noise, and all of the gain counts."""
    noise = calibrate(Run(seed=4, dwells=12, stated=stated)).noise
    sizes = NoiseSizes(posterior._run.likelihood, noise.without_estimates(), 24, {})
    known = {"setting"} if stated else set[str]()  # the scatter is not stated
    shapes = [family.shapes for family in sizes.families[1:]]
    logs = [posterior._run.likelihood.in_noises(of_family, sizes.squares).logs for of_family in shapes]
    base = np.concatenate([posterior._base[:1], *logs])
    without, more, less = (sizes.evidence((base + gain)[None])[0] for gain in (0.0, 8.0, -8.0))
    expected = [4.0 if known & {*family.parts} else 8.0 for family in sizes.families]
    assert expected.count(4.0) == 2 * stated
    np.testing.assert_allclose(more - without, expected, atol=1e-9)
    np.testing.assert_allclose(less - without, -8.0, atol=1e-9)


def test_probabilities_are_those_of_the_evidence_and_families_add_up(posterior: RunPosterior) -> None:
    table = posterior.table(refitted=False)
    logs = np.array([row.log_evidence for row in table.rows])
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    np.testing.assert_allclose([row.probability for row in table.rows], shares, rtol=1e-9, atol=1e-15)
    assert sum(shares) == pytest.approx(1.0) and (np.diff(shares) <= 0.0).all()
    assert set(table.families) == {family for row in table.rows for family in row.families}


@pytest.mark.parametrize("common", [0, 2])
def test_evidence_beside_others_is_that_of_what_they_leave(common: int) -> None:
    """Also where the term has some of their columns, and nothing is left of these."""
    rng = np.random.default_rng(1)
    columns, beside, z = rng.normal(size=(60, 20)), rng.normal(size=(60, 3)), 3.0 * rng.normal(size=60)
    columns[:, :common] = beside[:, :common]
    basis = np.linalg.qr(beside)[0]
    left = columns - basis @ (basis.T @ columns)
    squares, logs, lengths = np.geomspace(1e-4, 1e4, 9)[None], np.full((1, 9), -np.log(9.0)), np.full((1, 1), 90.0)
    terms = orthonormal_columns((columns.T @ columns)[None, None], (columns.T @ z)[None, None], lengths, ROUNDED)
    found = log_bayes_beside(*terms, (columns.T @ basis)[None, None], (basis.T @ z)[None], squares, logs, ROUNDED)
    gram, along = (left.T @ left)[None, None], (left.T @ z)[None, None]
    assert found == pytest.approx(log_bayes(gram, along, squares, logs, np.zeros(1), lengths), abs=1e-3)


def test_columns_that_others_have_whole_explain_nothing_beside_them() -> None:
    """Waves of a random walk, of which the smallest are near rounding, beside columns within what they span: 40 000
    nats by rounding, in a run of four dwells. Against the waves that these columns leave, by numpy's QR."""
    rng = np.random.default_rng(8)
    columns = rng.normal(size=(40, 20)) @ np.linalg.qr(rng.normal(size=(20, 20)))[0] * np.geomspace(1.0, 3e-5, 20)
    basis, z = (
        np.linalg.qr(columns @ rng.normal(size=(20, 4)) + 1e-7 * rng.normal(size=(40, 4)))[0],
        150.0 * rng.normal(size=40),
    )
    left, rest = columns - basis @ (basis.T @ columns), z - basis @ (basis.T @ z)
    squares, logs = np.geomspace(1e-6, 1e14, 11)[None], np.full((1, 11), -np.log(11.0))
    terms = orthonormal_columns(
        (columns.T @ columns)[None, None], (columns.T @ z)[None, None], np.ones((1, 1)), ROUNDED
    )
    found = log_bayes_beside(*terms, (columns.T @ basis)[None, None], (basis.T @ z)[None], squares, logs, ROUNDED)
    turned, sizes, _ = np.linalg.svd(left, full_matrices=False)
    spreads = 1.0 + squares[0][:, None] * np.where(sizes > 1e-5, sizes, 0.0) ** 2
    expected = 0.5 * np.sum((turned.T @ rest) ** 2 * (1.0 - 1.0 / spreads) - np.log(spreads), axis=1)
    assert float(found[0, 0]) == pytest.approx(np.logaddexp.reduce(expected + logs[0]), rel=0.02)


def test_columns_of_any_length_are_as_likely_together_as_apart() -> None:
    """A warm-up of 40 and a drift of 4e6 in length: with what one unit had, half of what they gain was lost, and what
    they then left within dwells counted as if it changed irregularly (99.5 %)."""
    rng = np.random.default_rng(4)
    columns, z = rng.normal(size=(50, 4)) * np.array([40.0, 4e6, 1.0, 4e6]), 30.0 * rng.normal(size=50)
    columns = np.hstack([columns, columns[:, :1]])  # one of them twice
    gram, along = columns.T @ columns, columns.T @ z
    basis = np.linalg.qr(columns[:, :4])[0]
    best = z - basis @ (basis.T @ z)
    np.testing.assert_allclose(z - columns @ _likeliest(gram, along), best, atol=1e-5)
    assert _gains(gram[None], along[None])[0] == pytest.approx(0.5 * (z @ z - best @ best))
