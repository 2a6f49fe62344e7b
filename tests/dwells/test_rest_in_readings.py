"""Dwells found in the readings alone, as they come."""

from __future__ import annotations

from dataclasses import astuple
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from helpers.paths import RECORDINGS
from scipy import stats

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.blocks import Block, SampleCounts
from kf_calib.dwells.rest_in_readings import RestSegmenter, _chi_squared

BENCH = Bench((), 9.81, angles=False)


def found(accel: Stream, warm: Stream, cuts: np.ndarray) -> tuple[list[Block], SampleCounts, int]:
    """Blocks, counts, and the most readings that waited, of readings cut before these places."""
    segmenter, out, most = RestSegmenter(BENCH), list[Block](), 0
    edges = [0, *cuts.tolist(), len(accel)]
    for begin, end in pairwise(edges):
        part = accel[begin:end]
        around = np.searchsorted(warm.time_ns, [accel.time_ns[begin] if begin else 0, part.time_ns[-1] + 1])
        until = len(warm) if end == len(accel) else int(around[1])
        out += segmenter.push(Batch(part, Stream.empty(4), warm[int(around[0]) : until]))
        most = max(most, len(segmenter._accel))
    return [*out, *segmenter.finish()], segmenter.counts, most


@cache
def streams() -> tuple[Stream, Stream]:
    batches = list(kf_calib.open_recording(RECORDINGS / "hidden.mcap", angles=False))
    accel, warm = (Stream.joined([getattr(each, name) for each in batches]) for name in ("accel", "temperature"))
    return accel[:6000], warm[warm.time_ns < accel.time_ns[6000]]


@pytest.mark.slow
def test_blocks_are_the_same_to_the_bit_however_the_readings_are_cut() -> None:
    accel, warm = streams()
    whole, counts, _ = found(accel, warm, np.array([], int))
    assert len({block.dwell for block in whole}) > 8
    rng = np.random.default_rng(3)
    for count in rng.integers(1, 150, 50):
        blocks, counts, waited = found(accel, warm, np.sort(rng.choice(np.arange(1, len(accel)), count, replace=False)))
        assert counts == counts and waited <= len(accel)
        for one, other in zip(blocks, whole, strict=True):
            assert (one.dwell, one.arrival_s) == (other.dwell, other.arrival_s)
            for name in ("elapsed_s", "accel_mps2", "temperature_c"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert counts.used + counts.moving + counts.settling == counts.read, astuple(counts)


def at_rest(seconds: float, level: tuple[float, float, float], rng: np.random.Generator, sigma: float) -> np.ndarray:
    return np.array(level) + sigma * rng.normal(size=(round(100 * seconds), 3))


def test_a_rest_is_known_while_it_lasts_and_memory_is_that_of_one_block() -> None:
    rng = np.random.default_rng(1)
    turn = np.cumsum(rng.normal(size=(150, 3)), axis=0)
    values = np.concatenate([at_rest(4.0, (0, 9.8, 0), rng, 0.02), turn, at_rest(300.0, (9.8, 0, 0), rng, 0.02)])
    accel = Stream(10_000_000 * np.arange(len(values), dtype=np.int64), values)
    segmenter, standing, blocks, most = RestSegmenter(BENCH), list[int | None](), list[Block](), 0
    for begin in range(0, len(accel), 25):
        blocks += segmenter.push(Batch(accel[begin : begin + 25], Stream.empty(4)))
        standing.append(segmenter.standing)
        most = max(most, len(segmenter._accel))
    assert standing[8] == 1 and standing[19] is None and standing[40] == 2  # after 2 s, amid the turn, at rest again
    assert segmenter.rest_s > 295.0 and most < 4400
    waiting = segmenter.waiting()
    assert [len(block.elapsed_s) for block in blocks if block.dwell == 2] == [4000] * 7
    assert sum(len(block.elapsed_s) for block in waiting) > 1500
    rest = list(segmenter.finish())
    assert waiting[0].elapsed_s[0] == rest[0].elapsed_s[0] and segmenter.standing is None


@pytest.mark.parametrize("rest_s", [39.6, 39.8, 40.1, 40.3, 40.6])
def test_a_dwell_ends_a_quarter_of_a_second_before_its_last_still_window(rest_s: float) -> None:
    """Also where a block of 4000 readings, of 40 seconds, is full just before or after the departure."""
    rng = np.random.default_rng(4)
    turn = np.cumsum(rng.normal(size=(150, 3)), axis=0)
    values = np.concatenate([at_rest(rest_s, (0, 9.8, 0), rng, 0.02), turn, at_rest(5.0, (9.8, 0, 0), rng, 0.02)])
    accel = Stream(10_000_000 * np.arange(len(values), dtype=np.int64), values)
    blocks, _, _ = found(accel, Stream.empty(1), np.arange(10, len(accel), 10))
    last = max(block.elapsed_s[-1] for block in blocks if block.dwell == 1)
    assert last == pytest.approx(np.floor(4.0 * rest_s) / 4.0 - 0.25, abs=0.021)


@pytest.mark.parametrize("turned_deg", [25.0, 360.0])
def test_a_slow_gentle_turn_leaves_nothing_in_the_dwells_beside_it(turned_deg: float) -> None:
    """Minimum-jerk turns at 20 deg/s, of which several windows are still by their means and variances."""
    rng, rate_hz, sigma, left = np.random.default_rng(6), 50.0, 1e-3, list[np.ndarray]()
    for start_deg in range(0, 360, 30):
        count = int(turned_deg / 20.0 * 1.875 * rate_hz)
        share = np.linspace(0.0, 1.0, count)[:, None] ** [3, 4, 5] @ [10.0, -15.0, 6.0]
        angle = np.radians(start_deg + turned_deg * np.concatenate([np.zeros(400), share, np.ones(400)]))
        force = 9.8 * np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], axis=1)
        accel = Stream(20_000_000 * np.arange(len(force), dtype=np.int64), force + sigma * rng.normal(size=force.shape))
        blocks, _, _ = found(accel, Stream.empty(1), np.arange(10, len(accel), 10))
        assert [block.dwell for block in blocks] == [1, 2]
        left += [blocks[0].accel_mps2[-12:].mean(axis=0) - force[0], blocks[1].accel_mps2[:12].mean(axis=0) - force[-1]]
        assert min(len(block.elapsed_s) for block in blocks) > 300
    assert np.square(left).mean() < 3.0 * sigma**2 / 12.0


