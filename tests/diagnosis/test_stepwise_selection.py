"""Improvement: the error falls to the noise on what was held out, for a stated reason, and the same way again."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from helpers import known_runs
from helpers.hidden_effects import BENCH, noisy_source, run, source
from helpers.known_runs import diagnosed
from helpers.long_runs import slow
from scipy.stats import chi2

from kf_calib.cli import cli
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.nested_cross_validation import nested_cross_validation
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.selection_journal import figures
from kf_calib.diagnosis.stepwise_selection import (
    Improvement,
    Removal,
    SelectionStep,
    improve,
    removals,
    take_step,
    undone,
)
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate, evaluate
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import spread_plan


def ratio(result: Calibration) -> float:
    """Held-out rms over its floor."""
    assert result.held_out_rms_mps2 is not None and result.held_out_floor_mps2 is not None
    return result.held_out_rms_mps2 / result.held_out_floor_mps2


@pytest.fixture(scope="module")
def second_order() -> Calibration:
    return diagnosed("second-order=15sigma").before


@pytest.fixture(scope="module")
def improved() -> Improvement:
    return known_runs.improved("second-order=15sigma")


@pytest.fixture(scope="module")
def quiet() -> Calibration:
    return diagnosed().before


@pytest.mark.parametrize(("chi_squared", "needed"), [(6.5, False), (6.8, True)])
def test_an_effect_is_needed_at_a_level_of_one_per_cent(chi_squared: float, needed: bool) -> None:
    """Chi-squared of one degree of freedom exceeds 6.63 once in a hundred times."""
    assert Removal("second-order", chi_squared, 1, float(chi2.sf(chi_squared, 1))).needed == needed


def test_a_walk_is_tested_on_one_side() -> None:
    """Its intensity cannot be negative: twice its gain in likelihood is chi-squared in half of the runs without a walk,
    and zero in the others."""
    hidden = noisy_source("bias-walk=9sigma", dwells=24, seed=3)
    before, after = calibrate(hidden), calibrate(hidden, Settings(effects="bias-walk"))
    (removal,) = removals(after.fit)
    assert removal.statistic > 1.0 and removal.p_value == pytest.approx(0.5 * chi2.sf(removal.statistic, 1), rel=1e-9)
    tests = assess_candidates(before.fit, 7.0)
    alone = 0.5 * chi2.sf(2.0 * before.fit.walk_gain, 1)
    assert tests.effects.p_values["bias-walk"] == pytest.approx(1.0 - (1.0 - alone) ** 7, rel=1e-6)


def test_a_walk_that_gains_nothing_is_as_likely_as_not(quiet: Calibration) -> None:
    """In half of the runs without a walk; the smallest p-value of seven is then below a half 127 times in 128."""
    assert quiet.fit.walk_gain < 1e-6
    assert assess_candidates(quiet.fit, 7.0).effects.p_values["bias-walk"] == pytest.approx(1.0 - 0.5**7, rel=1e-3)


def test_the_error_falls_to_the_noise(improved: Improvement) -> None:
    assert [step.added for step in improved.steps] == ["second-order"] and improved.because == "consistent"
    assert ratio(improved.start.before) > 1.5 and ratio(improved.result) < 1.3
    assert improved.result.residual_rms_mps2 < 0.7 * improved.start.before.residual_rms_mps2
    assert improved.steps[0].diagnosis.test.p_value > 0.01 > improved.start.test.p_value
    assert improved.removals[0].needed and not improved.steps[0].remarks


@pytest.mark.parametrize("name", slow("axis-nonorthogonality:z", "hysteresis", "encoder-harmonic-1:z"))
def test_other_kinds_of_effects(name: str) -> None:
    state = improve(source(f"{name}=15sigma"))
    assert [step.added for step in state.steps] == [name] and state.because == "consistent"
    assert ratio(state.result) < 1.3


@pytest.mark.slow
def test_two_effects_are_added_one_by_one() -> None:
    state = improve(source("hysteresis=15sigma", "thermal-scale=15sigma"))
    assert {step.added for step in state.steps} == {"hysteresis", "thermal-scale"} and len(state.steps) == 2
    assert state.because == "consistent" and ratio(state.result) < 1.3
    errors = [ratio(result) for result in (state.start.before, *(step.result for step in state.steps))]
    assert errors[0] > errors[1] > errors[2]


def test_nothing_is_added_to_noise(quiet: Calibration) -> None:
    state = known_runs.improved()
    assert state.because == "consistent" and not state.steps and state.result is quiet


def test_the_unknown_stops_it() -> None:
    state = known_runs.improved("encoder-harmonic-3:z=20sigma")
    assert state.because == "unknown" and not state.steps and "Unknown" in state.reason


@pytest.mark.slow
def test_equal_explanations_are_left_to_a_person() -> None:
    before = diagnosed("second-order=6sigma").before
    state = known_runs.improved("second-order=6sigma")
    assert state.because == "ambiguous" and not state.steps
    assert [each.name for each in state.alternatives][:2] == ["second-order", "scale-asymmetry"]
    widest = max(state.spreads, key=lambda spread: spread.sigmas)
    by_hand = [each.result.parameters[widest.parameter.symbol].value for each in state.alternatives]
    assert widest.highest - widest.lowest == pytest.approx(max(by_hand) - min(by_hand)) and widest.sigmas > 0.5
    assert f"{widest.sigmas:.1f} sigma" in state.reason
    refits = known_runs.refits("second-order=6sigma")
    first = improve(before, refits=refits, accept_first=True)
    assert [step.added for step in first.steps] == ["second-order"] and first.because == "consistent"
    assert "come out high" in first.steps[0].remarks[0]
    assert [each.name for each in first.alternatives][:2] == [each.name for each in state.alternatives][:2]
    assert first.spreads and "second-order and scale-asymmetry" in first.reason and "sigma" in first.reason
    other = take_step(state, refits, "scale-asymmetry", None, "user")
    assert other.alternatives[0].name == "scale-asymmetry" and other.alternatives[1].name == "second-order"


def test_removals_are_the_rise_of_chi_squared(improved: Improvement) -> None:
    """Against refits; of effects that stand still in a dwell, so that all models have the same rows."""
    model = ("second-order", "cross-coupling-ip")
    full = Refits().of(improved.start.before, model)
    for name, test in zip(model, removals(full.fit), strict=True):
        less = Refits().of(full, [other for other in model if other != name])
        rises = less.consistency.statistic - full.consistency.statistic
        assert test.name == name and test.dof == 3 and test.statistic == pytest.approx(rises, rel=0.02, abs=0.05)


@pytest.mark.slow
def test_what_is_not_needed_goes_unless_it_was_asked_for(improved: Improvement) -> None:
    """A step that explained nothing is taken out when the true effect comes in; the user's own stays."""
    useless, start = Refits().of(improved.start.before, ("hysteresis",)), Improvement(improved.start)
    stands = replace(improved.start, before=useless)
    asked = take_step(Improvement(stands), Refits(), "second-order", None, "diagnosis")
    assert asked.effects == ("hysteresis", "second-order") and not asked.steps[-1].dropped
    taken = replace(start, history=(SelectionStep("hysteresis", (), "diagnosis", stands),))
    found = take_step(taken, Refits(), "second-order", None, "diagnosis")
    assert found.effects == ("second-order",)
    gone = found.steps[-1].dropped[0]
    assert gone.name == "hysteresis" and gone.p_value > 0.01 and not gone.needed
    assert figures(found.diagnosis) == pytest.approx(figures(improved.diagnosis), rel=1e-6)


