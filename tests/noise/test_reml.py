"""The restricted likelihood against dense matrices, its derivatives against differences, its maximum against others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.restricted import restricted_log_likelihood
from helpers.synthetic import Run
from helpers.thresholds import begins_at
from scipy.stats import chi2

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.noise import banded
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.reml import Parts, VarianceComponents
from kf_calib.noise.restricted_likelihood import Restricted
from kf_calib.noise.terms import RandomWalk, Scatter


def dense(columns: Floats) -> Floats:
    """The symmetric matrix that ``banded`` keeps the columns of."""
    count = len(columns)
    out = np.zeros((3 * count + 3, 3 * count + 3))
    for k, own in enumerate(columns):
        out[3 * k : 3 * k + 6, 3 * k : 3 * k + 3] = own
        out[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6] = own[3:].T
    return out[: 3 * count, : 3 * count]


def covariance(rng: np.random.Generator, count: int, beside: float) -> Floats:
    """Of random numbers whose threes share with those beside them."""
    left = rng.normal(size=(count, 3, 4))
    shared = beside * rng.normal(size=(count - 1, 2, 3, 2))
    out = np.zeros((count, 6, 3))
    out[:, :3] = left @ np.swapaxes(left, 1, 2) + 0.1 * np.eye(3)
    out[:-1, :3] += shared[:, 0] @ np.swapaxes(shared[:, 0], 1, 2)
    out[1:, :3] += shared[:, 1] @ np.swapaxes(shared[:, 1], 1, 2)
    out[:-1, 3:] = shared[:, 1] @ np.swapaxes(shared[:, 0], 1, 2)
    return out


def problem(seed: int, beside: float, known: int, count: int = 9) -> Restricted:
    rng = np.random.default_rng(seed)
    prior = np.zeros((known, 7))
    prior[:, :known] = np.diag(rng.uniform(0.5, 2.0, known))
    shapes = np.array([covariance(rng, count, beside) for _ in range(3)])
    return Restricted(rng.normal(size=(3 * count, 7)), prior, covariance(rng, count, beside), (shapes[:1], shapes[1:]))


@pytest.mark.parametrize("count", [1, 2, 7])
def test_banded_matrices_are_the_dense_ones(count: int) -> None:
    rng = np.random.default_rng(count)
    columns, rows = covariance(rng, count, 1.0), rng.normal(size=(3 * count, 2))
    full, lower = dense(columns), banded.root(columns)
    root, inside = np.linalg.cholesky(full), np.abs(dense(np.ones_like(columns)))
    np.testing.assert_allclose(banded.solve(lower, rows), np.linalg.solve(root, rows), rtol=1e-9)
    np.testing.assert_allclose(banded.solve(lower, rows, transposed=True), np.linalg.solve(root.T, rows), rtol=1e-9)
    expected = inside * np.linalg.inv(full)
    np.testing.assert_allclose(dense(banded.inverse(columns, lower)), expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(banded.products(columns[None], rows[:, 0])[:, 0], full @ rows[:, 0], rtol=1e-9)
    np.testing.assert_allclose(banded.traces(banded.outer(rows), columns[None]), np.trace(rows.T @ full @ rows))


def test_what_is_no_covariance_has_no_root() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        banded.root(-covariance(np.random.default_rng(0), 3, 1.0))


@pytest.mark.parametrize("beside", [0.0, 1.0])
@pytest.mark.parametrize("known", [0, 2])
def test_the_restricted_likelihood_is_that_of_dense_matrices(known: int, beside: float) -> None:
    """Of its definition, by determinants and inverses; the prior is as many readings more."""
    made, variances = problem(1, beside, known), np.array([0.3, 2.0, 0.7])
    point = made.at(variances)
    full = np.eye(len(made.rows) + known)
    full[known:, known:] = dense(made.fixed + np.tensordot(variances, np.concatenate(made.shapes), 1))
    design, readings = np.vstack([made.prior, made.rows])[:, :-1], np.vstack([made.prior, made.rows])[:, -1]
    weight = np.linalg.inv(full)
    inner = design.T @ weight @ design
    project = weight - weight @ design @ np.linalg.inv(inner) @ design.T @ weight
    misfit = readings @ project @ readings
    expected = 0.5 * (np.linalg.slogdet(full)[1] + np.linalg.slogdet(inner)[1] + misfit)
    assert point.misfit == pytest.approx(misfit, rel=1e-9)
    assert point.cost == pytest.approx(expected, rel=1e-9)
    onto = (project @ readings)[known:]
    moved = np.column_stack([dense(own) @ onto for own in np.concatenate(made.shapes)])
    np.testing.assert_allclose(point.information, 0.5 * moved.T @ project[known:, known:] @ moved, rtol=1e-8)


@pytest.mark.parametrize("beside", [0.0, 1.0])
@pytest.mark.parametrize("known", [0, 2])
def test_its_slope_is_that_of_differences(known: int, beside: float) -> None:
    made, variances, step = problem(2, beside, known), np.array([0.3, 2.0, 0.7]), 1e-5
    moves = step * np.eye(3)
    slope = [(made.at(variances + own).cost - made.at(variances - own).cost) / (2.0 * step) for own in moves]
    np.testing.assert_allclose(made.at(variances).slope, slope, rtol=1e-6, atol=1e-7)


def test_its_curvature_is_that_of_differences() -> None:
    made, sizes, step = problem(3, 1.0, 0), np.array([0.5, 1.4, 0.8]), 1e-3
    moves = step * np.eye(3)

    def cost(logs: Floats) -> float:
        return made.at((sizes * np.exp(logs)) ** 2).cost

    curvature = [
        [(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4.0 * step**2) for a in moves] for b in moves
    ]
    np.testing.assert_allclose(made.curvature(sizes), curvature, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_no_other_sizes_are_likelier_wherever_the_search_begins(seed: int) -> None:
    """Several of these have sizes that are best at zero."""
    made, rng = problem(seed, 1.0, 0), np.random.default_rng(seed)
    sizes, best = made.most_likely()
    for _ in range(40):
        assert made.at((sizes * np.exp(0.3 * rng.normal(size=3)) + 0.02 * rng.random(3)) ** 2).cost >= best.cost - 1e-9
    for near in (sizes, 1.1 * sizes, 30.0 * sizes, np.zeros(3)):
        again, point = made.most_likely(near)
        assert point.cost == pytest.approx(best.cost, abs=1e-7)
        np.testing.assert_allclose(again, sizes, atol=2e-4)


def test_means_that_are_worked_on_in_parts_have_the_same_likelihood(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine means that are not correlated, at once or four at a time."""
    whole = problem(1, 0.0, 2)
    uncorrelated = [np.concatenate([shape[..., :3, :]], axis=-2) for shape in (whole.fixed, *whole.shapes)]
    made = Restricted(whole.rows, whole.prior, uncorrelated[0], tuple(uncorrelated[1:]))
    variances = np.array([0.3, 2.0, 0.7])
    at_once = made.at(variances)
    monkeypatch.setattr("kf_calib.noise.restricted_likelihood.AT_ONCE", 4)
    in_parts = Restricted(made.rows, made.prior, made.fixed, made.shapes).at(variances)
    assert in_parts.cost == pytest.approx(at_once.cost, rel=1e-12)
    np.testing.assert_allclose(in_parts.slope, at_once.slope, rtol=1e-9)
    assert in_parts.misfit == pytest.approx(whole.at(variances).misfit, rel=1e-9)