def test_one_outlier_does_not_end_a_rest_and_noise_of_a_loud_start_is_unlearnt() -> None:
    rng = np.random.default_rng(2)
    values = np.concatenate([at_rest(30.0, (0, 0, 9.8), rng, 0.4), at_rest(20.0, (0, 9.8, 0), rng, 0.01)])
    values[4000, 1] += 5.0
    accel = Stream(10_000_000 * np.arange(len(values), dtype=np.int64), values)
    blocks, _, _ = found(accel, Stream.empty(1), np.array([], int))
    quiet = [block for block in blocks if block.elapsed_s[0] > 30.0]
    assert len({block.dwell for block in quiet}) == 1
    assert quiet[0].elapsed_s[0] < 32.0 and quiet[-1].elapsed_s[-1] > 49.0


@pytest.mark.parametrize("freedom", [3, 12, 60, 300])
def test_the_bounds_of_a_variance_are_those_of_chi_squared(freedom: int) -> None:
    for normal in (-0.674, 0.0, 2.0):
        exact = stats.chi2.ppf(stats.norm.cdf(normal), freedom) / freedom
        assert _chi_squared(normal, freedom) == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("count", [200, 999, 1000, 1013])
def test_windows_are_one_after_another_and_the_last_has_what_is_left(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows = list[tuple[int, int, np.ndarray, float]]()
    monkeypatch.setattr(
        RestSegmenter, "_add_window", lambda self, window, *bounds: (windows.append(window), iter(()))[1]
    )
    values = np.random.default_rng(1).normal(size=(count, 3)) + np.array([0.0, 9.8, 0.0])
    segmenter = RestSegmenter(BENCH)
    for part in np.array_split(np.arange(count), 7):
        accel = Stream(part * 10_000_000, values[part])
        assert not list(segmenter.push(Batch(accel, Stream.empty(4))))
    list(segmenter.finish())
    assert [each.begin for each in windows] == [0, *(each.end for each in windows[:-1])] and windows[-1].end == count
    assert len({each.end - each.begin for each in windows[:-1]}) == 1
    for each in windows:
        own = values[each.begin : each.end]
        np.testing.assert_allclose(each.mean, own.mean(axis=0), rtol=1e-12)
        assert each.variance == pytest.approx(own.var(axis=0, ddof=1).sum(), rel=1e-12)
