"""The likelihoods of many runs against what they are by definition, from all rows at once."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.run_factors import campaign_of, run_factor_of
from scipy.stats import multivariate_normal

from kf_calib.fleet.campaign import Campaign
from kf_calib.fleet.evidence import log_evidence, log_evidence_of_modes, modes, posterior
from kf_calib.fleet.pooled_terms import Attribution, PooledTerms, Term
from kf_calib.fleet.population import Own, population
from kf_calib.fleet.some_units import SomeUnits


def test_log_evidence_is_the_ratio_of_normal_densities() -> None:
    rng = np.random.default_rng(1)
    columns, readings, prior = rng.standard_normal((9, 3)), rng.standard_normal(9), np.array([0.5, 2.0, 0.0])
    covariance = np.eye(9) + columns @ np.diag(prior**2) @ columns.T
    truth = multivariate_normal(cov=covariance).logpdf(readings) - multivariate_normal(cov=np.eye(9)).logpdf(readings)
    info, score = columns.T @ columns, columns.T @ readings
    assert float(log_evidence(info, score, prior)) == pytest.approx(truth, rel=1e-10)
    values, along, _ = modes(info, score)
    same = log_evidence(info, score, np.full(3, 0.7))
    assert float(log_evidence_of_modes(values, along, 0.7)) == pytest.approx(float(same), rel=1e-10)


def test_common_coefficients_are_those_of_one_least_squares_of_all_runs() -> None:
    """With the own coefficients of each unit, drawn about a mean, as further columns with a prior."""
    runs, spread = [run_factor_of(k, unit=f"unit{k // 2}") for k in range(6)], 0.8
    campaign = Campaign(runs)
    groups = {group.name: group for group in campaign.groups}
    bench = Term(groups["flexure"], Attribution.BENCH, 3.0)
    own = Term(groups["second-order"], Attribution.SENSORS, spread, mean_size=2.0)
    mean, covariance = PooledTerms([bench, own], 1).solved(campaign)

    def columns(name: str, run: int) -> np.ndarray:
        factor, group = runs[run], groups[name]
        places = [factor.places[f"{name}/{symbol}"] for symbol in group.symbols]
        return factor.factor[factor.width :, places] * group.sigma

    rows = list[np.ndarray]()
    for k, run in enumerate(runs):
        units = np.zeros((3, len(columns("flexure", k)), 3))
        units[k // 2] = columns("second-order", k)
        parts = [columns("flexure", k), columns("second-order", k), *units]
        rows.append(np.column_stack([*parts, run.factor[run.width :, -1]]))
    sizes = np.repeat([3.0, 2.0, spread], [3, 3, 9])
    rows.append(np.column_stack([np.diag(1.0 / sizes), np.zeros(15)]))
    stacked = np.vstack(rows)
    truth = np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=None)[0]
    inverse = np.linalg.inv(stacked[:, :-1].T @ stacked[:, :-1])
    np.testing.assert_allclose(mean, truth[:6], rtol=1e-7)
    np.testing.assert_allclose(covariance, inverse[:6, :6], rtol=1e-7, atol=1e-12)


def test_runs_of_a_unit_are_summed_however_they_are_mixed() -> None:
    runs = [run_factor_of(k, unit=f"unit{k % 70}") for k in range(140)]
    found = {
        label: info for blocks in Campaign(runs).units() for label, info in zip(blocks.labels, blocks.info, strict=True)
    }
    each = np.concatenate([blocks.info for blocks in Campaign(runs).runs()])
    assert len(found) == 70
    np.testing.assert_allclose(found["unit3"], each[3] + each[73])


def test_spread_is_that_of_an_analysis_of_variance_where_units_are_alike() -> None:
    """Balanced units of unit information: REML is the variance of the estimates less that of their noise."""
    estimates = np.random.default_rng(2).normal(0.5, 2.0, 50)
    own = Own([""] * 50, np.ones((50, 1, 1)), estimates[:, None])
    found = population(own, 64.0)
    assert found.spread == pytest.approx(np.sqrt(np.var(estimates, ddof=1) - 1.0), rel=0.03)
    assert found.mean[0] == pytest.approx(estimates.mean(), rel=1e-6)
    assert found.spread_interval[0] < 2.0 < found.spread_interval[1]


def test_no_spread_is_found_in_noise() -> None:
    estimates = np.random.default_rng(3).normal(0.0, 0.9, 50)
    assert population(Own([""] * 50, np.ones((50, 1, 1)), estimates[:, None]), 64.0).spread < 0.1


def test_posterior_without_information_is_the_prior() -> None:
    mean, covariance = posterior(np.zeros((2, 2)), np.zeros(2), np.array([1.0, 3.0]))
    np.testing.assert_allclose(mean, 0.0)
    np.testing.assert_allclose(covariance, np.diag([1.0, 9.0]))


def test_share_of_the_units_covers_the_truth_as_often_as_it_says() -> None:
    group, rng, inside = Campaign(campaign_of(2)).groups[0], np.random.default_rng(4), 0
    for _ in range(20):
        has, drawn = rng.permutation(40) < rng.integers(4, 37), rng.standard_normal((40, 3))
        sizes = 4.0 * has[:, None] / np.linalg.norm(drawn, axis=1, keepdims=True)
        scores = rng.standard_normal((40, 3)) + sizes * drawn
        some = SomeUnits(group, Own([""] * 40, np.tile(np.eye(3), (40, 1, 1)), scores))
        low, high = some.share(0.0)[1]
        inside += low <= has.mean() <= high
    assert inside >= 17
