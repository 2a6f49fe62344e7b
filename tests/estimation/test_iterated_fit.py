"""Constants at which the likelihood steps: their posterior mean and the sigma of their logarithm."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

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
