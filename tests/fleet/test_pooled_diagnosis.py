"""Many runs together: what is the bench's, what the sensors', and which units have it."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.run_factors import campaign_of, nothing, run_factor_of

from kf_calib.bench.arrays import Floats
from kf_calib.cli.echo import rendered
from kf_calib.effects import Bearer
from kf_calib.errors import InputError
from kf_calib.estimation import bench_model as bench_models
from kf_calib.fleet.pooled_diagnosis import PooledDiagnosis, _near, pooled_diagnosis
from kf_calib.fleet.pooled_terms import Attribution
from kf_calib.fleet.results import bench_model
from kf_calib.fleet.run_factor import ReferenceUnit
from kf_calib.fleet.text import pooled_report, sentences

BENT = np.array([2.5, -2.0, 2.0])
REPAIRED = 13


def own_of(number: int) -> Floats:
    """Coefficients of a unit, drawn for itself."""
    return 1.7 * np.random.default_rng([number, 2]).standard_normal(3)


def bent_and_own(number: int) -> Mapping[str, Floats]:
    """An error of the bench that was repaired, and an effect of each unit."""
    return {"flexure": BENT * (number < REPAIRED), "second-order": own_of(number)}


@pytest.fixture(scope="module")
def both() -> PooledDiagnosis:
    return pooled_diagnosis(campaign_of(30, bent_and_own))


def finding(found: PooledDiagnosis, effect: str):
    return next(each for each in found.findings if each.effect == effect)


def test_an_error_of_the_bench_and_an_effect_of_the_sensors_are_told_apart(both: PooledDiagnosis) -> None:
    assert {each.effect: each.attribution for each in both.findings} == {
        "flexure": Attribution.REPAIRED,
        "second-order": Attribution.SENSORS,
    }


def test_coefficients_before_a_repair_are_those_that_were_hidden(both: PooledDiagnosis) -> None:
    before, after = finding(both, "flexure").benches
    for parts, truth in ((before, BENT), (after, np.zeros(3))):
        for each, size in zip(parts.coefficients, truth, strict=True):
            assert each.value is not None and each.sigma is not None and each.unit == "rad s^2/m"
            assert abs(each.value - size / math.sqrt(48)) < 4.0 * each.sigma
            assert each.sigma < 0.4 / math.sqrt(48)


def test_date_of_a_repair_is_found(both: PooledDiagnosis) -> None:
    repair = finding(both, "flexure").repair
    assert repair is not None and f"run{REPAIRED:03d}" in [gap.before_run for gap in repair.gaps[:2]]
    assert sum(gap.probability for gap in repair.gaps) >= 0.95


def test_dates_beside_a_likely_one_are_looked_at_run_by_run() -> None:
    """Of a likely date all runs from the date before it to the date after it."""
    ranks = [0, 2, 3, 5, 6, 8, 9, 12]
    assert _near([3, 6], [0.0, 1.0], ranks) == [3, 5, 6, 8, 9, 12]
    assert _near([3, 6], [1.0, 0.0], ranks) == [0, 2, 3, 5]
    assert _near([3, 6, 9], [0.1, 0.0, 0.9], ranks) == [0, 2, 3, 5, 6, 8, 9, 12] and _near([3], [0.0], ranks) == []


def test_physics_says_what_can_have_an_effect_but_of_single_runs() -> None:
    benches, units = {Attribution.BENCH, Attribution.REPAIRED}, {Attribution.SENSORS, Attribution.SOME}
    for bearer, bearers in ((Bearer.BENCH, benches), (Bearer.SENSORS, units), (Bearer.EITHER, benches | units)):
        assert {each for each in Attribution if each.possible(bearer)} == bearers | {Attribution.RUN}


def test_spread_of_the_units_is_that_from_which_they_were_drawn(both: PooledDiagnosis) -> None:
    people = finding(both, "second-order").population
    assert people is not None
    low, high = people.spread_interval
    assert low < 1.7 / math.sqrt(48) < high < 2.0 * low
    interval = finding(both, "second-order").share_interval
    assert interval is not None and interval[1] == 1.0


def test_report_and_result_say_what_was_found(both: PooledDiagnosis) -> None:
    text = " ".join(rendered(pooled_report(both)).split())
    assert "30 runs of 30 units on 1 bench show" in text
    assert "flexure is of the bench, changed once" in text and "between 2026-01-01 00:12 and 2026-01-01 00:13" in text
    assert "second-order is of the type of sensor" in text
    document = json.loads(json.dumps(asdict(both), allow_nan=False))
    row = next(each for each in document["effects"] if each["effect"] == "second-order")
    assert sum(row["probabilities"].values()) + row["no_one"] == pytest.approx(1.0)


def test_noise_alone_shows_nothing_however_the_runs_are_given() -> None:
    runs = campaign_of(20)
    found = pooled_diagnosis(runs)
    assert found.findings == () and found.no_more > 0.5
    assert pooled_diagnosis(iter(runs)) == pooled_diagnosis(lambda: iter(runs)) == found


def test_order_of_reading_changes_nothing() -> None:
    runs = campaign_of(12, lambda _: {"flexure": BENT})
    one, other = pooled_diagnosis(runs), pooled_diagnosis(runs[::-1])
    assert [each.effect for each in other.findings] == ["flexure"]
    assert other.findings[0].probabilities == pytest.approx(dict(one.findings[0].probabilities))


def test_units_that_have_an_effect_are_told_from_those_that_have_not() -> None:
    having = set(np.random.default_rng(7).permutation(30)[:15].tolist())

    def hidden(number: int) -> Mapping[str, Floats]:
        return {"hysteresis": 6.0 * own_of(number) / np.linalg.norm(own_of(number))} if number in having else {}

    found = pooled_diagnosis(campaign_of(30, hidden))
    (only,) = found.findings
    assert only.attribution is Attribution.SOME
    right = [(each.probability > 0.5) == (int(each.unit.removeprefix("unit")) in having) for each in only.units]
    assert np.mean(right) >= 0.9
    assert only.share_interval is not None and only.share_interval[0] <= 0.5 <= only.share_interval[1]


def test_what_differs_from_run_to_run_of_a_unit_is_of_each_run() -> None:
    units = [f"unit{k // 3}" for k in range(30)]
    runs = [run_factor_of(k, lambda n: {"hysteresis": 2.0 * own_of(n)}, unit=unit) for k, unit in enumerate(units)]
    assert [each.attribution for each in pooled_diagnosis(runs).findings] == [Attribution.RUN]
    same = [run_factor_of(k, lambda n: {"hysteresis": 2.0 * own_of(n // 3)}, unit=unit) for k, unit in enumerate(units)]
    assert [each.attribution for each in pooled_diagnosis(same).findings] == [Attribution.SENSORS]


def test_single_runs_that_have_an_effect_are_named() -> None:
    """One run of each of two units has it, the other eighteen have not."""
    units = [f"unit{k // 2}" for k in range(20)]
    hidden = {k: {"hysteresis": 12.0 * own_of(k) / np.linalg.norm(own_of(k))} for k in (4, 11)}
    runs = [run_factor_of(k, lambda n: hidden.get(n, {}), unit=unit) for k, unit in enumerate(units)]
    diagnosis = pooled_diagnosis(runs)
    (only,) = diagnosis.findings
    assert only.attribution is Attribution.RUN
    named = sentences(diagnosis)[1].partition("%): ")[2].partition(". In its place")[0].rstrip(".")
    assert named == ", ".join(runs[k].run for k in (4, 11))


def test_wrong_gravity_shows_against_a_reference_unit_alone() -> None:
    wrong = 1.0 + 50e-6
    runs = [run_factor_of(k, scale=wrong, unit="known" if k % 4 == 0 else f"unit{k}") for k in range(16)]
    assert pooled_diagnosis(runs).findings == ()
    known = ReferenceUnit("known", (1.0, 1.0, 1.0), (1e-6, 1e-6, 1e-6))
    (only,) = pooled_diagnosis(runs, reference_unit=known).findings
    (value,) = only.benches[0].coefficients
    assert only.effect == "gravity-error" and only.attribution is Attribution.BENCH
    assert value.value is not None and value.sigma is not None
    assert abs(value.value - 50e-6) < 4.0 * value.sigma < 10e-6
    roughly = replace(known, sigma=(9e-6, 9e-6, 9e-6))
    (value,) = pooled_diagnosis(runs, reference_unit=roughly).findings[0].benches[0].coefficients
    assert value.sigma == pytest.approx(9e-6 / math.sqrt(3.0), rel=0.05)  # four runs do not make it better known


def test_two_benches_have_errors_of_their_own() -> None:
    def hidden(number: int) -> Mapping[str, Floats]:
        return {"flexure": BENT} if number % 2 else {}

    runs = [replace(run_factor_of(k, hidden), bench="AB"[k % 2]) for k in range(24)]
    (only,) = pooled_diagnosis(runs).findings
    assert only.effect == "flexure" and only.attribution is Attribution.BENCH
    sizes = {each.bench: each.coefficients[0] for each in only.benches}
    assert sizes["A"].value is not None and abs(sizes["A"].value) < 4.0 * (sizes["A"].sigma or 0.0)
    assert sizes["B"].value == pytest.approx(2.5 / math.sqrt(48), rel=0.3)


def test_bench_model_holds_what_the_last_runs_have(both: PooledDiagnosis, tmp_path: Path) -> None:
    made = bench_model(both, "bench 1")
    made.write(tmp_path / "bench.toml")
    assert bench_models.read_bench_model(tmp_path / "bench.toml") == made
    assert [term.effect for term in made.terms] == ["flexure"] and made.terms[0].since == "2026-01-01T00:13"
    with pytest.raises(InputError, match="no run is of the bench 'other': name one of 'bench 1'"):
        bench_model(both, "other")
    with pytest.raises(InputError, match=r"no error of the bench 'bench 1' was found in 4 runs"):
        bench_model(pooled_diagnosis(campaign_of(4, nothing)), "bench 1")


def test_what_cannot_be_diagnosed_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="there are no runs"):
        pooled_diagnosis([])
    bare = [replace(run, columns=run.columns[:12], factor=run.factor[:13, :13]) for run in campaign_of(2)]
    with pytest.raises(InputError, match="the runs have no columns of effects"):
        pooled_diagnosis(bare)
    mixed = pooled_diagnosis([*campaign_of(3), bare[0]])
    assert mixed.runs == 4 and mixed.findings == ()
    with pytest.raises(InputError, match="no run is of the reference unit X"):
        pooled_diagnosis(campaign_of(2), reference_unit=ReferenceUnit("X", (1.0, 1.0, 1.0), (1e-6, 1e-6, 1e-6)))