def test_a_result_shows_what_it_is_and_not_its_arrays(improved: Improvement) -> None:
    found = improved.diagnosis
    assert repr(found.before).startswith("<Calibration: twelve parameters + second-order, ")
    assert repr(improved) == "<Improvement: twelve parameters + second-order, consistent>"
    assert repr(found) == f"<Diagnosis: {found.verdict}>" and str(found).startswith(found.verdict[:80])
    assert max(len(repr(each)) for each in (found, improved, found.before, found.before.visits[0], found.test)) < 20_000


@pytest.mark.slow
def test_undo_and_drop(improved: Improvement) -> None:
    start = Improvement(improved.start)
    taken = take_step(take_step(start, Refits(), "mine = fx*fz", None, "user"), Refits(), "second-order", None, "user")
    assert taken.effects == ("mine = fx*fz", "second-order")
    back = undone(taken, Refits())
    assert back.effects == ("mine = fx*fz",) and len(back.history) == 2 and undone(back, Refits()).effects == ()
    dropped = take_step(taken, Refits(), None, ("mine",), "user")
    assert dropped.effects == ("second-order",)
    assert figures(dropped.diagnosis) == pytest.approx(figures(improved.diagnosis), rel=1e-6)
    for bad, says in [
        (lambda: undone(start, Refits()), "no step to undo"),
        (lambda: take_step(taken, Refits(), None, ("hysteresis",), "user"), "it has mine, second-order"),
        (lambda: take_step(taken, Refits(), "second-order", None, "user"), "in the model already"),
        (lambda: take_step(start, Refits(), "second-ordr", None, "user"), "did you mean second-order"),
        (lambda: take_step(start, Refits(), "latency", None, "user"), "start with --with"),
    ]:
        with pytest.raises(InputError, match=says):
            bad()


