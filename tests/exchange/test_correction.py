"""Corrected readings are the specific force that was, within the sigma that is given."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.calibrations import BENCH, SENSORS, simulated
from helpers.long_runs import slow
from scipy import stats

import kf_calib
from kf_calib import effects
from kf_calib.effects.inputs import stimulus_of
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.correction import Correction
from kf_calib.estimation.measurement_model import Model
from kf_calib.sources.simulation.injected import parse

FORCE = np.array([[0.0, 9.81, 0.0], [5.0, -6.0, 5.8], [-9.81, 0.0, 0.0], [3.0, 4.0, 8.4], [0.1, -0.2, 0.05]])


def true_readings(force: np.ndarray, second_order: float = 0.0) -> np.ndarray:
    """What the simulated accelerometers read, by their own formula."""
    along = force @ SENSORS.input_axes.T
    return SENSORS.scales * along + SENSORS.biases_mps2 + second_order * along**2


def correction(*names: str, coefficients: float = 2e-5) -> Correction:
    model = Model.of(BENCH, names)
    state = np.append(SENSORS_STATE, coefficients * np.linspace(0.5, 1.5, model.count - 12))
    return Correction(BENCH, model, state, np.diag(np.full(model.count, 1e-12)), np.full(3, 5e-5))


SENSORS_STATE = np.column_stack([SENSORS.sensitivities, SENSORS.biases_mps2]).ravel()


def test_without_effects_it_is_the_closed_form() -> None:
    found = correction()(true_readings(FORCE))
    np.testing.assert_allclose(found, FORCE, atol=1e-13)


@pytest.mark.parametrize(
    "names",
    [["second-order"], ["third-order", "cross-coupling-ip", "cross-axis-square"], ["thermal-bias", "thermal-scale"],
     ["mine = fx*fy*T"], ["cross-talk"]],
)  # fmt: skip
def test_it_inverts_what_it_predicts(names: list[str]) -> None:
    own = correction(*names)
    warmth = np.linspace(10.0, 60.0, len(FORCE))
    assert np.abs(own.predicted(FORCE, warmth) - correction().predicted(FORCE)).max() > 1e-5
    np.testing.assert_allclose(own(own.predicted(FORCE, warmth), warmth), FORCE, atol=5e-12)


def test_an_effect_adds_what_its_columns_say() -> None:
    own = correction(*(name for name in effects.names(BENCH) if ":" not in name and name != "bias-walk"))
    assert len(own.effects) > 8
    rng = np.random.default_rng(3)
    force, warmth = rng.normal(size=(50, 3)) * 8.0, rng.uniform(0.0, 50.0, 50)
    stimulus = stimulus_of(force, warmth, BENCH, own.sensitivity)
    for effect in own.effects:
        coefficients = np.arange(1.0, 1.0 + len(effect.coefficients))
        added = effect.added(stimulus, coefficients)
        np.testing.assert_allclose(added, effect.columns(stimulus) @ coefficients, rtol=1e-13, atol=1e-13)


def test_what_belongs_to_the_run_or_the_platform_is_left_out() -> None:
    own = correction("hysteresis", "second-order", "base-tilt", "warm-up")
    assert [str(effect) for effect in own.effects] == ["second-order"]
    assert set(own.left_out) == {"hysteresis", "base-tilt", "warm-up"} and all(own.left_out.values())


@cache
def calibrated(seed: int) -> kf_calib.Calibration:
    hidden = parse(["second-order=4e-6,4e-6,4e-6"], ("y", "z", "x"))
    return kf_calib.calibrate(simulated(seed, 10, hidden=hidden), kf_calib.Settings(effects="second-order"))


@pytest.mark.parametrize("runs", [35, *slow(60, 400)])
def test_sigma_covers_the_true_specific_force(runs: int) -> None:
    scores = []
    for seed in range(runs):
        found = calibrated(seed).apply(true_readings(FORCE, 4e-6))
        scores.append((found.force_mps2 - FORCE) / found.sigma_mps2)
    inside = np.sum(np.abs(scores) < 1.96, axis=0)
    low, high = stats.binom.ppf([1e-4, 1.0 - 1e-4], runs, 0.95)  # of each of fifteen
    assert (inside >= low).all() and (inside <= high).all()
    assert abs(inside.mean() / runs - 0.95) < 0.02 * max(60 / runs, 1.0) ** 0.5


def test_noise_of_a_reading_is_that_of_the_bench() -> None:
    found = calibrated(0).apply(true_readings(FORCE))
    np.testing.assert_allclose(found.noise_mps2, 5e-5, rtol=0.2)
    assert (found.noise_mps2 > 3.0 * found.sigma_mps2).all()


def test_readings_that_are_not_finite_stay_so_and_spoil_no_other() -> None:
    readings = true_readings(np.tile(FORCE, (3000, 1)))
    own = correction("second-order", "mine = fx*fy*T")
    expected = own(readings, 30.0)
    readings[[5, 14_000]] = [[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]
    found = own(readings, 30.0)
    bad = ~np.isfinite(found).all(axis=1)
    assert np.flatnonzero(bad).tolist() == [5, 14_000]
    np.testing.assert_array_equal(found[~bad], expected[~bad])
    assert np.isnan(own.sigma_of(found[:6], 30.0)[5]).all()


def test_a_reading_of_no_specific_force_is_none() -> None:
    own = correction("second-order", coefficients=1e-3)  # f + K2 f^2 has a least value, -1/(4 K2)
    found = own(np.array([[-5000.0, -5000.0, -5000.0], [0.0, 9.81, 0.0]]))
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all()


def test_temperature_is_asked_for_where_it_matters_only() -> None:
    assert correction("second-order")(FORCE, np.full(len(FORCE), np.nan)).shape == FORCE.shape
    thermal = correction("thermal-bias")
    assert thermal.needs_temperature == ("thermal-bias",)
    with pytest.raises(InputError, match="thermal-bias cannot be corrected without the temperature"):
        thermal(FORCE)
    with pytest.raises(InputError, match=r"5 readings have temperatures of the shape \(2,\)"):
        thermal(FORCE, np.zeros(2))


@pytest.mark.parametrize("readings", [np.zeros((2, 4)), np.zeros((1, 2, 3)), "9.81", [[1.0, 2.0], [3.0]]])
def test_readings_of_another_shape_are_refused(readings: object) -> None:
    with pytest.raises(InputError, match="give"):
        correction()(readings)


def test_what_was_not_determined_is_not_applied() -> None:
    own = correction("second-order")
    with pytest.raises(UnobservableError, match=r"did not determine K2_1: add orientations"):
        replace(own, unseen=("K2_1",))


def test_directions_of_gravity_are_those_of_faces_edges_and_corners_of_a_cube() -> None:
    """By their angles to the nearest face: none, 45 deg, and that whose cosine is the root of a third."""
    unit = correction().gravities / BENCH.gravity_mps2
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0)
    assert len(np.unique(unit.round(9), axis=0)) == 26
    to_face = np.sort(np.abs(unit).max(axis=1) ** 2)
    np.testing.assert_allclose(to_face, np.repeat([1.0 / 3.0, 0.5, 1.0], [8, 12, 6]))
