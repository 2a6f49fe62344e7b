"""The table of hypotheses: its rows, their probabilities, and what the diagnosis makes of them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from blind_trials.recording import simulate_trial
from blind_trials.task import Task
from helpers.hidden_effects import noisy_run, noisy_source, run, source
from helpers.known_runs import diagnosed
from helpers.synthetic import plan_of

from kf_calib.diagnosis.hypothesis_table import ALIKE, IRREGULAR, NOISE, NONE, NOTHING, Hypothesis, table_of
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.posterior import RunPosterior
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.effects import effect_named, names
from kf_calib.errors import UnobservableError
from kf_calib.estimation.results import Calibration
from kf_calib.sources.files.recording import Recording
from kf_calib.support.json_values import json_value
from kf_calib.support.tail_probabilities import log_odds_of
from kf_calib.views.diagnosis import diagnosis_object

FAMILIES = {
    "bias in time", "scale in time", "temperature", "nonlinearity", "cross-axis", "memory", "gimbal and encoder",
    "base and platform", "surroundings", "slews", "unstated noise", "none of the known", "nothing",
}  # fmt: skip


def rows() -> list[Hypothesis]:
    """Four rows with probabilities in the ratios 80 : 15 : 4 : 1."""
    shares = [(("a", "b"), 0.15), (("a",), 0.80), ((), 0.01), (("c",), 0.04)]
    return [
        Hypothesis(effects, families=("memory",) if effects else (NOTHING,), log_evidence=float(np.log(share)) - 900.0)
        for effects, share in shares
    ]


def test_probabilities_are_evidence_over_the_sum_of_all() -> None:
    """Of what has a known effect's look, 1 in 200 is in no catalogue."""
    table = table_of(rows())
    shares = [0.995 * 0.80, 0.995 * 0.15, 0.995 * 0.04, 0.01, 0.005 * 0.99]
    assert [row.probability for row in table.rows] == pytest.approx(shares)
    assert table.first.effects == ("a",) and table.probability(["a"]) == pytest.approx(0.995 * 0.95)
    assert table.probability(["a", "b"]) == pytest.approx(0.995 * 0.15)
    assert table.families == pytest.approx({"memory": 0.995 * 0.99, NOTHING: 0.01, NONE: 0.005 * 0.99})
    assert table.rows[-1].driver == ALIKE and table.rows[-1].unknown


def test_what_is_told_of_a_table() -> None:
    table = table_of([*rows(), Hypothesis(formulas=("mine = t",), driver="time", families=(NONE,),
                                          log_evidence=float(np.log(0.002)) - 900.0)])  # fmt: skip
    assert len(table.listed) == 3 and table.log10_odds[0] == pytest.approx(np.log10(80 / 15))
    assert table.log10_odds[-1] is None and len(table.log10_odds) == len(table.rows)
    assert table.probability_of_families(["memory", NONE]) == pytest.approx(0.992 / 1.002)
    assert table.probability_of_added("a", "a") == pytest.approx(0.995 * 0.95 / 1.002)
    assert table.probability_of_added("mine = t", "mine") == pytest.approx(0.002 / 1.002)
    assert table.probability_of_added("b2", "b2") is None


