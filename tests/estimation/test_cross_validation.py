"""Dwells are grouped by orientation as a comparison of each with all groups would, and in a time that is linear."""

from __future__ import annotations

import time

import numpy as np
import pytest

from kf_calib.estimation.cross_validation import grouped


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


def test_time_grows_with_the_number_of_orientations() -> None:
    def lasting_s(count: int) -> float:
        places = np.random.default_rng(1).uniform(-1.0, 6.0, (count, 6))
        begin = time.process_time()
        assert len(grouped(places, 0.0175)) == count
        return time.process_time() - begin

    lasting_s(500)
    assert lasting_s(8000) < 8.0 * lasting_s(2000)  # four times as many; each compared with all would be sixteen