@pytest.mark.slow
def test_nothing_is_estimated_where_the_misfit_is_one_that_noise_exceeds_once_in_ten_times(
    walked: Calibration,
) -> None:
    """All of it in one accelerometer, in which it is far beyond noise; of the others nothing is left at all."""
    means, state, noise = walked.linearised.means, walked.linearised.state, walked.noise
    within = Noise(noise.sigma_mps2, noise.inflation)
    design, sigma = means.design[:, 1], within.effective_sigma_mps2[1] / np.sqrt(means.counts[:, 1])
    columns = design[:, np.abs(design).any(axis=0)] / sigma[:, None]
    left = np.random.default_rng(3).normal(size=len(sigma))
    left -= columns @ np.linalg.lstsq(columns, left)[0]
    readings = means.design @ state
    free = readings.size - means.design.shape[2]

    def scattered(misfit: float) -> bool:
        excess = readings.copy()
        excess[:, 1] += sigma * left * np.sqrt(misfit) / np.linalg.norm(left)
        found = VarianceComponents(0.0, None).completed(within, replace(means, readings=excess), state)
        return bool(found.scatter_mps2.any())

    assert begins_at(scattered, 0.1 * free, 10.0 * free) == pytest.approx(chi2.isf(0.1, free), rel=1e-4)


def test_a_combination_of_parts_is_taken_that_gains_most_beyond_its_charge(monkeypatch: pytest.MonkeyPatch) -> None:
    """All parts together gain 10.2 for 5, one of them 10 for 2 and the other 9.5 for a half."""
    costs = {("setting", "common"): -10.2, ("setting",): -10.0, ("common",): -9.5}
    charges = {("setting", "common"): 5.0, ("setting",): 2.0, ("common",): 0.5}
    monkeypatch.setattr("kf_calib.noise.reml._charge", lambda parts, _: charges[parts])

    def of(parts: Parts) -> SimpleNamespace:
        return SimpleNamespace(most_likely=lambda _: (np.ones(len(parts)), SimpleNamespace(cost=costs[parts])))

    likelihood: Any = SimpleNamespace(of=of)
    combinations = [("setting",), ("common",), ("setting", "common")]
    for without, best in ((0.0, ("common",)), (-8.9, ("common",)), (-9.1, ())):
        nothing: Any = SimpleNamespace(cost=without)
        assert VarianceComponents(None, None)._likeliest(likelihood, combinations, nothing) == best


