"""The evidence of each attribution against normal densities of all readings at once.

Which units have an effect is enumerated: all subsets of five units, each with the covariance of all readings.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drawn_fleets import Plan, drawn_fleet
from helpers.run_factors import columns_of, readings_of_run
from scipy.special import logsumexp

from kf_calib.effects import Bearer, described
from kf_calib.fleet.attribution import (
    AttributionHypothesis,
    AttributionTable,
    attributed,
    attribution_table,
    chosen,
)
from kf_calib.fleet.campaign import Campaign, Group, sizes
from kf_calib.fleet.own_coefficients import UnitsAndCommon
from kf_calib.fleet.pooled_terms import Attribution, PooledTerms, Term
from kf_calib.fleet.shape import SHARES, SomeUnits, about_zero

UNITS, RUNS = 5, 10
FLEXURE, HYSTERESIS, SECOND_ORDER = "flexure", "hysteresis", "second-order"
BENCH, REPAIRED, SENSORS, SOME, RUN = Attribution


def mean_of(logs: Sequence[float]) -> float:
    """Log of the mean of numbers that are given by their logarithms."""
    return float(logsumexp(logs) - np.log(len(logs)))


@dataclass(frozen=True)
class Readings:
    """A campaign with terms, and all readings of its runs in one vector; rows: of each run, by effect."""

    campaign: Campaign
    terms: PooledTerms
    read: np.ndarray
    rows: dict[str, list[np.ndarray]]
    units: list[str]

    def group(self, name: str) -> Group:
        return next(group for group in self.campaign.groups if group.name == name)

    def of_each(self, name: str, labels: Sequence[object]) -> np.ndarray:
        """Covariance of the readings where an effect has coefficients of size 1, others for each label of runs."""
        same = np.array([[one == other for other in labels] for one in labels], float)
        rows = np.vstack(self.rows[name])
        return rows @ rows.T * np.kron(same, np.ones((len(rows) // RUNS,) * 2))

    def alike(self, name: str) -> np.ndarray:
        """The same where all runs have the same coefficients."""
        return self.of_each(name, [0] * RUNS)

    def log_odds(self, further: np.ndarray, labels: Sequence[object] = ()) -> float:
        """Log of the density of all readings with a further part of their covariance, against that without.

        labels: of the runs that have the same own coefficients of the terms; by default, those of a unit.
        """
        covariance = np.eye(len(self.read))
        for term in self.terms.terms:
            common = term.size if term.attribution is BENCH else term.mean_size
            covariance += common**2 * self.alike(term.group.name)
            if term.attribution is not BENCH:
                covariance += term.size**2 * self.of_each(term.group.name, labels or self.units)
        return self._log_density(covariance + further) - self._log_density(covariance)

    def _log_density(self, covariance: np.ndarray) -> float:
        lower = np.linalg.cholesky(covariance)
        return float(-0.5 * np.sum(np.linalg.solve(lower, self.read) ** 2) - np.log(np.diag(lower)).sum())

    def drawn(self, name: str, labels: Sequence[object]) -> dict[tuple[float, float], float]:
        """Evidence of coefficients of each label that are drawn about a mean, by their spread and the mean's size."""
        alike, apart = self.alike(name), self.of_each(name, labels)
        pairs = [(x, x * ratio) for x in sizes(0.25, self.group(name).largest) for ratio in (0.0, 1.0, 3.0)]
        return {(x, mean): self.log_odds(x**2 * apart + mean**2 * alike, labels) for x, mean in pairs}

    def some(self, name: str) -> dict[tuple[float, frozenset[str]], float]:
        """Evidence that some units have normal coefficients, by their size and who has them, averaged over shares."""
        names, tried = sorted(set(self.units)), sizes(1.0, self.group(name).largest, 2.0**0.5)
        own = {unit: self._of_unit(name, unit) for unit in names}
        logs = dict[tuple[float, frozenset[str]], float]()
        for count in range(UNITS + 1):
            share = mean_of(count * np.log(SHARES) + (UNITS - count) * np.log1p(-SHARES)) - np.log(len(tried))
            for having, size in itertools.product(itertools.combinations(names, count), tried):
                parts = sum((own[unit] for unit in having), np.zeros((len(self.read),) * 2))
                logs[float(size), frozenset(having)] = share + self.log_odds(size**2 / 3.0 * parts)
        return logs

    def _of_unit(self, name: str, unit: str) -> np.ndarray:
        rows = np.vstack([part * (label == unit) for part, label in zip(self.rows[name], self.units, strict=True)])
        return rows @ rows.T


