"""Block differences against allantools, over gaps, and in flat memory."""

from __future__ import annotations

import allantools
import numpy as np
import pytest
from helpers.bounded import traced

from kf_calib.bench.arrays import Floats
from kf_calib.noise.block_differences import EVERY, BlockDifferences


def of_stretches(*stretches: Floats, at_once: int = 4096) -> BlockDifferences:
    """All of these stretches (n, c), so many readings at once."""
    differences = BlockDifferences(stretches[0].shape[1])
    for values in stretches:
        for begin in range(0, len(values), at_once):
            differences.push(values[begin : begin + at_once])
        differences.end_stretch()
    return differences


def walks(count: int, seed: int = 1) -> Floats:
    rng = np.random.default_rng(seed)
    return 9.8 + rng.normal(0.0, 1e-3, (count, 3)) + np.cumsum(rng.normal(0.0, 1e-4, (count, 3)), axis=0)


def theirs(values: Floats, sizes: list[int], overlapping: bool = True) -> Floats:
    """Allan variance (m, c) by allantools."""
    deviation = allantools.oadev if overlapping else allantools.adev
    columns = [deviation(own, rate=1.0, data_type="freq", taus=np.array(sizes, float))[1] for own in values.T]
    return np.array(columns).T ** 2


@pytest.mark.parametrize("count", [3, 100, 2047, 2048, 6001])
@pytest.mark.parametrize("at_once", [1, 700, 10_000])
def test_overlapping_variances_are_those_of_allantools(count: int, at_once: int) -> None:
    if at_once == 1 and count > 100:
        count = 100 + count % 7
    values = walks(count)
    allan = of_stretches(values, at_once=at_once).allan()
    short = allan.sizes <= EVERY
    sizes = allan.sizes[short].tolist()
    assert sizes == [2**i for i in range(20) if 2 ** (i + 1) <= count and 2**i <= EVERY]
    assert allan.counts[short].tolist() == [count - 2 * size + 1 for size in sizes]
    if len(sizes) > 2:  # allantools leaves out sizes with one difference
        known = theirs(values, sizes[:-1])
        assert allan.variance[: len(known)] == pytest.approx(known, rel=1e-9)


def test_longer_clusters_are_those_of_block_means() -> None:
    values = walks(40_000)
    allan = of_stretches(values, at_once=1733).allan()
    assert allan.sizes.tolist() == [2**i for i in range(15)]
    for octave in (1, 2, 3):
        means = values[: 40_000 >> octave << octave].reshape(-1, 2**octave, 3).mean(axis=1)
        assert allan.variance[10 + octave] == pytest.approx(theirs(means, [EVERY])[0], rel=1e-9)


def test_haar_variances_are_those_without_overlap() -> None:
    values = walks(4096)
    haar = of_stretches(values, at_once=600).haar()
    assert haar.counts.tolist() == [2048 >> i for i in range(12)]
    for place in range(8):
        blocks = values.reshape(-1, 2, 2**place, 3).mean(axis=2)
        expected = 0.5 * np.mean((blocks[:, 1] - blocks[:, 0]) ** 2, axis=0)
        assert haar.variance[place] == pytest.approx(expected, rel=1e-9)


def test_no_difference_is_taken_over_a_gap() -> None:
    """Stretches a hundred apart give the mean of their squares, each with the number of its differences."""
    first, second = walks(3000, 2), walks(2000, 3) + 100.0
    both, parts = of_stretches(first, second).allan(), [of_stretches(each).allan() for each in (first, second)]
    common = len(parts[1].sizes)
    counts = np.array([part.counts[:common, None] for part in parts])
    variances = np.array([part.variance[:common] for part in parts])
    assert both.counts[:common].tolist() == counts.sum(axis=0)[:, 0].tolist()
    assert both.variance[:common] == pytest.approx((counts * variances).sum(axis=0) / counts.sum(axis=0), rel=1e-7)
    together = of_stretches(np.concatenate([first, second])).allan()
    assert (together.variance[5] > 10.0 * both.variance[5]).all()


def test_block_means_are_those_of_the_shortest_blocks_that_are_few_enough() -> None:
    values = walks(3000)
    differences = of_stretches(values[:1000], values[1000:])
    size, stretches = differences.block_means(0)
    assert size == 4 and [len(means) for means in stretches] == [250, 500] and 750 <= EVERY
    expected = values[1000:].reshape(-1, 4, 3).mean(axis=1) - values[0]
    assert stretches[1] == pytest.approx(expected, abs=1e-12)
    assert differences.block_means(5)[0] == 32
    assert differences.block_means(30)[1] == []


def test_an_end_without_a_beginning_changes_nothing() -> None:
    differences = BlockDifferences(1)
    differences.end_stretch()
    differences.push(np.zeros((0, 1)))
    assert differences.count == 0 and len(differences.allan().sizes) == 0 and len(differences.haar().sizes) == 0


def test_memory_is_that_of_a_few_blocks_whatever_comes() -> None:
    block = walks(20_000)

    def peak(times: int) -> int:
        with traced() as memory:
            differences = BlockDifferences(3)
            for _ in range(times):
                differences.push(block)
            differences.end_stretch()
        assert differences.count == 20_000 * times
        return memory.bytes

    peak(1)
    assert peak(40) < 1.15 * peak(20) < 5e6