def test_a_search_that_begins_near_its_end_is_shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    made, points = problem(4, 1.0, 0, count=40), list[Floats]()
    evaluated = Restricted._level

    def level(self: Restricted, variances: Floats) -> object:
        points.append(variances)
        return evaluated(self, variances)

    monkeypatch.setattr(Restricted, "_level", level)
    sizes, _ = made.most_likely()
    cold = len(points)
    made.most_likely(1.001 * sizes)
    assert len(points) - cold < cold / 2


@pytest.fixture(scope="module")
def walked() -> Calibration:
    """Of a run whose dwells scatter and whose biases walk, which it says nothing of."""
    run = Run(seed=5, dwells=40, scatter_mps2=1e-3, stated=False)
    paths = np.cumsum(np.random.default_rng(5).normal(size=(len(run.accel.values), 3)), axis=0)
    run.accel = replace(run.accel, values=run.accel.values + 3e-5 * paths)
    return calibrate(run, Settings(effects=("bias-walk",)))


def parts_of(noise: Noise) -> Floats:
    return np.array([noise.setting_rad, *noise.scatter_mps2, *noise.walk_mps2_per_sqrt_s])


def test_sizes_that_were_found_before_lead_to_the_same_noise(walked: Calibration) -> None:
    means, state = walked.linearised.means, walked.linearised.state
    within = walked.noise.without(RandomWalk)
    components = VarianceComponents(None, None, walks=True)
    noise = components.completed(within, means, state)
    moved: Means = replace(means, readings=means.readings * (1.0 + 1e-9))
    far = {parts: 50.0 * sizes for parts, sizes in components.sizes.items()}
    assert noise.walk_mps2_per_sqrt_s.min() > 0.0 and noise.scatter_mps2.min() > 0.0
    for start in (components.sizes, far):
        again = VarianceComponents(None, None, walks=True, sizes=dict(start)).completed(within, moved, state)
        np.testing.assert_allclose(parts_of(again), parts_of(noise), rtol=1e-4)
        assert again.walk.spreads == pytest.approx(noise.walk.spreads, rel=1e-3)


@pytest.mark.parametrize("walk", [0.3, 1.0])
def test_scatter_is_found_beside_a_walk_that_is_stated(walked: Calibration, walk: float) -> None:
    means, state = walked.linearised.means, walked.linearised.state
    within = walked.noise.with_terms(RandomWalk(walk * walked.noise.walk_mps2_per_sqrt_s))
    noise = VarianceComponents(0.0, None).completed(within, means, state)
    assert np.array_equal(noise.walk_mps2_per_sqrt_s, within.walk_mps2_per_sqrt_s)

    def likelihood(size: float) -> float:
        return restricted_log_likelihood(noise.with_terms(Scatter(size * noise.scatter_mps2)), means, state)

    assert max(likelihood(size) for size in (0.9, 0.99, 1.01, 1.1)) < likelihood(1.0)


def test_threes_that_are_alone_are_those_of_a_band_without_neighbours() -> None:
    rng = np.random.default_rng(7)
    band, rows = covariance(rng, 9, beside=0.0), rng.normal(size=(27, 4))
    alone = band[:, :3].copy()
    lower, of_band = banded.root(alone), banded.root(band)
    np.testing.assert_allclose(banded.diagonal(lower), banded.diagonal(of_band), rtol=1e-12)
    for transposed in (False, True):
        expected = banded.solve(of_band, rows, transposed)
        np.testing.assert_allclose(banded.solve(lower, rows, transposed), expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(banded.inverse(alone, lower), banded.inverse(band, of_band)[:, :3], rtol=1e-10)
    np.testing.assert_allclose(banded.outer(rows, 3), banded.outer(rows)[:, :3], rtol=1e-13)
    shapes = np.array([band, covariance(rng, 9, beside=0.0)])
    np.testing.assert_allclose(banded.traces(alone, shapes[:, :, :3]), banded.traces(band, shapes), rtol=1e-13)
    vector = rng.normal(size=27)
    np.testing.assert_allclose(banded.products(shapes[:, :, :3], vector), banded.products(shapes, vector), rtol=1e-12)
