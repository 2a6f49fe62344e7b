"""The likelihoods of many runs against what they are by definition, from all rows at once."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.run_factors import campaign_of, columns_of, readings_of_run, run_factor_of
from scipy.linalg import block_diag
from scipy.special import logsumexp
from scipy.stats import binom, chi2, multivariate_normal, norm

from kf_calib.fleet.campaign import Campaign, log_evidence, log_evidence_of_modes, modes, posterior, sizes
from kf_calib.fleet.own_coefficients import UnitInformation, UnitsAndCommon, population
from kf_calib.fleet.pooled_terms import Attribution, DatedSums, PooledTerms, Sums, Term
from kf_calib.fleet.shape import POWERS, SHARES, CoefficientShape, SomeUnits, _likeliest, _told, about_mean, about_zero


def beside_nothing(own: UnitInformation) -> UnitsAndCommon:
    """What units tell where nothing is common to them."""
    count, width = own.score.shape
    return UnitsAndCommon(own, np.zeros((count, width, 0)), Sums(np.zeros((0, 0)), np.zeros(0)), np.zeros(0))


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
    terms = PooledTerms([bench, own], 1)
    first, *others = [terms.sums(terms.beside_own(blocks)) for blocks in campaign.units()]
    total = sum(others, first)
    mean, covariance = posterior(total.info, total.score, terms.prior)

    columns = lambda name, run: columns_of(runs[run], groups[name])  # noqa: E731
    rows = list[np.ndarray]()
    for k, run in enumerate(runs):
        units = np.zeros((3, len(columns("flexure", k)), 3))
        units[k // 2] = columns("second-order", k)
        parts = [columns("flexure", k), columns("second-order", k), *units]
        rows.append(np.column_stack([*parts, readings_of_run(run)]))
    sizes = np.repeat([3.0, 2.0, spread], [3, 3, 9])
    rows.append(np.column_stack([np.diag(1.0 / sizes), np.zeros(15)]))
    stacked = np.vstack(rows)
    truth = np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=None)[0]
    inverse = np.linalg.inv(stacked[:, :-1].T @ stacked[:, :-1])
    np.testing.assert_allclose(mean, truth[:6], rtol=1e-7)
    np.testing.assert_allclose(covariance, inverse[:6, :6], rtol=1e-7, atol=1e-12)


def test_the_evidence_of_an_error_of_a_bench_and_of_its_repair_is_that_of_normal_densities() -> None:
    """Of the readings of eight runs on two benches, in which the runs of a bench have the same tilt, or those of one
    bench another one from some run on: averaged over sizes of the tilt, dates, benches, and errors on both sides or one
    side of a repair."""
    broken = {"base-tilt": np.array([9.0, -6.0])}
    runs = [run_factor_of(k, lambda k: broken if k in (3, 5) else {}, bench=f"bench {k % 2}") for k in range(8)]
    campaign = Campaign(runs)
    (tilt,) = (group for group in campaign.groups if group.name == "base-tilt")
    rows = np.vstack([columns_of(run, tilt) for run in runs])
    readings, run_of_row = np.concatenate(list(map(readings_of_run, runs))), np.repeat(range(8), len(rows) // 8)

    def log_odds(*parts: Sequence[int], size: float) -> float:
        """Where the runs of each part have the same tilt, of this size."""
        columns = [rows * np.isin(run_of_row, part)[:, None] for part in parts]
        covariance = np.eye(len(rows)) + size**2 * sum(each @ each.T for each in columns)
        return float(multivariate_normal(cov=covariance).logpdf(readings) - norm.logpdf(readings).sum())

    def mean(logs: Sequence[float]) -> float:
        return float(logsumexp(logs) - np.log(len(logs)))

    dated = DatedSums.of(campaign, PooledTerms([], 2))
    benches, tried = [[0, 2, 4, 6], [1, 3, 5, 7]], sizes(0.5 / np.sqrt(8.0), tilt.largest)
    logs = [log_odds(*benches, size=size) for size in tried]
    constant = dated.constant(tilt)
    assert constant.log_odds == pytest.approx(mean(logs), rel=1e-6)
    assert constant.term.size == pytest.approx(tried[int(np.argmax(logs))])

    coarse = sizes(0.5 / np.sqrt(8.0), tilt.largest, 4.0)
    sides = {
        (bench, first): [[before, after], [before], [after]]
        for bench in (0, 1) for first in (1, 2, 3)
        for before, after in [(benches[bench][:first], benches[bench][first:])]
    }  # fmt: skip
    by_date = {
        (bench, first): [mean([log_odds(benches[1 - bench], *parts, size=size) for parts in each]) for size in coarse]
        for (bench, first), each in sides.items()
    }
    repaired, best = dated.repaired(tilt), max(by_date, key=lambda date: max(by_date[date]))
    assert repaired is not None
    assert repaired.log_odds == pytest.approx(mean([log for logs in by_date.values() for log in logs]), rel=1e-6)
    assert repaired.term.repair == (best[0], benches[best[0]][best[1]])
    assert repaired.term.size == pytest.approx(coarse[int(np.argmax(by_date[best]))])


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
    own = UnitInformation([""] * 50, np.ones((50, 1, 1)), estimates[:, None])
    found = population(beside_nothing(own), np.ones(50, bool), 64.0)
    assert found is not None and found.spread == pytest.approx(np.sqrt(np.var(estimates, ddof=1) - 1.0), rel=0.03)
    assert found.mean[0] == pytest.approx(estimates.mean(), rel=1e-6)
    assert found.spread_interval[0] < 2.0 < found.spread_interval[1]


def test_no_spread_is_found_in_noise() -> None:
    estimates = np.random.default_rng(3).normal(0.0, 0.9, 50)
    own = UnitInformation([""] * 50, np.ones((50, 1, 1)), estimates[:, None])
    found = population(beside_nothing(own), np.ones(50, bool), 64.0)
    assert found is not None and found.spread < 0.1 and found.spread_interval[0] == 0.0


def bent_units() -> tuple[UnitsAndCommon, list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """What five units tell of their second-order terms beside the flexure of one bench, and the rows this is from:
    columns of the bench, of the units, and readings."""
    runs = [run_factor_of(k, lambda _: {"flexure": np.array([3.0, -2.0, 5.0])}) for k in range(5)]
    campaign = Campaign(runs)
    groups = {group.name: group for group in campaign.groups}
    terms = PooledTerms([Term(groups["flexure"], Attribution.BENCH, 1.0).free()], 1)
    told = UnitsAndCommon.joined([UnitsAndCommon.of(groups["second-order"], terms, part) for part in campaign.units()])

    of_bench, of_units = ([columns_of(run, groups[name]) for run in runs] for name in ("flexure", "second-order"))
    return told, of_bench, of_units, [readings_of_run(run) for run in runs]


def test_coefficients_of_units_are_those_of_one_least_squares_in_which_all_are_free() -> None:
    told, of_bench, of_units, readings = bent_units()
    rows = np.hstack([np.vstack(of_bench), block_diag(*of_units)])
    truth = np.linalg.lstsq(rows, np.concatenate(readings), rcond=None)[0]
    covariance = np.linalg.inv(rows.T @ rows)
    for k, (mean, own) in enumerate(told.integrated().estimates()):
        place = slice(3 + 3 * k, 6 + 3 * k)
        np.testing.assert_allclose(mean, truth[place], rtol=1e-6)
        np.testing.assert_allclose(own, covariance[place, place], rtol=1e-6, atol=1e-9)


def test_population_beside_a_bench_is_that_of_generalised_least_squares() -> None:
    """Mean, its covariance and the ends of the interval, of four of five units, from the covariance of all readings."""
    told, of_bench, of_units, readings = bent_units()
    members = np.arange(5) != 2
    found = population(told, members, 64.0)
    assert found is not None
    free = np.zeros((sum(map(len, readings)), 3))
    free[len(readings[0]) + len(readings[1]) :][: len(readings[2])] = of_units[2]
    mean = np.vstack([rows * here for rows, here in zip(of_units, members, strict=True)])
    fixed, whole = np.hstack([mean, np.vstack(of_bench), free]), np.concatenate(readings)

    def fit(spread: float) -> tuple[np.ndarray, np.ndarray, float]:
        covariance = np.eye(len(whole)) + spread**2 * block_diag(
            *(rows @ rows.T * here for rows, here in zip(of_units, members, strict=True))
        )
        weight = np.linalg.inv(covariance)
        inverse = np.linalg.inv(fixed.T @ weight @ fixed)
        estimate = inverse @ fixed.T @ weight @ whole
        left = whole - fixed @ estimate
        return estimate[:3], inverse[:3, :3], float(left @ weight @ left)

    estimate, covariance, _ = fit(found.spread)
    np.testing.assert_allclose(found.mean, estimate, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5, atol=1e-8)
    apart = fit(1e5)[2]  # what no spread explains
    assert found.spread_interval[1] > 0.0
    for spread, tail in zip(found.spread_interval, (0.975, 0.025), strict=True):
        misfit = fit(spread)[2] - apart
        if spread:
            assert misfit == pytest.approx(chi2.ppf(tail, 9), rel=1e-3)
        else:
            assert misfit < chi2.ppf(tail, 9)


@pytest.mark.parametrize("draws", [40, *slow(200)])
@pytest.mark.parametrize("units", [2, 8, *slow(3)])
def test_interval_of_the_spread_holds_the_truth_however_few_the_units(units: int, draws: int) -> None:
    """Of one coefficient with unequal sigmas, and a spread as large as these: 95 % of the draws, but for 3.5 sigma."""
    rng, inside, spread = np.random.default_rng(units), 0, 1.0
    for _ in range(draws):
        sigmas = rng.uniform(0.3, 2.0, units)
        values = rng.normal(3.0, np.hypot(spread, sigmas))
        own = UnitInformation([""] * units, sigmas[:, None, None] ** -2, (values / sigmas**2)[:, None])
        found = population(beside_nothing(own), np.ones(units, bool), 64.0)
        assert found is not None
        inside += found.spread_interval[0] <= spread <= found.spread_interval[1]
    off = 3.5 * np.sqrt(0.95 * 0.05 * draws)
    assert 0.95 * draws - off < inside <= min(0.95 * draws + off, draws)


def test_one_unit_has_no_spread() -> None:
    own = UnitInformation(["a", "b"], np.ones((2, 1, 1)), np.ones((2, 1)))
    assert population(beside_nothing(own), np.array([True, False]), 64.0) is None


def test_posterior_without_information_is_the_prior() -> None:
    mean, covariance = posterior(np.zeros((2, 2)), np.zeros(2), np.array([1.0, 3.0]))
    np.testing.assert_allclose(mean, 0.0)
    np.testing.assert_allclose(covariance, np.diag([1.0, 9.0]))


@pytest.mark.parametrize("power", POWERS)
def test_evidence_of_any_direction_is_the_integral_of_likelihood_times_density(power: int) -> None:
    """Of one unit that sees one direction better than the other, on a grid of its coefficients."""
    info, score = np.diag([0.3, 1.7]), np.array([0.4, 3.0])
    own = UnitInformation(["unit"], info[None], score[None])
    shape = about_zero(Campaign(campaign_of(2)).groups[0], own, power)
    place, tilt = 2, power / (power + 1.0)
    size = shape.sizes[0, place] * np.sqrt(2.0)
    seen = np.diag(info) ** (1.0 - tilt) if power else np.diag(info)
    variances = seen / (seen.mean() if power else 1.0) * size**2 / (2 * power + 2) / np.diag(info)
    grid = np.linspace(-40.0, 40.0, 1001)
    c = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    squares = c**2 @ np.diag(info)
    density = squares**power * np.exp(-0.5 * c**2 @ (1.0 / variances))
    likelihood = np.exp(c @ score - 0.5 * squares)
    truth = np.log((density * likelihood).sum() / density.sum())
    assert float(shape.ratios(slice(1))[0, 0, place]) == pytest.approx(truth, rel=1e-5)


@pytest.mark.parametrize(
    ("mean", "spread", "having", "units", "allowed"),
    [(3.0, 0.0, 6, 10, 0.2), *slow((40.0, 0.3, 6, 12, 0.02), (20.0, 20.0, 20, 20, 0.02))],
)
def test_evidence_about_a_mean_is_the_integral_over_the_mean(
    mean: float, spread: float, having: int, units: int, allowed: float
) -> None:
    """Of units with one coefficient each, of which some have it, on a grid of the mean, whose size is one, three or ten
    spreads; exact where it is clear who has it."""
    scores = np.random.default_rng(5).standard_normal((units, 1))
    scores[:having] += np.random.default_rng(7).normal(mean, spread, (having, 1))
    shape = about_mean(UnitInformation([""] * units, np.ones((units, 1, 1)), scores))
    grid, logs = np.linspace(-120.0, 120.0, 3841), list[float]()
    for size in sizes(0.25, 64.0):
        likelihood = np.zeros((len(SHARES), len(grid)))
        for score in scores:
            has = norm(grid, np.hypot(1.0, size)).logpdf(score) - norm.logpdf(score)
            likelihood += np.logaddexp(np.log(SHARES)[:, None] + has, np.log1p(-SHARES)[:, None])
        prior = [norm.logpdf(grid, scale=ratio * size) + np.log(grid[1] - grid[0]) for ratio in (1.0, 3.0, 10.0)]
        logs += [float(logsumexp(likelihood + each)) for each in prior]
    assert shape.log_odds == pytest.approx(logsumexp(logs) - np.log(len(logs) * len(SHARES)), abs=allowed)


def test_the_likeliest_mean_of_some_units_is_where_likelihood_times_prior_is_largest() -> None:
    """Its derivatives by differences vanish, against those at a tenth of a sigma beside it, for each share of units."""
    rng, spread, prior = np.random.default_rng(9), 0.4, 3.0
    own = rng.normal(size=(30, 2, 3))
    info = own @ np.swapaxes(own, 1, 2)
    scores = (info @ (np.array([2.0, -1.5]) * (np.arange(30) < 14)[:, None])[:, :, None])[:, :, 0]
    told = _told(modes(info, scores + rng.normal(size=(30, 2))), spread)
    mean = _likeliest(told, prior)

    def logs(at: np.ndarray) -> np.ndarray:
        shares = SHARES[:, None]
        each = np.logaddexp(np.log(shares) + told.ratios(at), np.log1p(-shares))
        return each.sum(axis=1) - 0.5 * np.sum((at / prior) ** 2, axis=1)

    for axis in np.eye(2):
        slopes, beside = ((logs(at + 1e-4 * axis) - logs(at - 1e-4 * axis)) / 2e-4 for at in (mean, mean + 0.1 * axis))
        assert np.abs(slopes).max() < 0.05 * np.abs(beside).min()


@pytest.mark.parametrize("alike", [False, True])
def test_share_covers_the_truth_where_units_hardly_tell_who_has_the_effect(alike: bool) -> None:
    """Half of them have 2.5 sigma in a direction of their own, or all the same; one direction is seen far better."""
    group, rng, inside = Campaign(campaign_of(2)).groups[0], np.random.default_rng(4), 0
    info = np.diag([0.04, 0.04, 2.9])
    for _ in range(8):
        drawn = np.tile(rng.standard_normal(3), (40, 1)) if alike else rng.standard_normal((40, 3))
        norms = np.sqrt(np.einsum("ni,ij,nj->n", drawn, info, drawn))
        truth = drawn * (2.5 / norms * (rng.permutation(40) < 20))[:, None]
        scores = truth @ info + rng.standard_normal((40, 3)) * np.sqrt(np.diag(info))
        some = SomeUnits(group, UnitInformation([""] * 40, np.tile(info, (40, 1, 1)), scores))
        every = 1.0 / (1.0 + np.exp(some.log_odds - some.log_odds_of_all))
        low, high = some.share(float(every))[1]
        inside += low <= 0.5 <= high
    assert inside >= 7


def test_the_share_of_units_that_have_an_effect_is_within_the_quantiles_of_their_number() -> None:
    """400 units that each have it with 30 %: a binomial number of them, and its 95 %."""
    odds = [(np.zeros((200, 1, 1)), np.full((200, 1, 1), np.log(0.3)))] * 2
    shape: Any = SimpleNamespace(units=400, _logs=np.zeros((1, 1)), _odds=lambda: odds)
    np.testing.assert_allclose(
        CoefficientShape.interval(shape), binom.ppf([0.025, 0.975], 400, 0.3) / 400, atol=1.5 / 400
    )