def test_dwells_left_out_are_still_where_others_came_from(quiet: Calibration) -> None:
    every, state = quiet.fit.dwells, quiet.linearised.state
    some = every.without({3, 4, 10})
    whole, part = (stimulus_of(dwells, BENCH, state) for dwells in (every, some))
    kept = np.repeat([k not in {3, 4, 10} for k, dwell in enumerate(every) for _ in dwell.pieces.counts], 3)
    np.testing.assert_array_equal(part.previous_force_mps2, whole.previous_force_mps2[kept])


@pytest.mark.slow
@pytest.mark.parametrize("name, folds", [("hysteresis", 2), ("second-order", 3)])
def test_the_honest_error_repeats_the_choice(name: str, folds: int) -> None:
    checked = nested_cross_validation(run(f"{name}=15sigma"), folds=folds)
    assert checked.chosen == {name: folds} and 0.7 < checked.rms_mps2 / checked.expected_mps2 < 1.3


@pytest.mark.slow
def test_the_honest_error_of_a_run_without_effects_is_that_of_its_model(quiet: Calibration) -> None:
    empty = nested_cross_validation(quiet, folds=3)
    assert empty.chosen == {} and 0.7 < empty.rms_mps2 / empty.expected_mps2 < 1.3
    assert quiet.held_out_rms_mps2 == pytest.approx(empty.rms_mps2, rel=0.15)


@pytest.mark.slow
def test_honest_errors_are_those_of_orientations_left_out() -> None:
    """As many folds as orientations and nothing to choose: leave-one-out of the fixed model, history and all."""
    before = run("hysteresis=15sigma", plan=spread_plan(12, dwell_s=8.0, seed=5))
    cured = Refits().of(before, ("hysteresis",))
    checked = nested_cross_validation(cured, folds=12)
    assert checked.chosen == {"hysteresis": 12}
    assert checked.rms_mps2 == pytest.approx(cured.held_out_rms_mps2, rel=0.02)
    assert checked.expected_mps2 == pytest.approx(cured.held_out_floor_mps2, rel=0.02)


@pytest.mark.parametrize("runs", slow(2, 20))
def test_sigmas_are_honest_after_improvement(runs: int) -> None:
    """NEES of the twelve over runs with a hidden effect: far outside its band before, inside after.

    Where another effect explains as much it stops and says by how much the twelve differ: no sigma covers that.
    """
    before, after = list[float](), list[float]()
    for seed in range(runs):
        source = Simulation(
            replace(BENCH), GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5),
            spread_plan(20, dwell_s=4.0, seed=seed), sample_hz=50.0, angle_hz=20.0, slew_rate_degps=360.0, seed=seed,
        )  # fmt: skip
        source = source.hiding(parse(["second-order=15sigma"], BENCH.axes, seed=seed, sized=partial(sized, source)))
        truth = np.array(list(source.sensors.parameters.values()))
        state = improve(source)
        if state.because != "consistent":
            assert state.because == "unknown" or "second-order" in state.diagnosis.ambiguity
            continue
        for nees, result in ((before, state.start.before), (after, state.result)):
            error = result.estimate.parameters - truth
            nees.append(float(error @ np.linalg.solve(result.estimate.parameter_covariance, error)))
    assert len(after) >= 0.5 * runs
    low, high = chi2.ppf([0.005, 0.995], 12 * len(after)) / len(after)
    print(f"NEES before {np.mean(before):.1f}, after {np.mean(after):.2f}, band {low:.2f}-{high:.2f}")
    assert np.mean(before) > 2.0 * high and low < np.mean(after) < high


# The command line


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("improve") / "run.mcap"
    words = ["simulate", str(out), "--hide", "second-order=40sigma", "--dwell-s", "6", "--slew-degps", "90",
             "--orientations", "10"]  # fmt: skip
    assert CliRunner().invoke(cli, words).exit_code == 0
    return out


def call(*words: object, answers: str | None = None) -> Result:
    return CliRunner().invoke(cli, [*map(str, words)], input=answers)


