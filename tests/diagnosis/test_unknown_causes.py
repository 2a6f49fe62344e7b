"""Causes of no catalogue: functions of two drivers, memory, and what repeated orientations tell."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.long_runs import slow
from scipy.integrate import quad
from unknown_trials.hidden import HIDDEN, beside, cross_coupling, second_order
from unknown_trials.real_noise import KINDS, noisy_run
from unknown_trials.small_bench import WHITE_MPS2, SmallRun, hidden_run, visits

import kf_calib
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.diagnosis import unknown_effect
from kf_calib.diagnosis.coefficient_sizes import SizePrior
from kf_calib.diagnosis.hypothesis_table import IRREGULAR, NOISE
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.run_terms import sizes_of
from kf_calib.diagnosis.unknown_terms import unknown_terms
from kf_calib.effects import effect_named
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.observability import impossible_size
from kf_calib.estimation.results import Consistency
from kf_calib.sources.text.means import open_table


def diagnosed(name: str, sigmas: float = 12.0, seed: int = 2) -> Diagnosis:
    return kf_calib.diagnose(hidden_run(HIDDEN[name], sigmas, seed), replicate=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "drivers"),
    [
        ("last step x force", {"previous orientation and specific force"}),
        ("temperature x two forces", {"temperature and specific force"}),
        ("play", {"previous orientation"}),
        ("third harmonic of an angle x temperature", {"angle of gimbal 2 and temperature"}),
        ("angle x time", {"angle of gimbal 3 and time"}),
        ("last step x temperature", {"previous orientation and temperature"}),
        ("last step x time", {"previous orientation and time"}),
        ("temperature x time", {"temperature and time"}),
    ],
)
def test_what_depends_on_two_drivers_or_on_the_past_is_unknown_and_goes_with_them(name: str, drivers: set[str]) -> None:
    diagnosis = diagnosed(name)
    assert diagnosis.unknown and diagnosis.likeliest is not None and diagnosis.likeliest.driver in drivers
    assert diagnosis.description is not None and diagnosis.description.share > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "driver"),
    [
        ("temperature x force across", "temperature and specific force"),
        *slow(("decay x force across", "time (a decay of the alignment)")),
        pytest.param(
            "play",
            "previous orientation",
            marks=[
                pytest.mark.slow,
                pytest.mark.xfail(strict=True, reason="a walk of the biases has 70 %: docs/limits.md"),
            ],
        ),
    ],
)
@pytest.mark.parametrize("known", ["second-order", *slow("cross-coupling-ip")])
def test_what_goes_on_beside_a_known_effect_gets_no_known_name(known: str, name: str, driver: str) -> None:
    hidden = second_order if known == "second-order" else cross_coupling
    diagnosis = kf_calib.diagnose(beside(hidden, name, 60.0, 2), replicate=False)
    assert diagnosis.missing == (known,) and not diagnosis.unknown and diagnosis.table is not None
    assert diagnosis.table.first.driver == driver and diagnosis.table.probability_of_just((known,)) < 0.01
    assert f"; the rest goes with {driver}, as no known effect does" in diagnosis.verdict
    assert diagnosis.after is not None and str(diagnosis.after.model.effects[-1]) == known


@pytest.mark.slow
@pytest.mark.parametrize("known", ["second-order", "cross-coupling-ip"])
def test_a_play_beside_a_known_effect_makes_no_name_sure_but_this(known: str) -> None:
    """What a play of a width that no term has holds from dwell to dwell looks like a walk of the biases, too."""
    hidden = second_order if known == "second-order" else cross_coupling
    diagnosis = kf_calib.diagnose(beside(hidden, "play", 60.0, 2), replicate=False)
    assert known in diagnosis.missing and diagnosis.table is not None
    assert diagnosis.table.probability(["bias-walk"]) < 0.9
    assert any(row.driver == "previous orientation" and row.probability > 0.1 for row in diagnosis.table.rows)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="a settling that hardly decays stands for what a formula lacks: docs/limits.md")
@pytest.mark.parametrize("seed", [700, 701])
def test_a_known_effect_that_mends_the_shape_of_a_formula_of_its_family_is_not_named(seed: int) -> None:
    """Of a step through a hyperbolic tangent; the formula has another width, and settling makes up for it."""
    diagnosis = diagnosed("saturating hysteresis", 300.0, seed)
    assert diagnosis.unknown and not diagnosis.missing, diagnosis.verdict
    assert diagnosis.likeliest is not None and diagnosis.likeliest.driver == "previous orientation"
    (explanation, *_) = diagnosis.explanations
    assert explanation.names == ("tanh(da/(5*m/s**2))",)
    assert [shape.effect for shape in explanation.shapes] == [*explanation.names], "what is drawn is what is told"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [700, 701])
def test_where_no_formula_is_exact_a_known_effect_beside_it_is_not_sure(seed: int) -> None:
    diagnosis = diagnosed("time x two forces", 300.0, seed)
    assert diagnosis.likeliest is not None and diagnosis.likeliest.driver == "time and specific force"
    assert not diagnosis.sure, diagnosis.verdict


@pytest.mark.slow  # a jump by itself: test_diagnosis_cases.py
def test_sensors_that_were_switched_on_again_jump_and_do_not_walk() -> None:
    diagnosis = kf_calib.diagnose(noisy_run("switched on again half-way", 60.0, 1), replicate=False)
    assert diagnosis.missing == ("second-order",)
    assert diagnosis.likeliest is not None and diagnosis.likeliest.driver == "time (a jump)"


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [0.0, 60.0])
@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_real_sensors_gets_no_name(kind: str, sigmas: float) -> None:
    for seed in range(1, 5):
        diagnosis = kf_calib.diagnose(noisy_run(kind, sigmas, seed), replicate=False)
        assert {*diagnosis.missing} <= {"second-order"} or not diagnosis.sure, diagnosis.verdict


@pytest.mark.slow  # three waves a turn: test_diagnosis.py, test_hypotheses.py
@pytest.mark.parametrize(("gimbal", "waves"), [(1, 2), (2, 3), (2, 4), (2, 6)])
def test_waves_of_an_encoder_are_told_with_their_number_a_turn(gimbal: int, waves: int) -> None:
    at = visits(5, 24)
    phase_rad = waves * at.angles_rad[:, gimbal - 1]
    of_dwells = np.column_stack([np.sin(phase_rad), np.cos(phase_rad), 0.5 * np.sin(phase_rad + 1.0)])
    hidden_mps2 = np.repeat(6.0 * WHITE_MPS2 / np.sqrt(240) * of_dwells[:, None], 240, axis=1)
    told = kf_calib.diagnose(SmallRun(at, hidden_mps2, 3), replicate=False).description
    assert told is not None and told.driver == f"angle of gimbal {gimbal}"


def test_a_play_follows_where_it_is_pushed() -> None:
    before = kf_calib.calibrate(SmallRun(visits(3, 12), np.zeros((12, 240, 3)), 3))
    stimulus = stimulus_of(before.fit.dwells, before.bench, before.fit.state)
    held, expected = stimulus.along[0], list[np.ndarray]()
    for along in stimulus.along:
        held = np.clip(held, along - 3.0, along + 3.0)
        expected.append(held)
    np.testing.assert_allclose(stimulus.played(3.0), expected, atol=1e-12)
    np.testing.assert_allclose(stimulus.played(0.0), stimulus.along, atol=1e-12)
    np.testing.assert_array_equal(stimulus.at(slice(-6, None)).played(3.0), stimulus.played(3.0)[-6:])


def scattered(repeated: int, with_orientation: bool) -> Diagnosis:
    """Twenty dwells that scatter by six times what is stated, of which some repeat an orientation; what they scatter by
    is new with each dwell or comes back with the orientation."""
    at, rng = visits(5, 20, repeated), np.random.default_rng(9)
    by_dwell = rng.normal(size=(20, 3)) * 6.0 * WHITE_MPS2 / np.sqrt(240)
    if with_orientation and repeated:
        by_dwell[-repeated:] = by_dwell[:repeated]
    return kf_calib.diagnose(SmallRun(at, np.repeat(by_dwell[:, None], 240, axis=1), 5), replicate=False)


def shares(diagnosis: Diagnosis) -> tuple[float, float]:
    """Probabilities of noise beyond what was stated, and of changes of an unknown cause: irregular, or alike at each
    visit of an orientation."""
    assert diagnosis.table is not None
    noise = diagnosis.table.families.get(NOISE, 0.0)
    unknown = [
        row for row in diagnosis.table.rows if row.driver == IRREGULAR or row.driver.startswith("the orientation")
    ]
    return noise, sum(row.probability for row in unknown)


@pytest.mark.slow
def test_without_a_repeated_orientation_scatter_and_an_unknown_cause_cannot_be_told_apart() -> None:
    diagnosis = scattered(0, False)
    noise, irregular = shares(diagnosis)
    assert 0.25 * irregular < noise <= irregular and diagnosis.unknown and diagnosis.as_scatter
    assert "cannot be told" in diagnosis.verdict and "repeat an orientation" in diagnosis.verdict


@pytest.mark.slow  # the odds of repeating: below
def test_what_comes_back_with_the_orientation_is_unknown() -> None:
    comes_back = scattered(6, True)
    assert shares(comes_back)[0] < 0.05 * shares(comes_back)[1] and comes_back.unknown


@pytest.mark.slow
def test_what_is_new_each_time_an_orientation_is_repeated_is_noise() -> None:
    new = scattered(6, False)
    assert shares(new)[0] > shares(new)[1] and new.noise


def test_a_hidden_effect_has_the_size_that_was_asked_for() -> None:
    """What least squares by numpy leave of the means, over the noise of a mean."""
    run = hidden_run(HIDDEN["play"], 12.0, 3)
    columns, means = np.column_stack([run.at.force_mps2, np.ones(24)]), run.hidden_mps2.mean(axis=1)
    left = means - columns @ np.linalg.lstsq(columns, means, rcond=None)[0]
    assert np.linalg.norm(left) / WHITE_MPS2 * np.sqrt(240) == pytest.approx(12.0)


def test_a_pose_after_a_whole_turn_is_the_same_orientation() -> None:
    at = visits(5, 12, 4)
    turned = replace(at, angles_rad=at.angles_rad + 2.0 * np.pi * (np.arange(12)[:, None] // 5))
    groups = orientations(kf_calib.calibrate(SmallRun(turned, np.zeros((12, 240, 3)), 4)).fit.dwells)
    assert [group for group in groups if len(group) > 1] == [[0, 8], [1, 9], [2, 10], [3, 11]]


@pytest.mark.slow  # what goes with the last step and is unknown: above
def test_memory_in_proportion_to_the_last_step_is_not_surely_settling() -> None:
    """With time constants far beyond the dwells it is the same: the catalogue does not hold its limit."""
    diagnosis = diagnosed("in proportion to the last step", 15.0, 1)
    assert diagnosis.table is not None
    assert diagnosis.table.probability(["settling"]) < 0.95
    assert any(row.driver == "previous orientation" and row.probability > 0.05 for row in diagnosis.table.rows)


OSCILLATION = "time (an oscillation)"


def _texts_of(driver: str, dwells: Any) -> list[str]:
    """The formulas of unknown functions of one driver."""
    (term,) = [term for term in unknown_terms(Bench(axes_of("yzx"), 9.81), dwells) if term.driver == driver]
    return [text for texts in term.summands for text in texts]


def stays(start_s: float, end_s: float, temperature_c: float = np.nan) -> Any:
    """A dwell of which only times and temperature are known."""
    nodes = SimpleNamespace(temperature_c=np.full(3, temperature_c))
    return SimpleNamespace(start_s=start_s, end_s=end_s, pieces=SimpleNamespace(nodes=nodes))


@pytest.mark.parametrize(("swing_k", "looked_for"), [(np.nan, False), (0.01, False), (0.5, True)])
def test_products_with_a_temperature_that_stays_are_not_looked_for(swing_k: float, looked_for: bool) -> None:
    """Times one that stays, all is as it is alone."""
    dwells = [stays(100.0 * k, 100.0 * k + 60.0, 25.3 + swing_k * (-1.0) ** k) for k in range(12)]
    drivers = [term.driver for term in unknown_terms(Bench(axes_of("yzx"), 9.81), dwells)]
    assert ("temperature and time" in drivers) is looked_for and "angle of gimbal 1 and time" in drivers


@pytest.mark.parametrize(
    ("dwell_s", "decays"), [(7.0, {1, 3, 10}), (20.0, {1, 3, 10, 30}), (200.0, {1, 3, 10, 30, 100, 300})]
)
def test_no_decay_since_the_arrival_is_much_longer_than_the_dwells(dwell_s: float, decays: set[int]) -> None:
    dwells = [stays(300.0 * k, 300.0 * k + dwell_s) for k in range(12)]
    texts = _texts_of("time since arrival", dwells)
    assert {int(found) for text in texts for found in re.findall(r"tau/\((\d+)", text)} == decays


@pytest.mark.parametrize(("fall", "taken", "share"), [
    (0.0, 3, 0.0), (33.0, 3, 0.3), (103.0, 3, 1.0), (150.0, 3, 1.0), (60.0, 10, 0.5),
])  # fmt: skip
def test_a_formula_explains_a_share_of_the_misfit_beyond_noise(fall: float, taken: int, share: float) -> None:
    """Of a misfit of 160 with 60 degrees of freedom; the formula takes some of these, and so much of the misfit."""
    before, after = Consistency(160.0, 60, 0.0, False), Consistency(160.0 - fall, 60 - taken, 0.0, False)
    assert unknown_effect.explained_share(before, after) == pytest.approx(share)
    sound = Consistency(50.0, 60, 0.8, True)
    assert unknown_effect.explained_share(sound, sound) == 1.0


@pytest.mark.parametrize("cycles", [0.6, 1.37, 3.3, 7.71, 11.2])
def test_an_oscillation_of_any_frequency_is_a_sum_of_neighbouring_ones(cycles: float) -> None:
    dwells = [stays(12.0 * k, 12.0 * k + 8.0) for k in range(24)]
    (term,) = [term for term in unknown_terms(Bench(axes_of("yzx"), 9.81), dwells) if term.driver == OSCILLATION]
    time_s, run_s = np.concatenate([np.linspace(each.start_s, each.end_s, 9) for each in dwells]), dwells[-1].end_s
    wave = np.sin(2.0 * np.pi * cycles * time_s / run_s + 0.4)
    names = {"t": time_s, "s": 1.0, "pi": np.pi, "sin": np.sin, "cos": np.cos}
    left = []
    for texts in term.summands:
        columns = np.column_stack([eval(text, names) for text in texts])
        left.append(
            np.linalg.norm(wave - columns @ np.linalg.lstsq(columns, wave, rcond=None)[0]) / np.linalg.norm(wave)
        )
    assert min(left) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", [77001, *slow(77010)])
def test_a_saturating_hysteresis_of_300_sigma_is_two_functions_of_the_last_step_and_no_settling(seed: int) -> None:
    """Its shape is between two of those that are tried."""
    found = diagnosed("saturating hysteresis", 300.0, seed)
    assert found.unknown and not found.missing and found.likeliest is not None
    assert found.likeliest.driver == "previous orientation" and found.likeliest.probability > 0.9
    assert len(found.likeliest.formulas) > 1


@pytest.mark.parametrize("usual", [None, SizePrior(1e-6, 1e-4)])
@pytest.mark.parametrize("most", [0.5, np.inf])
def test_sizes_that_no_sensor_could_have_are_none(usual: SizePrior | None, most: float) -> None:
    sizes = sizes_of(1e-5, usual, most)
    assert sizes.values.max() < most and sizes.values.min() >= 1e-5
    below = 1.0 if usual is None else 1.0 - quad(lambda x: _density(x, usual), -40.0, -5.0)[0]
    above = 0.0 if usual is None or np.isinf(most) else quad(lambda x: _density(x, usual), np.log10(most), 40.0)[0]
    assert np.exp(sizes.logs).sum() == pytest.approx((below - above) / (1.0 - above), rel=1e-6)


def _density(x: float, usual: SizePrior) -> float:
    """Density of log10 of a size: level where it is usual, and falling by a factor e for each decade beyond."""
    low, high = np.log10(usual.low), np.log10(usual.high)
    return float(np.exp(-max(low - x, x - high, 0.0)) / (high - low + 2.0))


@pytest.mark.slow
def test_an_effect_that_only_an_absurd_size_would_show_is_no_explanation() -> None:
    """Nearly level poses: what turns the platform about the vertical shows by radians only."""
    rng = np.random.default_rng(4)
    poses = np.radians(rng.uniform(-1.0, 1.0, (12, 2)) * 1e-3)
    bench = Bench(axes_of("xz"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    force = bench.specific_force(np.zeros(12), poses)
    means = force + rng.normal(0.0, 0.01, force.shape)
    columns = {"outer [deg]": np.degrees(poses[:, 0]), "inner [deg]": np.degrees(poses[:, 1])}
    columns |= {f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"s{axis}_mps2": np.full(12, 1e-3) for axis in "xyz"} | {"count": np.full(12, 1000)}
    table = open_table(columns, {"axes": "x z", "gravity_mps2": "9.81", "angle_sigma_deg": "0",
                                 "scatter_sigma_mps2": "0"})  # fmt: skip
    found = kf_calib.diagnose(table, replicate=False)
    assert found.table is not None
    for row in found.table.rows:
        for name in row.effects if row.refit is not None and row.probability > 0.01 else ():
            coefficients = row.refit.estimate.state[row.refit.model.parts[name]]
            assert (np.abs(coefficients) < impossible_size(effect_named(name, table.bench))).all()
