"""Dwells are grouped by orientation as a comparison of each with all groups would, and in a time that is linear; left
out by leverage, they are predicted as by a fit to all others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.synthetic import Run

from kf_calib.estimation import cross_validation
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.cross_validation import grouped, held_out


def by_comparing_all(places: np.ndarray, apart: float) -> list[list[int]]:
    """Each place joins the first group whose first place is nearer in every coordinate."""
    groups = list[list[int]]()
    for k, here in enumerate(places):
        near = (own for own in groups if np.abs(places[own[0]] - here).max() < apart)
        first = next(near, None)
        if first is None:
            groups.append([k])
        else:
            first.append(k)
    return groups


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("columns", [1, 2, 3, 7])
def test_groups_are_those_of_a_comparison_of_all_with_all(seed: int, columns: int) -> None:
    """Of places that lie close, so that it matters which group came first."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 0.2, (300, columns)) + rng.integers(0, 3, (300, 1))
    places[:, -1] = 0.5  # a coordinate that does not differ
    assert grouped(places, 0.05) == by_comparing_all(places, 0.05)


def test_each_place_is_compared_with_few_however_many_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted, not timed: comparing each with all would be millions of comparisons."""
    places = np.random.default_rng(1).uniform(-1.0, 6.0, (8000, 6))
    compared = list[int]()

    class Counted(float):
        def __sub__(self, other: float) -> float:
            compared.append(1)
            return float(self) - float(other)

    class Listed(np.ndarray):
        def tolist(self) -> list[Any]:
            values = super().tolist()
            return [Counted(value) for value in values] if self.ndim == 1 else values

    assert len(grouped(places.view(Listed), 0.0175)) == len(places)
    assert 0 < len(compared) < len(places)


RUNS = {
    "setting_error": (Run(seed=1, setting_deg=0.002, stated=False), ()),
    "scatter": (Run(seed=2, scatter_mps2=2e-5), ()),
    "effect": (Run(seed=3), ("second-order",)),
    "few_poses_considered": (Run(seed=4, dwells=12, setting_deg=0.01), ()),
    "visits_of_one_pose": (
        Run(seed=5, poses=np.repeat(np.random.default_rng(5).uniform(-3, 3, (12, 3)), 2, axis=0)),
        (),
    ),
    "by_hand": (by_hand(poses=24), ()),
}


@pytest.mark.parametrize("name", RUNS)
def test_leaving_out_by_leverage_equals_merging_the_other_orientations(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, effects = RUNS[name]
    fitted, direct = calibrate(source, effects=effects).fit, list[object]()
    monkeypatch.setattr(cross_validation, "_merged", lambda *_: direct.append("merged"))
    by_leverage = held_out(fitted)
    monkeypatch.undo()
    monkeypatch.setattr(cross_validation, "_by_leverage", lambda *_: direct.append("leverage"))
    merged = held_out(fitted)
    assert direct == ["leverage"] and by_leverage is not None and merged is not None
    np.testing.assert_allclose(by_leverage.errors_mps2, merged.errors_mps2, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(by_leverage.covariance, merged.covariance, rtol=1e-7, atol=1e-20)
    np.testing.assert_allclose(by_leverage.statistics, merged.statistics, rtol=1e-6)


def test_an_orientation_that_tells_nearly_all_of_a_state_is_left_out_directly() -> None:
    """Four poses tell twelve states: without one of them there is no prediction, and none by leverage."""
    assert held_out(calibrate(Run(seed=6, dwells=4)).fit) is None