def test_a_pair_that_the_run_does_not_determine_is_no_explanation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its refit fails in some runs without angles; the others are weighed all the same."""
    refitted = Refits.of

    def of(self: Refits, before: Calibration, effects: Sequence[str]) -> Calibration:
        if len(effects) > 1:
            raise UnobservableError("the sizes of the readings at rest do not determine both")
        return refitted(self, before, effects)

    monkeypatch.setattr(Refits, "of", of)
    found = diagnose(source("second-order=8sigma", plan=plan_of(10, dwell_s=4.0, seed=5)))
    assert found.table and len(found.table.first.effects) == 1
    assert all(row.refit is None for row in found.table.rows if len(row.effects) > 1)


@pytest.mark.parametrize(("probability", "text"), [
    (0.9995, "over 99.9 %"), (0.993, "99.3 %"), (0.987, "99 %"), (0.75, "75 %"), (0.5, "50 %"), (0.013, "1 %"),
    (0.007, "0.7 %"), (1e-5, "under 0.1 %"),
])  # fmt: skip
def test_a_probability_is_never_rounded_to_certainty(probability: float, text: str) -> None:
    assert format_probability(probability) == text


def test_rivals_do_not_only_add_to_the_first() -> None:
    assert [row.effects for row in table_of(rows()).rivals] == [("c",)]
    few = table_of(row for row in rows() if row.effects != ("c",))
    assert not few.rivals


def test_odds_of_a_p_value() -> None:
    """The bound of Sellke, Bayarri and Berger for p = 0.05 is 1 : 2.46, and none above 1/e."""
    assert np.exp(log_odds_of(0.05)) == pytest.approx(2.456, abs=1e-3)
    assert log_odds_of(0.5) == 0.0 and np.isfinite(log_odds_of(0.0))


def test_every_effect_has_a_family() -> None:
    bench = run().bench
    assert {effect_named(name, bench).family for name in names(bench)} <= FAMILIES - {NONE}


@pytest.mark.slow
def test_an_effect_far_above_the_noise_is_sure_and_its_family_too() -> None:
    found = diagnosed("encoder-harmonic-1:z=15sigma")
    said = json_value(diagnosis_object(found))
    first = said["hypotheses"][0]
    assert first["effects"] == ["encoder-harmonic-1:z"] and first["formula"] is None
    assert said["families"][0] == {"family": "gimbal and encoder", "probability": pytest.approx(1.0, abs=0.02)}
    assert sum(row["probability"] for row in said["hypotheses"]) == pytest.approx(1.0, abs=1e-3)  # few are not listed
    assert found.sure and "Missing: encoder-harmonic-1:z" in found.verdict
    assert found.missing and found.before_in_noise_left is None  # noise that is stated stays as it is
    odds = [row["log10_odds_to_next"] for row in said["hypotheses"][:-1]]
    ratios = [a["probability"] / b["probability"] for a, b in itertools.pairwise(said["hypotheses"])]
    assert np.log10(ratios[:3]) == pytest.approx(odds[:3])
    assert {row["family"] for row in said["families"]} <= FAMILIES


@pytest.mark.slow
def test_where_names_share_it_the_family_comes_first() -> None:
    """A quadratic and an asymmetry of the scale factor overlap almost wholly."""
    found = diagnosed("scale-asymmetry=9sigma")
    assert set(found.ambiguity) >= {"scale-asymmetry", "second-order"}
    assert "The accelerometer is not linear (" in found.verdict or found.sure
    assert found.table is not None and found.table.families["nonlinearity"] > 0.95


def test_nothing_is_likeliest_in_noise() -> None:
    found = diagnosed()
    assert found.table is not None and found.table.rows[0].families == (NOTHING,)
    assert found.table.rows[0].probability > 0.5 and found.likeliest is None
    assert diagnosis_object(found)["missing"] is None


@pytest.mark.slow
def test_an_error_that_no_known_effect_is_does_not_pass_as_noise_that_nobody_stated() -> None:
    """Three cycles a turn of an encoder: a setting error of twice the size has the same sum of squares."""
    not_stated = {"angle_sigma_deg": None, "scatter_sigma_mps2": None}
    hidden = "encoder-harmonic-3:z=7e-6"
    run = noisy_run(hidden, dwells=24, setting_sigma_deg=2e-4, states=not_stated, seed=3)
    assert Refits().assess(run).consistent  # the other tests see nothing
    found = diagnose(run)
    assert found.test.consistent is False and found.unknown
    assert found.table is not None and found.table.rows[0].driver == "angle of gimbal 2 (as an error of its encoder)"


@pytest.mark.slow
def test_a_setting_error_larger_than_stated_is_no_change_of_the_bias() -> None:
    """A bias that returns to its mean within less than a dwell is scatter, which has a likelier name: noise beyond what
    was stated, or something irregular and unknown, as no orientation is repeated that would tell."""
    seeds = range(1, 17)
    states: dict[str, float | None] = {"angle_sigma_deg": 2e-4}
    found = [diagnose(noisy_run(dwells=24, setting_sigma_deg=8e-4, states=states, seed=seed)) for seed in seeds]
    tables = [each.table for each in found if each.table is not None]
    irregular = [sum(row.probability for row in table.rows if row.driver == IRREGULAR) for table in tables]
    noise = [table.families[NOISE] for table in tables]
    assert len(tables) == len(found) and not any(each.missing for each in found)
    leading = [one + other > 0.75 and one > 0.3 for one, other in zip(noise, irregular, strict=True)]
    assert sum(leading) >= 0.9 * len(found)
    assert all(table.families.get("bias in time", 0.0) < 0.5 for table in tables)


@pytest.mark.slow  # of few dwells, which are the harder: test_diagnosis_cases.py
def test_noise_that_nobody_stated_is_told_as_noise() -> None:
    seeds = range(50)
    not_stated, noise = {"angle_sigma_deg": None, "scatter_sigma_mps2": None}, {"setting_sigma_deg": 2e-4}
    found = [diagnose(noisy_source(dwells=16, states=not_stated, seed=500 + seed, **noise)) for seed in seeds]
    assert sum(each.test.consistent is False for each in found) <= 0.03 * len(found)
    tables = [each.table for each in found]
    assert all(table and table.probability_of_families([NOISE, NOTHING]) > 0.3 for table in tables)


NOT_STATED: dict[str, float | None] = {"angle_sigma_deg": None, "scatter_sigma_mps2": None}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "states", "least", "most"),
    [
        ({"scatter_mps2": 3e-4}, NOT_STATED, 0.11, 0.112),
        ({"setting_sigma_deg": 2e-3}, NOT_STATED, 0.0, 0.05),
        ({"scatter_mps2": 3e-4}, {"scatter_sigma_mps2": 3e-5}, 0.999, 1.001),
        ({"setting_sigma_deg": 2e-3}, {"angle_sigma_deg": 2e-4}, 0.999, 1.001),
    ],
)
def test_noise_from_dwell_to_dwell_may_be_an_unknown_cause(
    noise: dict[str, float], states: dict[str, float | None], least: float, most: float
) -> None:
    """The odds are 1 to 9 where nobody stated the scatter, and even where it contradicts what was stated and no
    orientation is repeated; a setting error that nobody stated is a setting error."""
    run, refits = noisy_run(dwells=24, states=states, seed=3, **noise), Refits()
    table = RunPosterior(refits, run, refits.assess(run)).table(refitted=False)
    irregular = sum(row.probability for row in table.rows if row.driver == IRREGULAR)
    assert least <= irregular / table.families[NOISE] <= most


@pytest.mark.slow
def test_what_an_effect_leaves_is_tested_in_the_noise_that_it_leaves() -> None:
    """Scatter that nobody stated is at first what the effect makes of it; beside the effect there is none."""
    diagnosis = diagnose(noisy_run("second-order=15sigma", states=NOT_STATED, seed=3), replicate=False)
    again, after = diagnosis.before_in_noise_left, diagnosis.after
    assert diagnosis.missing == ("second-order",) and again is not None and after is not None
    assert diagnosis.before.noise.scatter_mps2.max() > 5e-6 > 10.0 * after.noise.scatter_mps2.max()
    np.testing.assert_allclose(again.noise.scatter_mps2, after.noise.scatter_mps2)
    assert again.noise.setting_rad == pytest.approx(after.noise.setting_rad)
    assert again.consistency.consistent is False


@pytest.mark.slow
def test_a_constant_that_the_run_does_not_tell_is_no_value_to_be_weighed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To a jump a play is fitted that is wider than the swing of the temperature: it has no sigma."""
    monkeypatch.chdir(tmp_path)  # the plan of the trial goes there
    task = Task("outside@15", "outside", 5151510500017, ("bias-jump=15sigma",), (), "0.0002")
    simulate_trial(task, tmp_path / "run.mcap")
    found = diagnose(Recording(tmp_path / "run.mcap"), replicate=False)
    assert found.unknown and "a jump" in found.verdict, found.verdict