def test_the_command_prints_the_agreed_keys(recording: Path, tmp_path: Path) -> None:
    model, kept = tmp_path / "model.toml", tmp_path / "journal.toml"
    done = call("improve", recording, "--json", "--save-model", model, "--journal", kept)
    content = json.loads(done.stdout)
    assert done.exit_code == 0 and done.stdout.count("\n") == 1
    assert content["model"] == ["second-order"] and content["stopped_because"] == "consistent"
    step = content["steps"][0]
    assert step["added"] == "second-order" and step["p_value"] < 1e-3 and step["p_value_after"] > 0.01
    assert step["held_out_rms_mps2"] < 0.5 * content["start"]["held_out_rms_mps2"]
    assert step["residual_rms_mps2"] < 0.5 * content["start"]["residual_rms_mps2"]
    table = tomllib.loads(kept.read_text())
    assert table["recording"]["name"] == "run.mcap" and len(table["recording"]["sha256"]) == 64
    assert table["version"] and table["steps"][0]["added"] == "second-order" and not table["steps"][0]["undone"]
    assert table["steps"][0]["figures"]["K1"] == next(
        each["value"] for each in content["parameters"] if each["symbol"] == "K1"
    )
    replayed = json.loads(call("replay", recording, "--json", "--model", model).stdout)
    own = [{key: value for key, value in each.items() if key != "nominal"} for each in replayed["parameters"]]
    assert own == content["parameters"] and replayed["held_out_rms_mps2"] == content["held_out_rms_mps2"]


@pytest.mark.slow
def test_in_words(recording: Path) -> None:
    done = call("improve", recording, "--strict")
    assert done.exit_code == 0 and "+ second-order" in done.stdout and "█" in done.stdout
    assert "Stopped, consistent: Nothing is left" in done.stdout and "needed" in done.stdout
    asked = call("improve", recording, "--with", "second-order", "--with", "mine = fx*fy")
    assert "without mine" in asked.stdout and "not needed" in asked.stdout and "mine1" in asked.stdout


def test_a_session(recording: Path, tmp_path: Path) -> None:
    """A formula that explains nothing, undone; a suspect by number; a wrong answer; and the journal has it all."""
    kept, model = tmp_path / "journal.toml", tmp_path / "model.toml"
    answers = "f fx*fz\nu\n1\nwhat\nf bend = a*p\nd bend\nq\n"
    words = ["improve", recording, "--interactive", "--journal", kept, "--save-model", model]
    done = call(*words, answers=answers)
    assert done.exit_code == 0 and "mine = fx*fz" in done.stdout and "'what' is no answer" in done.stdout
    assert "bend was taken out" in done.stdout and "Stopped, consistent" in done.stdout
    table = tomllib.loads(kept.read_text())
    told = [(step.get("added"), step["undone"], [each["name"] for each in step["dropped"]]) for step in table["steps"]]
    assert told == [
        ("mine = fx*fz", True, []), ("second-order", False, []), ("bend = a*p", False, []), (None, False, ["bend"]),
    ]  # fmt: skip
    assert tomllib.loads(model.read_text())["effects"] == ["second-order"] == table["model"]


def test_a_session_that_is_ended_at_once(recording: Path) -> None:
    stopped = call("improve", recording, "--interactive", answers="q\n")
    assert "Stopped, asked: Ended by you. Residuals fail" in stopped.stdout


def test_a_journal_has_what_numbers_depend_on(recording: Path, tmp_path: Path) -> None:
    kept, bench = tmp_path / "journal.toml", tmp_path / "bench.toml"
    bench.write_text("gravity_mps2 = 9.82\n")
    words = ["--bench", bench, "--still-deg", "0.04", "--with", "bias-drift", "--no-gate"]
    call("improve", recording, "--json", "--journal", kept, *words)
    table = tomllib.loads(kept.read_text())
    assert table["options"]["gravity_mps2"] == 9.82 and table["options"]["effects"] == ["bias-drift"]
    assert table["options"]["still_deg"] == 0.04 and table["options"]["gate"] is False
    assert "bias-drift" in table["model"]


def test_bad_usage(run, recording: Path, tmp_path: Path) -> None:
    assert "leave out --engine" in run("improve", recording, "--engine", "filterpy")[2]
    assert "choose one" in run("improve", recording, "--json", "--interactive")[2]
    assert "choose one" in run("improve", recording, "--interactive", "--unattended")[2]
    done = call("improve", recording, "--journal", tmp_path / "absent" / "journal.toml")
    assert isinstance(done.exception, InputError) and "another --journal" in str(done.exception)
    assert isinstance(call("improve", tmp_path / "absent.mcap").exception, InputError)


def test_a_refit_is_a_replay(second_order: Calibration) -> None:
    settings = Settings(effects=("second-order",))
    anew = evaluate(second_order.fit.dwells, BENCH, settings)
    refit = Refits().of(second_order, settings.effects)
    np.testing.assert_array_equal(anew.estimate.state, refit.estimate.state)
    assert fit(second_order.fit.dwells, Model.of(BENCH, settings.effects)).noise.sigma_mps2[0] > 0
