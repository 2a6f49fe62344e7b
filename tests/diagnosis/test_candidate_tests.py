"""The p-value of a run from those of its tests."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from kf_calib.diagnosis.candidate_tests import CandidateTests


def p_value(effects: dict[str, float], misfit: float | None, trend: float | None, noise: float | None) -> float | None:
    scored: Any = SimpleNamespace(p_values=effects)
    within: Any = None if trend is None else SimpleNamespace(p_value=trend)
    return CandidateTests(scored, misfit, trend=within, noise_p=noise).p_value


@pytest.mark.parametrize(("effects", "misfit", "trend", "noise", "expected"), [
    ({"a": 0.02, "b": 0.3}, 0.5, None, None, 0.02 / 0.4), ({"a": 0.02}, 0.01, 0.5, None, 0.01 / 0.4),
    ({"a": 0.02}, None, 1e-3, None, 1e-3 / 0.1), ({"a": 0.02}, 0.5, 1e-3, 3e-3, 3e-3), ({}, 0.9, 0.8, 0.7, 0.7),
    ({}, 0.9, 0.8, None, 1.0), ({}, None, None, 0.5, None),
])  # fmt: skip
def test_effects_and_the_misfit_have_two_fifths_of_the_level_each_and_trends_within_dwells_a_tenth(
    effects: dict[str, float], misfit: float | None, trend: float | None, noise: float | None, expected: float | None
) -> None:
    """So that all together raise an alarm at the level; noise that was judged by itself counts as it is."""
    assert p_value(effects, misfit, trend, noise) == (None if expected is None else pytest.approx(expected))
