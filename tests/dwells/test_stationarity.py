"""Rest and motion of a platform from its angle messages, against what the messages were made with."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.thresholds import begins_at

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Stream
from kf_calib.dwells.stationarity import Stillness

S = 1_000_000_000
STILLNESS = Stillness()
REST_DEG = 0.001


def course(seconds: Floats, degrees: Floats) -> Stream:
    """Messages of two angles, of which the first moves."""
    return Stream(np.round(seconds * S).astype(np.int64), np.radians(np.column_stack([degrees, 0.0 * degrees])))


def every(period_s: float, until_s: float) -> Floats:
    return np.arange(0.0, until_s + 1e-9, period_s)


def test_messages_are_still_where_a_window_of_them_stays_within_the_tolerance() -> None:
    """Against all windows of half a second one by one: those without a step or a difference of ends beyond 0.05 deg."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        seconds = np.sort(rng.choice(every(0.02, 6.0), 80, replace=False))
        degrees = np.cumsum(rng.normal(size=80) * rng.choice([0.002, 0.03], 80, p=[0.8, 0.2]))
        pose = course(seconds, degrees)
        complete = pose.time_ns + STILLNESS.window_ns <= pose.time_ns[-1]
        still, covered_ns = STILLNESS.intervals(pose.time_ns, pose.values, False, complete, 0, np.zeros(80))
        expected, reach = np.zeros(79, bool), 0
        for k in np.flatnonzero(complete):
            end = int(np.flatnonzero(pose.time_ns >= pose.time_ns[k] + STILLNESS.window_ns)[0])
            steps = np.abs(np.diff(degrees[k : end + 1]))
            if steps.max() <= 0.05 and abs(degrees[end] - degrees[k]) <= 0.05:
                expected[k:end], reach = True, max(reach, int(pose.time_ns[end]))
        assert still.tolist() == expected.tolist() and covered_ns == reach


@pytest.mark.parametrize("count", [2, 64, 400])
def test_a_block_creeps_where_its_parts_differ_by_more_than_a_fiftieth_of_the_tolerance(count: int) -> None:
    """A step in its middle, half of which is the distance of either side from the median; of two messages, which tell
    no noise, one as large as the tolerance."""
    sides, seconds = np.repeat([0.0, 1.0], count // 2), 0.1 * np.arange(count)
    step = begins_at(lambda deg: STILLNESS.creeps(course(seconds, deg * sides).values, False), 1e-5, 1.0)
    assert step == pytest.approx(0.05 if count == 2 else 2.0 * REST_DEG, rel=1e-6)


def test_noise_of_an_encoder_is_no_creep() -> None:
    """However loud it is, in 200 blocks; a drift by as much as the noise is one."""
    rng, seconds = np.random.default_rng(5), every(0.02, 10.0)
    for deg in (0.003, 0.03):
        blocks = [rng.normal(size=len(seconds)) * deg for _ in range(100)]
        assert not any(STILLNESS.creeps(course(seconds, block).values, False) for block in blocks)
        assert all(STILLNESS.creeps(course(seconds, block + 0.6 * deg * seconds).values, False) for block in blocks)


@pytest.mark.parametrize(("period_s", "early_s"), [(0.1, 0.0), (0.4, 0.15), (1.0, 0.75), (3.0, 1.75)])
def test_a_platform_left_up_to_a_period_of_its_messages_before_they_show_it(period_s: float, early_s: float) -> None:
    """But for the margin of a quarter of a second that is left out anyway, and by no more than two seconds."""
    seconds = every(period_s, 20.0 * period_s)
    moved = seconds > 18.5 * period_s
    pose = course(seconds, 0.04 * moved)
    until = int(pose.time_ns[-1])
    left_s = STILLNESS.departure_ns(pose, False, 0, until) / S
    assert left_s == pytest.approx(18.0 * period_s - early_s, abs=1e-6)
    assert STILLNESS.departure_ns(course(seconds, 0.0 * seconds), False, 0, until) == until


def test_a_message_is_away_from_rest_by_a_fiftieth_of_the_tolerance_or_four_sigma_of_the_encoder() -> None:
    seconds = every(0.1, 10.0)

    def leaves(deg: float, noise: Floats) -> bool:
        last = np.where(seconds > 9.85, deg, 0.0)
        return STILLNESS.creeping_from(course(seconds, last + noise), False, 0, 10 * S) is not None

    assert begins_at(lambda deg: leaves(deg, 0.0 * seconds), 1e-5, 1.0) == pytest.approx(REST_DEG, rel=1e-6)
    sides = 0.002 * (-1.0) ** np.arange(len(seconds))  # whose second differences are those of noise of 0.0033 deg
    sides[-2:] = 0.0
    assert begins_at(lambda deg: leaves(deg, sides), 1e-5, 1.0) == pytest.approx(4.0 * 0.008 / 6**0.5, rel=0.02)


@pytest.mark.parametrize("settle_s", [0.5, 1.0])
def test_a_platform_comes_to_rest_where_it_is_as_in_the_next_two_margins(settle_s: float) -> None:
    """It swings to its place with a time constant of a fifth of a second: from 0.8 deg to 0.001 deg in 1.3 seconds."""
    seconds = every(0.05, 12.0)
    pose = course(seconds, 0.8 * np.exp(-seconds / 0.2))
    rest_ns, certain = Stillness(settle_s=settle_s).rest_ns(pose, False, 0, 12 * S)
    assert certain and rest_ns / S == pytest.approx(0.2 * np.log(800.0), abs=0.06)
    assert Stillness(settle_s=settle_s).rest_ns(pose, False, 0, int((1.3 + settle_s) * S))[1] is False
    creeping = course(seconds, 0.03 * seconds)
    assert STILLNESS.rest_ns(creeping, False, 0, 12 * S) == (0, True)


def test_of_messages_that_are_seldom_the_next_three_show_rest() -> None:
    """Each 1.5 seconds: less than the margins from one to the next, but not than from one to the mean of three."""
    seconds = every(1.5, 30.0)
    pose = course(seconds, 0.8 * REST_DEG * np.minimum(np.arange(len(seconds)), 5.0))
    assert STILLNESS.rest_ns(pose, False, 0, 30 * S) == (6 * S, True)
