"""Constants at which the likelihood steps: their posterior mean and the sigma of their logarithm."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.thresholds import begins_at

from kf_calib.estimation import iterated_fit


class _Delay:
    """An effect with a constant that is between these edges."""

    edges_s = np.array([1.0, 2.0, 5.0, 20.0])

    def __init__(self, value: float = 0.0) -> None:
        self.value = value

    def edges(self, stimulus: object) -> np.ndarray:
        return self.edges_s

    def at(self, value: float) -> _Delay:
        return _Delay(value)

    def __str__(self) -> str:
        return "delay"


class _Model:
    def __init__(self, effect: _Delay) -> None:
        self.stepped, self.bench = (effect,), None

    def __sub__(self, effect: _Delay) -> _Model:
        return self

    def with_effect(self, effect: _Delay) -> _Model:
        return _Model(effect)


@pytest.mark.parametrize("deltas", [[0.0, 0.0, 0.0], [3.0, 1.0, -2.0], [-100.0, 0.0, 0.0]])
def test_a_constant_is_averaged_over_a_likelihood_that_steps(
    deltas: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flat in the logarithm between steps: against sums over a grid of a million values."""
    monkeypatch.setattr(iterated_fit, "_delta_chi2", lambda *_: np.array(deltas))
    monkeypatch.setattr(iterated_fit, "stimulus_of", lambda *_: None)
    linearised = SimpleNamespace(model=_Model(_Delay()), dwells_at_state=None, state=None)
    fitted: Any = SimpleNamespace(linearised=linearised)
    model, spreads = iterated_fit.averaged_over_posterior(fitted)
    logs = np.log(1.0) + (np.arange(1_000_000) + 0.5) / 1e6 * np.log(20.0)
    weights = np.exp(0.5 * np.array(deltas))[np.searchsorted(np.log(_Delay.edges_s), logs) - 1]
    mean = np.average(logs, weights=weights)
    assert np.log(model.stepped[0].value) == pytest.approx(mean, abs=1e-5)
    assert spreads["delay"] == pytest.approx(np.sqrt(np.average((logs - mean) ** 2, weights=weights)), rel=1e-4)


def _taken(*steps: tuple[float, float]) -> list[float]:
    """Shares that are taken of steps one after the other, in sigmas of 1e-3 and 1e-6."""
    relaxation, sigma, shares = iterated_fit._Relaxation(), np.array([1e-3, 1e-6]), list[float]()
    fitted: Any = SimpleNamespace(linearised=SimpleNamespace(state=np.array([2.0, -1.0])), sigma_of_determined=sigma)
    for step in steps:
        state, constants = relaxation.of(fitted, fitted.linearised.state + sigma * step, np.ones(1))
        shares.append(float(constants[0]))
        np.testing.assert_allclose((state - fitted.linearised.state) / sigma, np.multiply(step, shares[-1]), atol=1e-8)
    return shares


def test_a_step_that_goes_back_is_halved_and_one_that_goes_on_grows_by_a_quarter() -> None:
    """Down to an eighth and up to three times; by the cosine with the step before, below -0.5 or above 0.9."""
    assert _taken(*[(1.0, 1.0), (-1.0, -1.0)] * 3) == [1.0, 0.5, 0.25, 0.125, 0.125, 0.125]
    assert _taken(*[(1.0, 1.0)] * 7) == pytest.approx([1.0, 1.25, 1.5625, 1.953125, 2.44140625, 3.0, 3.0])

    def second(deg: float) -> float:
        return _taken((2.0, 0.0), (np.cos(np.radians(deg)), np.sin(np.radians(deg))))[1]

    assert begins_at(lambda deg: second(deg) <= 1.0, 1.0, 90.0) == pytest.approx(np.degrees(np.arccos(0.9)))
    assert begins_at(lambda deg: second(deg) < 1.0, 90.0, 179.0) == pytest.approx(120.0)


WITHOUT_ANGLES, WITH_ANGLES, ALONE = (
    SimpleNamespace(bench=SimpleNamespace(angles=angles), effects=effects, nominal_state=lambda: affine_state(2.0))
    for angles, effects in ((False, ()), (True, ("scale-drift",)), (True, ()))
)


def affine_state(condition: float) -> np.ndarray:
    """Of sensitivities of 1 and 2, of this condition number."""
    return np.column_stack([np.diag([1.0, 2.0, 2.0 / condition]), np.ones(3)]).ravel()


def test_axes_that_are_nearly_in_one_plane_tell_no_force() -> None:
    """From a condition number of a hundred on; with angles a channel may be dead."""
    singular = begins_at(
        lambda condition: not iterated_fit._sensible(affine_state(condition), WITHOUT_ANGLES), 2.0, 1e4
    )
    assert singular == pytest.approx(100.0, rel=1e-6)
    assert iterated_fit._sensible(affine_state(1e9), WITH_ANGLES)


@pytest.mark.parametrize("model", [WITHOUT_ANGLES, WITH_ANGLES])
def test_scale_factors_a_hundred_times_nominal_are_those_of_no_block(model: Any) -> None:
    size = begins_at(lambda size: not iterated_fit._sensible(size * affine_state(2.0), model), 1.0, 1e4)
    assert size == pytest.approx(100.0, rel=1e-6)
    assert not iterated_fit._sensible(affine_state(2.0) * np.nan, model)
    assert iterated_fit._sensible(1e3 * affine_state(2.0), ALONE)  # as of counts, which a check of the unit tells


def test_the_error_of_the_temperature_matters_to_effects_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(iterated_fit, "sensitivity_to_temperature", lambda *_: "asked")
    within: Any = SimpleNamespace(effective_sigma_mps2=None)
    for effects, expected in (((), None), (("warm-up",), "asked")):
        linearised: Any = SimpleNamespace(model=SimpleNamespace(effects=effects), dwells_at_state=None)
        assert iterated_fit._sensitivity_to_temperature(linearised, within) == expected


@pytest.mark.parametrize(("stated_deg", "of_poses_deg", "expected"), [
    (None, 0.04, None), (0.03, 0.0, 0.03), (0.03, 0.04, 0.05), (0.0, 0.04, 0.04),
])  # fmt: skip
def test_a_stated_setting_error_has_that_of_noisy_angles_added(
    stated_deg: float | None, of_poses_deg: float, expected: float | None
) -> None:
    """In squares, by their mean over the dwells."""
    poses = SimpleNamespace(pose_sigmas_rad=np.radians(of_poses_deg) * np.sqrt([0.5, 1.5]))
    bench: Any = SimpleNamespace(angle_sigma_deg=stated_deg)
    dwells: Any = SimpleNamespace(folded=poses)
    found = iterated_fit._setting_deg(dwells, bench)
    assert found == (None if expected is None else pytest.approx(expected))