def readings_of(seed: int, affected: int, *known: str, their_mean: float = 12.0) -> Readings:
    """Of two runs of each of five units on one bench, with terms of the effects that are known."""
    plan = Plan(units=UNITS, benches=1, runs_each=RUNS // UNITS, affected=affected, their_mean=their_mean)
    fleet = drawn_fleet(plan, np.random.default_rng(seed))
    campaign = Campaign(fleet.runs)
    groups = {group.name: group for group in campaign.groups}
    terms = {FLEXURE: Term(groups[FLEXURE], BENCH, plan.of_bench),
             HYSTERESIS: Term(groups[HYSTERESIS], SENSORS, plan.spread, mean_size=plan.mean)}  # fmt: skip
    rows = {name: [columns_of(run, group) for run in fleet.runs] for name, group in groups.items()}
    read = np.concatenate(list(map(readings_of_run, fleet.runs)))
    return Readings(campaign, PooledTerms([terms[name] for name in known], 1), read, rows, [r.unit for r in fleet.runs])


def told_by_units(readings: Readings, name: str) -> UnitsAndCommon:
    """What units tell of an effect beside the terms."""
    parts = [UnitsAndCommon.of(readings.group(name), readings.terms, readings.terms.beside_own(blocks))
             for blocks in readings.campaign.units()]  # fmt: skip
    return UnitsAndCommon.joined(parts)


@pytest.fixture(scope="module", params=[(3, 5, FLEXURE), (3, 3, FLEXURE, HYSTERESIS), (4, 2)], ids=str)
def readings(request: pytest.FixtureRequest) -> Readings:
    return readings_of(*request.param)


@pytest.fixture(scope="module")
def table(readings: Readings) -> AttributionTable:
    return attribution_table(readings.campaign, readings.terms)


def test_coefficients_of_each_run_and_of_a_bench_have_the_evidence_of_normal_densities(
    readings: Readings, table: AttributionTable
) -> None:
    """What is known to be each unit's own counts as each run's own there."""
    runs = range(RUNS)
    rows = [row for row in table.hypotheses if row.attribution in (RUN, BENCH)]
    assert {row.name for row in rows} == {group.name for group in readings.campaign.groups} - readings.terms.names()
    for row in rows:
        if row.attribution is BENCH:
            tried = sizes(0.5 / np.sqrt(RUNS), row.term.group.largest)
            logs = {(x, 0.0): readings.log_odds(x**2 * readings.alike(row.name), runs) for x in tried}
        else:
            logs = readings.drawn(row.name, runs)
        assert row.log_odds == pytest.approx(mean_of([*logs.values()]), rel=1e-6)
        assert (row.term.size, row.term.mean_size) == pytest.approx(max(logs, key=lambda pair: logs[pair]))


@pytest.mark.slow
def test_coefficients_of_units_have_the_evidence_of_normal_densities(
    readings: Readings, table: AttributionTable
) -> None:
    """Of units that are drawn about a mean, as it is; of normal ones of some units, to half a unit of the logarithm.

    The other shapes differ from the normal one as what units tell by themselves says.
    """
    rows = {(row.name, row.attribution): row for row in table.hypotheses}
    names, explained = [name for name, attribution in rows if attribution is SOME], dict[str, float]()
    assert SECOND_ORDER in names and "thermal-bias" in names
    for name in names:
        group, alone = readings.group(name), told_by_units(readings, name).integrated()
        drawn = readings.drawn(name, readings.units)
        normal = float(logsumexp([*readings.some(name).values()]))
        beside_others = normal - about_zero(group, alone, 0).log_odds
        some, about = SomeUnits(group, alone), rows[name, SENSORS]
        every = np.logaddexp(mean_of([*drawn.values()]), some.log_odds_of_all + beside_others) - np.log(2.0)
        assert rows[name, SOME].log_odds == pytest.approx(some.log_odds + beside_others, abs=0.6)
        assert about.log_odds == pytest.approx(every, abs=0.6)
        assert (about.term.size, about.term.mean_size) == pytest.approx(max(drawn, key=lambda pair: drawn[pair]))
        explained[name] = some.log_odds - rows[name, SOME].log_odds
    if readings.terms.terms:  # what all have in common explains much of what units tell by themselves
        assert max(explained.values()) > 3.0


def test_probabilities_are_those_of_the_priors_that_are_said(table: AttributionTable) -> None:
    """One half for none; else all effects alike, and what is of single runs or was repaired a quarter as likely."""
    names = list(dict.fromkeys(row.name for row in table.hypotheses))
    logs = list[float]()
    for row in table.hypotheses:
        usual = {one.attribution: 0.25 if one.attribution in (RUN, REPAIRED) else 1.0
                 for one in table.hypotheses if one.name == row.name}  # fmt: skip
        logs.append(row.log_odds + np.log(0.5 / len(names) * usual[row.attribution] / sum(usual.values())))
    every = np.exp(np.array([np.log(0.5), *logs]) - logsumexp([np.log(0.5), *logs]))
    assert table.none == pytest.approx(every[0], abs=1e-12)
    np.testing.assert_allclose(table.probabilities, every[1:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("seed", "their_mean"), [(1, 2.5), (2, 2.5), (5, 4.0)])
def test_who_has_an_effect_is_as_probable_as_enumeration_says(seed: int, their_mean: float) -> None:
    """Of normal coefficients; the term names the units that have it rather than not, and those that may have it."""
    readings = readings_of(seed, 2, FLEXURE, their_mean=their_mean)
    group, alone = readings.group(SECOND_ORDER), told_by_units(readings, SECOND_ORDER).integrated()
    logs = readings.some(SECOND_ORDER)
    whole = logsumexp([*logs.values()])
    truth = [np.exp(logsumexp([log for (_, having), log in logs.items() if unit in having]) - whole)
             for unit in alone.units]  # fmt: skip
    np.testing.assert_allclose(about_zero(group, alone, 0).probabilities, truth, atol=0.1)
    table = attribution_table(readings.campaign, readings.terms)
    term = next(row.term for row in table.hypotheses if (row.name, row.attribution) == (SECOND_ORDER, SOME))
    chances = dict(zip(alone.units, SomeUnits(group, alone).probabilities.tolist(), strict=True))
    assert term.units == {unit for unit, chance in chances.items() if chance > 0.5}
    assert term.unsure == {unit for unit, chance in chances.items() if 0.05 < chance <= 0.5}


def hypotheses_of(probabilities: dict[tuple[str, Attribution], float]) -> AttributionTable:
    """A table of effects that may be anything."""
    groups = {name: Group(name, slice(0, 1), ("c",), 1.0, 64.0, Bearer.EITHER) for name, _ in probabilities}
    rows = [
        AttributionHypothesis(Term(groups[name], attribution, 1.0), 0.0, 0.0) for name, attribution in probabilities
    ]
    return AttributionTable(tuple(rows), np.array([*probabilities.values()]), 1.0 - sum(probabilities.values()))


def test_the_likeliest_effect_is_taken_and_first_whether_it_is_of_the_bench() -> None:
    """Then how: the likeliest single row would be another."""
    other = {("flexure", BENCH): 0.3, ("flexure", SENSORS): 0.02}
    table = hypotheses_of(other | {("drift", BENCH): 0.25, ("drift", SENSORS): 0.1, ("drift", SOME): 0.18})
    assert list(table.effects().items()) == [("drift", pytest.approx(0.53)), ("flexure", pytest.approx(0.32))]
    assert (chosen(table).name, chosen(table).attribution) == ("drift", SOME)
    table = hypotheses_of(other | {("drift", BENCH): 0.15, ("drift", REPAIRED): 0.14, ("drift", SENSORS): 0.2})
    assert (chosen(table).name, chosen(table).attribution) == ("drift", BENCH)
    assert table.of("drift") == {BENCH: 0.15, REPAIRED: 0.14, SENSORS: 0.2} and table.none == pytest.approx(0.19)


@pytest.mark.slow
def test_effects_are_taken_until_none_more_is_probable_and_each_beside_all_others() -> None:
    """The last table of each term is that beside the others, whatever was known when it was first taken."""
    campaign = readings_of(3, 5).campaign
    taken = attributed(campaign)
    kinds = {term.group.name: term.attribution.common for term in taken.terms}
    assert kinds == {FLEXURE: True, HYSTERESIS: False, SECOND_ORDER: False}
    assert taken.rest.none > 0.01
    for term, table in zip(taken.terms, taken.tables, strict=True):
        others = [other for other in taken.terms if other is not term]
        again = attribution_table(campaign, PooledTerms(others, 1))
        assert table.none < 0.01 and chosen(again).term == term
        assert table.of(term.group.name) == pytest.approx(again.of(term.group.name), abs=0.02)


def test_the_sigma_of_an_effect_is_that_of_a_run_that_sees_it_and_zero_where_none_does() -> None:
    """By the mean information of coefficients over the runs that see them; sizes go up to 64 sigma, or, where more is
    usual, to that."""
    one, other = (1e12 * np.diag(own) for own in ([4.0, 9.0, 0.0, 0.0], [8.0, 0.0, 0.0, 0.0]))
    runs: Any = SimpleNamespace(_run_information=lambda: [(None, one, None), (None, other, None)])
    hysteresis, unseen, formula = Campaign._sized(runs, {HYSTERESIS: "hk", SECOND_ORDER: "q", "mine = T": "c"})
    assert hysteresis.sigma == pytest.approx((1e12 * (6.0 + 9.0) / 2.0) ** -0.5)
    effect = described(HYSTERESIS)
    assert effect is not None and effect.typical.mems is not None
    assert hysteresis.largest == pytest.approx(effect.typical.mems[1] / hysteresis.sigma)
    assert (unseen.sigma, unseen.largest) == (formula.sigma, formula.largest) == (0.0, 64.0)
