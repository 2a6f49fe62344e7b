"""Odds averaged over directions, against plain averages and against sizes that are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kf_calib.diagnosis import candidate_tests
from kf_calib.diagnosis.bayes_factor import as_fall, log_odds


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
def test_log_odds_are_those_of_a_plain_average(dof: int) -> None:
    """exp(n u w - n^2 / 2) over directions u drawn evenly."""
    rng = np.random.default_rng(dof)
    along = rng.standard_normal(dof) + 1.0
    drawn = rng.standard_normal((400_000, dof))
    parts = np.exp(2.0 * drawn @ along / np.linalg.norm(drawn, axis=1) - 2.0)
    found = np.exp(log_odds(dof, float(along @ along), 2.0))
    assert found == pytest.approx(parts.mean(), abs=4.0 * parts.std() / np.sqrt(len(parts)))


def test_a_fall_is_worth_less_the_more_there_was_to_choose() -> None:
    def worth(dof: int, values: int = 1, tried: int = 1) -> float:
        return as_fall(np.full(values, dof), np.array([100.0, *[0.0] * (values - 1)]), tried)

    assert worth(1) == pytest.approx(100.0 - 2.0 * np.log(2.0), abs=0.1)  # the sign
    assert worth(1) > worth(3) > worth(6) > 60.0
    assert worth(3) - worth(3, values=20) == pytest.approx(2.0 * np.log(20.0), abs=1e-6)
    assert worth(3, tried=20) == pytest.approx(worth(3, values=20), abs=1e-6)
    assert np.isfinite(as_fall(np.array([3.0]), np.array([0.5])))
    for dof in (1, 3):  # beyond what the library's Bessel functions know
        lost = [fall - as_fall(np.array([dof]), np.array([fall])) for fall in (0.9e8, 1.1e8, 1e10)]
        expected = [lost[0] + (dof - 1) * np.log(fall / 0.9e8) for fall in (0.9e8, 1.1e8, 1e10)]
        assert lost == pytest.approx(expected, abs=1e-4)


def test_what_is_worth_more_at_its_likeliest_size_is_more_often_the_truth() -> None:
    """A line of one coefficient against any of three, of 8 sigma: the likelier is right as often as it can be where
    the size is known."""
    rng, sigmas, right, known = np.random.default_rng(3), 8.0, 0, 0
    one, three = np.eye(4)[:, :1], np.linalg.qr(np.eye(4)[:, :3] + 0.02)[0]
    for k in range(4000):
        basis = one if k % 2 else three
        direction = rng.standard_normal(basis.shape[1])
        readings = sigmas * basis @ direction / np.linalg.norm(direction) + rng.standard_normal(4)
        falls = [float(np.sum((each.T @ readings) ** 2)) for each in (one, three)]
        worth = [as_fall(np.array([dof]), np.array([fall])) for dof, fall in zip((1, 3), falls, strict=True)]
        best = [log_odds(dof, fall, sigmas) for dof, fall in zip((1, 3), falls, strict=True)]
        right += (worth[0] > worth[1]) == (basis is one)
        known += (best[0] > best[1]) == (basis is one)
    assert 0.8 < known / 4000 and right > known - 3.0 * np.sqrt(4000 * 0.1 * 0.9)


def test_a_walk_is_ahead_of_a_column_where_its_likelihood_is() -> None:
    """Its score is that of the best column where its fall is what the column's is worth; none without a column."""
    own = [SimpleNamespace(effect="drift", dof=3, tried=1)]
    found: Any = SimpleNamespace(candidates=own, statistics=np.array([60.0]))
    scores = {"drift": 60.0 - candidate_tests.threshold(3, 30.0)}
    paths = candidate_tests._beside_best(found, scores, 30.0)
    worth = as_fall(np.array([3]), np.array([60.0]))
    assert worth - candidate_tests.threshold(1, 30.0) + paths == pytest.approx(scores["drift"])
    assert 2.0 < paths < 8.0
    assert candidate_tests._beside_best(found, {"drift": -1.0}, 30.0) == 0.0
    assert candidate_tests._beside_best(found, {}, 30.0) == 0.0
