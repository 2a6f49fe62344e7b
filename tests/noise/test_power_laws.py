"""The closed forms of the four noises against each other, and against draws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kf_calib.bench.arrays import Floats
from kf_calib.noise.block_differences import BlockDifferences
from kf_calib.noise.power_laws import (
    TERMS,
    allan_covariance,
    allan_variance,
    block_spectrum,
    haar_freedom,
    histogram,
)

DRAWN: dict[str, Callable[[np.random.Generator, int], Floats]] = {
    "quantisation": lambda rng, count: np.diff(rng.normal(size=count + 1)),
    "white": lambda rng, count: rng.normal(size=count),
    "random_walk": lambda rng, count: np.cumsum(rng.normal(size=count)),
}
COUNT, DRAWS = 512, 1500


def drawn_variances(term: str) -> tuple[Floats, Floats, np.ndarray, np.ndarray]:
    """Allan and Haar variances (draws, m) of so many channels at once, their sizes, and the numbers of differences."""
    rng = np.random.default_rng(TERMS.index(term))
    differences = BlockDifferences(DRAWS)
    differences.push(np.array([DRAWN[term](rng, COUNT) for _ in range(DRAWS)]).T)
    differences.end_stretch()
    allan, haar = differences.allan(), differences.haar()
    usable = allan.sizes * 3 <= COUNT
    return allan.variance[usable].T, haar.variance.T, allan.sizes[usable], haar.counts


def test_two_blocks_have_the_allan_variance() -> None:
    """Of the cosine transform of two means only their difference over √2 is left."""
    assert block_spectrum(2)[0] == pytest.approx(allan_variance(np.array([1.0]))[0], rel=1e-12)


@pytest.mark.parametrize("count", [5, 64])
def test_the_spectrum_of_blocks_has_their_whole_scatter(count: int) -> None:
    """The sum over the transform is the scatter of the means about theirs; of white noise all are alike."""
    spectrum = block_spectrum(count)
    assert spectrum[:, 1] == pytest.approx(np.ones(count - 1), rel=1e-9)
    rng = np.random.default_rng(4)
    walk = np.cumsum(rng.normal(0.0, 0.1, (4000, count * 100)), axis=1).reshape(4000, count, 100).mean(axis=2)
    scatter = count * walk.var(axis=1).mean()
    assert spectrum[:, 3].sum() == pytest.approx(scatter, rel=0.05)


@pytest.mark.parametrize("term", DRAWN)
def test_covariances_of_allan_variances_are_those_of_draws(term: str) -> None:
    variances, _, sizes, _ = drawn_variances(term)
    squares = (np.array(TERMS) == term).astype(float)
    expected = allan_covariance(sizes, {COUNT: 1}, 1.0, squares)
    sigma, drawn = np.sqrt(np.diag(expected)), np.cov(variances.T)
    beyond = slice(2, None) if term == "random_walk" else slice(None)  # a walk that steps is not one that flows
    assert np.sqrt(np.diag(drawn))[beyond] == pytest.approx(sigma[beyond], rel=0.1)
    correlation = drawn / np.sqrt(np.outer(np.diag(drawn), np.diag(drawn)))
    assert correlation[beyond, beyond] == pytest.approx((expected / np.outer(sigma, sigma))[beyond, beyond], abs=0.09)


@pytest.mark.parametrize("term", DRAWN)
def test_haar_variances_have_their_degrees_of_freedom(term: str) -> None:
    _, variances, _, counts = drawn_variances(term)
    squares = (np.array(TERMS) == term).astype(float)
    freedom = haar_freedom(2.0 ** np.arange(len(counts)), counts, squares)
    drawn = 2.0 * variances.mean(axis=0) ** 2 / variances.var(axis=0)
    assert drawn[:6] == pytest.approx(freedom[:6], rel=0.2)
    if term == "white":
        assert freedom == pytest.approx(counts.astype(float))


def test_covariance_of_stretches_is_that_of_independent_ones() -> None:
    """Two of the same length: half the variance of one."""
    sizes, squares = np.array([1, 4, 16]), np.array([0.1, 1.0, 0.2, 0.1])
    one, two = (allan_covariance(sizes, {300: number}, 1.0, squares) for number in (1, 2))
    assert two == pytest.approx(one / 2.0)


def test_many_lengths_are_joined_to_fewer() -> None:
    assert histogram([5, 7, 5]) == {5: 2, 7: 1}
    lengths = list(range(10, 2000, 3))
    table = histogram(lengths)
    assert len(table) <= 200 and sum(table.values()) == len(lengths)
    assert sum(length * number for length, number in table.items()) == pytest.approx(sum(lengths), rel=0.05)
