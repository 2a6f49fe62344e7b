"""Intervals of units, benches and spreads hold the truth as often as they say, of fleets that are drawn in numpy alone.

In each, all benches have a flexure and all units a hysteresis about a mean, and none, one, two or half of the units
have a second-order term; columns of the three overlap. Nothing of the simulator or the estimator draws them.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_generator import Campaign
from helpers.drawn_fleets import SYMBOLS, DrawnFleet, Plan, drawn_fleet

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.calibration import calibrate
from kf_calib.fleet.pooled_diagnosis import Finding, PooledDiagnosis, PooledEstimate, pooled_diagnosis
from kf_calib.fleet.pooled_terms import Attribution
from kf_calib.fleet.run_factor import RunFactor, run_factor

LEVEL = 1.959964
Covered = dict[tuple[str, str], list[bool]]
"""Whether each interval held the truth, by what it was of and by how many units were affected."""


def plan_of(number: int, rng: np.random.Generator, most: int = 30) -> tuple[Plan, str]:
    """A fleet of any size, and how many units of it are affected."""
    units, benches, runs = (int(rng.integers(*ends)) for ends in ((3, most + 1), (1, 4), (1, 4)))
    affected = {"none": 0, "one": 1, "two": 2, "half": units // 2}
    kind = list(affected)[number % 4]
    return Plan(units, benches, runs, affected[kind]), kind


def counted(numbers: Iterable[int], seed: int, most: int = 30) -> Covered:
    """Draw fleets, diagnose each, and count."""
    covered: Covered = defaultdict(list)
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        plan, kind = plan_of(number, rng, most)
        fleet = drawn_fleet(plan, rng)
        for what, inside in of_fleet(fleet, pooled_diagnosis(fleet.runs)):
            covered[what, kind].append(inside)
    return covered


def of_fleet(fleet: DrawnFleet, found: PooledDiagnosis) -> Iterable[tuple[str, bool]]:
    """Yield what each interval of a diagnosis is of, and whether it holds the truth."""
    findings = {each.effect: each for each in found.findings}
    if bent := findings.get("flexure"):
        for bench in bent.benches:
            yield from (("bench", each) for each in inside(bench.coefficients, fleet.flexure[bench.bench]))
    for effect, truth, spread in (
        ("hysteresis", fleet.hysteresis, fleet.plan.spread),
        ("second-order", fleet.second_order, fleet.plan.their_spread),
    ):
        if own := findings.get(effect):
            yield from of_units(own, truth)
            if own.population is not None:
                low, high = own.population.spread_interval
                yield "spread", low <= spread <= high


def of_units(finding: Finding, truth: Mapping[str, Floats]) -> Iterable[tuple[str, bool]]:
    for unit in finding.units:
        affected = finding.effect == "second-order" and truth[unit.unit].any()
        what = "affected unit" if affected else "unit"
        yield from ((what, each) for each in inside(unit.coefficients, truth[unit.unit]))


def inside(estimates: Sequence[PooledEstimate], truth: Floats) -> Iterable[bool]:
    for each, value in zip(estimates, truth.tolist(), strict=True):
        assert each.value is not None and each.sigma
        yield abs(each.value - value) < LEVEL * each.sigma


def share_of(covered: Covered, what: str, kind: str | None = None) -> tuple[float, int]:
    """The share of intervals that held the truth, and their number."""
    own = [one for (name, of), every in covered.items() if name == what and kind in (None, of) for one in every]
    return float(np.mean(own)) if own else np.nan, len(own)


@pytest.mark.slow
def test_coverage_of_300_fleets() -> None:
    covered = counted(range(300), seed=7)
    for what in ("bench", "unit", "affected unit", "spread"):
        share, count = share_of(covered, what)
        assert count > 400 and 0.93 <= share <= 0.97, (what, share, count)
        for kind in ("none", "one", "two", "half"):
            share, count = share_of(covered, what, kind)
            allowed = 0.02 + 2.0 * np.sqrt(0.95 * 0.05 / max(count, 1))  # that few of them scatter by chance
            assert not count or abs(share - 0.95) <= allowed, (what, kind, share, count)


@pytest.mark.slow
@pytest.mark.parametrize("fleets", [4, 8])
def test_coverage_of_small_fleets(fleets: int) -> None:
    covered = counted(range(fleets), seed=3, most=6)
    for what in ("bench", "unit", "affected unit", "spread"):
        share, count = share_of(covered, what)
        assert abs(share - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / count), (what, share, count)


def free_fit(runs: Sequence[RunFactor], effects: Sequence[str]) -> tuple[Floats, Floats]:
    """Values and sigmas of effects from some runs alone, by least squares of their rows."""
    names = [f"{effect}/{symbol}" for effect in effects for symbol in SYMBOLS[effect]]
    rows = np.vstack([run.factor[run.width :, [*(run.places[name] for name in names), -1]] for run in runs])
    inverse = np.linalg.inv(rows[:, :-1].T @ rows[:, :-1])
    return inverse @ rows[:, :-1].T @ rows[:, -1], np.sqrt(np.diag(inverse))


@pytest.mark.slow
def test_one_affected_unit_of_ten_has_what_its_own_three_runs_say() -> None:
    """Its sigma is between that of its runs where all else is known, and where all else is known from them alone."""
    plan = Plan(units=10, benches=1, runs_each=3, affected=1, their_mean=30.0, their_spread=0.0)
    fleet = drawn_fleet(plan, np.random.default_rng(11))
    (name,) = (unit for unit, own in fleet.second_order.items() if own.any())
    finding = next(each for each in pooled_diagnosis(fleet.runs).findings if each.effect == "second-order")
    assert finding.attribution is Attribution.SOME
    (unit,) = (each for each in finding.units if each.unit == name)
    assert [each.unit for each in finding.units if each.probability > 0.5] == [name] and finding.population is None
    own = [run for run in fleet.runs if run.unit == name]
    least, most = free_fit(own, ["second-order"])[1], free_fit(own, ["flexure", "hysteresis", "second-order"])[1]
    for each, truth, low, high in zip(unit.coefficients, fleet.second_order[name], least, most[6:], strict=True):
        assert each.value is not None and each.sigma is not None
        assert low < each.sigma < high and abs(each.value - truth) < 3.5 * each.sigma


def test_one_bent_bench_of_three_has_what_its_own_runs_say() -> None:
    fleet = drawn_fleet(Plan(9, 3, 1, 0, of_bench=0.0, mean=0.0, spread=0.0), np.random.default_rng(12))
    bent = drawn_fleet(Plan(9, 3, 1, 0, of_bench=30.0, mean=0.0, spread=0.0), np.random.default_rng(12))
    runs = [one if one.bench == "bench 1" else two for one, two in zip(bent.runs, fleet.runs, strict=True)]
    (finding,) = pooled_diagnosis(runs).findings
    assert finding.attribution is Attribution.BENCH
    values = {each.bench: each.coefficients for each in finding.benches}
    for bench, estimates in values.items():
        value, sigma = free_fit([run for run in runs if run.bench == bench], ["flexure"])
        np.testing.assert_allclose([each.value or 0.0 for each in estimates], value, rtol=1e-6)
        np.testing.assert_allclose([each.sigma or 0.0 for each in estimates], sigma, rtol=1e-6)


def simulated(campaign: Campaign) -> tuple[list[RunFactor], dict[str, Floats]]:
    """The factors of a campaign that is simulated reading by reading, and the coefficients of each affected unit."""
    factors, truth = list[RunFactor](), dict[str, Floats]()
    for number in range(campaign.runs):
        plain, hidden = campaign.simulation(number), campaign.effects(number)
        unit = plain.bench.notes["block_serial"]
        fit = calibrate(plain.hiding([each for own in hidden.values() for each in own])).fit
        date = f"2026-01-01T{number // 60:02d}:{number % 60:02d}"
        named = {"run": f"run {number}", "unit": unit, "bench": plain.bench.notes["bench"], "date": date}
        factors.append(replace(run_factor(fit), **named))
        for each in hidden["of_unit"]:
            truth[unit] = np.array(list(each.truth["sizes"].values()))
    return factors, truth


@pytest.mark.slow  # drawn ones have what their runs say, above
def test_one_affected_unit_of_simulated_recordings(tmp_path: Path) -> None:
    """Six units, each measured twice; one has a second-order term of 30 sigma a run."""
    campaign = Campaign(tmp_path, runs=12, units=6, benches=1, of_unit=("second-order=30sigma",), share=0.17, seed=5)
    factors, truth = simulated(campaign)
    ((name, hidden),) = truth.items()
    finding = next(each for each in pooled_diagnosis(factors).findings if each.effect == "second-order")
    assert finding.attribution is Attribution.SOME
    (unit,) = (each for each in finding.units if each.probability > 0.5)
    assert unit.unit == name
    columns = [f"second-order/{each.symbol}" for each in unit.coefficients]
    own = [
        run.of([*run.states, *columns])[len(run.states) : -1, len(run.states) :] for run in factors if run.unit == name
    ]
    rows = np.vstack(own)
    sigmas = np.sqrt(np.diag(np.linalg.inv(rows[:, :3].T @ rows[:, :3])))
    for each, value, least in zip(unit.coefficients, hidden, sigmas, strict=True):
        assert each.value is not None and each.sigma is not None
        assert least * 0.999 < each.sigma < 3.0 * least and abs(each.value - value) < 4.0 * each.sigma


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["encoder-harmonic-1:z", "encoder-harmonic-2:z"])
def test_an_encoder_harmonic_of_thirty_simulated_runs_is_of_the_bench(effect: str, tmp_path: Path) -> None:
    """2.5 sigma in each run, which none shows by itself."""
    campaign = Campaign(tmp_path, runs=30, units=30, benches=1, of_bench=(f"{effect}=2.5sigma",), seed=6)
    found = pooled_diagnosis(simulated(campaign)[0])
    finding = found.findings[0]
    of_bench = sum(share for key, share in finding.probabilities.items() if key.common)
    assert len(found.findings) == 1 and finding.effect == effect
    assert of_bench >= 0.97 and not any(key in finding.probabilities for key in (Attribution.SENSORS, Attribution.SOME))
