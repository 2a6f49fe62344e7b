"""The best possible share of right names, against theory and plain averages."""

import math

import numpy as np
import pytest
from blind_trials.best_possible import (
    Columns,
    Normal,
    Process,
    Sphere,
    _pair_log_odds,
    best_possible,
    best_possible_pairs,
    best_possible_probability,
    probability_where_two_are_possible,
    size_evidence,
)
from scipy.special import ndtr


def test_the_best_chooser_is_right_as_often_as_theory_has_it() -> None:
    """Of two effects of one coefficient: |w1| > |w2|, where w1 - w2 and w1 + w2 are independent."""
    overlap, sigmas = 0.9, 4.0
    bases = {"one": [[1.0], [0.0]], "two": [[overlap], [math.sqrt(1.0 - overlap**2)]]}
    spaces = {name: Columns([np.array(basis)]) for name, basis in bases.items()}
    found = best_possible(spaces, {name: {name} for name in spaces}, sigmas, draws=20_000)
    apart, along = ndtr(sigmas * np.sqrt(0.5 * (1.0 - overlap))), ndtr(sigmas * np.sqrt(0.5 * (1.0 + overlap)))
    expected = apart * along + (1.0 - apart) * (1.0 - along)
    assert list(found.values()) == pytest.approx([expected] * 2, abs=4.0 * math.sqrt(0.25 / 20_000))
    assert 0.8 < expected < 0.85
    assert set(best_possible(spaces, {name: {"one", "two"} for name in spaces}, sigmas).values()) == {1.0}


def test_the_probability_of_the_truth_is_that_of_bayes() -> None:
    """Of two effects of one coefficient and either sign, whose likelihoods are cosh(n w)."""
    overlap, sigmas = 0.9, 4.0
    other = np.array([overlap, math.sqrt(1.0 - overlap**2)])
    spaces = {"one": Columns([np.eye(2)[:, :1]]), "two": Columns([other[:, None]])}
    found = best_possible_probability(spaces, {name: {name} for name in spaces}, sigmas, draws=20_000)
    readings = np.random.default_rng(1).normal([sigmas, 0.0], 1.0, (100_000, 2))
    true, false = np.cosh(sigmas * readings[:, 0]), np.cosh(sigmas * readings @ other)
    assert found["one"] == pytest.approx(float(np.mean(true / (true + false))), abs=0.008)
    assert found["one"] < best_possible(spaces, {name: {name} for name in spaces}, sigmas, draws=20_000)["one"]


def test_a_chooser_who_allows_for_two_effects_is_less_sure() -> None:
    """Two effects across each other: B(x^2) of the one there against B(y^2) and two at once, a fourth as likely."""
    sigmas, spaces = 5.0, {"one": Columns([np.eye(3)[:, :1]]), "two": Columns([np.eye(3)[:, 1:2]])}
    same = {name: {name} for name in spaces}
    found = probability_where_two_are_possible(spaces, same, sigmas, draws=2_000, seed=3)
    falls = np.random.default_rng(1).normal([sigmas, 0.0], 1.0, (20_000, 2)) ** 2
    one, two = np.exp(size_evidence(1, falls)).T / 2.0
    both = np.exp(size_evidence(2, falls.sum(axis=1))) / 4.0
    assert found["one"] == pytest.approx(float(np.mean(one / (one + two + both))), abs=0.01)
    assert found["one"] < best_possible_probability(spaces, same, sigmas, draws=2_000)["one"] - 0.02


@pytest.mark.parametrize("dofs", [(3, 3), (2, 3), (3, 1)])
def test_the_odds_of_a_pair_are_those_of_a_plain_average(dofs: tuple[int, int]) -> None:
    """exp(s r - s s / 2), s of two signals of 2 sigma each, over directions drawn evenly."""
    rng = np.random.default_rng(4)
    one, other = (np.linalg.qr(rng.standard_normal((6, dof)))[0] for dof in dofs)
    readings = one[:, 0] + 2.0 * other[:, -1] + rng.standard_normal(6)
    drawn = [rng.standard_normal((400_000, dof)) for dof in dofs]
    signals = sum(
        2.0 * own / np.linalg.norm(own, axis=1)[:, None] @ basis.T
        for own, basis in zip(drawn, (one, other), strict=True)
    )
    expected = np.log(np.mean(np.exp(signals @ readings - 0.5 * np.sum(signals**2, axis=1))))
    both = Sphere(one), Sphere(other)
    found = np.exp(
        [_pair_log_odds(*both, readings, 2.0, np.random.default_rng(seed)) - expected for seed in range(100)]
    )
    assert found.mean() == pytest.approx(1.0, abs=0.02 + 0.4 * found.std()) and found.std() < 0.15


def test_the_best_chooser_of_pairs_is_right_as_often_as_it_thinks() -> None:
    """Three effects of one coefficient, two of them alike: which is beside the third, by the sum over the signs."""
    overlap, sigmas, rng = 0.9, 3.0, np.random.default_rng(2)
    third = np.array([0.0, 0.0, 1.0])
    bases = [np.array([1.0, 0.0, 0.0]), np.array([overlap, math.sqrt(1.0 - overlap**2), 0.0]), third]
    spaces = {name: Columns([own[:, None]]) for name, own in zip("abc", bases, strict=True)}
    most, pairs = best_possible_pairs, [("a", "c"), ("b", "c")]
    hits = most(spaces, {name: {name} for name in spaces}, sigmas, pairs, draws=4000)
    found = float(np.mean([right for _, right in hits]))
    right, signs = 0, [(s, t) for s in (-1, 1) for t in (-1, 1)]
    for _ in range(4000):  # a and b overlap too much to be a pair
        true, own = rng.integers(2), sigmas * (rng.choice([-1, 1], 2))
        readings = own[0] * bases[true] + own[1] * third + rng.standard_normal(3)
        odds = [
            sum(math.exp(-0.5 * np.sum((readings - sigmas * (s * bases[k] + t * third)) ** 2)) for s, t in signs)
            for k in (0, 1)
        ]
        right += int(np.argmax(odds)) == true
    assert 0.6 < found < 0.95 and found == pytest.approx(right / 4000, abs=4.0 * math.sqrt(0.5 / 4000))
    alike = most(spaces, {"a": {"a", "b"}, "b": {"a", "b"}, "c": {"c"}}, sigmas, pairs, draws=50)
    assert {pair for pair, _ in alike} == set(pairs) and all(right for _, right in alike)


@pytest.mark.parametrize("dof", [1, 3])
def test_the_odds_of_a_walk_and_beside_it_are_those_of_a_plain_average(dof: int) -> None:
    """exp(s r - s s / 2), s of a normal path and of a signal of 2 sigma drawn evenly."""
    rng = np.random.default_rng(5)
    basis = np.linalg.qr(rng.standard_normal((6, dof)))[0]
    axes, variances = np.linalg.qr(rng.standard_normal((6, 2)))[0], np.array([2.0, 0.5])
    readings = 2.0 * basis[:, 0] + axes[:, 0] + rng.standard_normal(6)
    drawn = rng.standard_normal((400_000, dof))
    paths = rng.standard_normal((400_000, 2)) * np.sqrt(variances) @ axes.T
    expected = []
    for signals in (paths, paths + 2.0 * drawn / np.linalg.norm(drawn, axis=1)[:, None] @ basis.T):
        expected.append(np.log(np.mean(np.exp(signals @ readings - 0.5 * np.sum(signals**2, axis=1)))))
    walk, other = Normal(axes, variances), Sphere(basis)
    assert walk.log_odds(readings, 2.0) == pytest.approx(expected[0], abs=0.02)
    odds = [_pair_log_odds(other, walk, readings, 2.0, np.random.default_rng(seed)) for seed in range(50)]
    found = np.exp(np.array(odds) - expected[1])
    assert found.mean() == pytest.approx(1.0, abs=0.03 + 0.4 * found.std()) and found.std() < 0.15


def test_paths_of_a_walk_of_one_size_are_told_as_well_as_by_a_plain_average() -> None:
    """Against the path that most look like; the mean of exp(s r - s s / 2) over paths drawn to one size."""
    times, sigmas = np.arange(6.0), 3.0
    walk = Process(np.linalg.cholesky(np.minimum.outer(times + 1.0, times + 1.0)))
    column = walk.parts(sigmas)[0].basis[:, :1]
    effects = {"bias-walk": walk, "other": Columns([column])}
    found = best_possible(effects, {name: {name} for name in effects}, sigmas, draws=4000)
    rng, right = np.random.default_rng(7), []
    paths = sigmas * walk.signals(20_000, rng)
    np.testing.assert_allclose(np.linalg.norm(paths, axis=1), sigmas)
    for true in effects:
        readings = sigmas * effects[true].signals(1000, rng) + rng.standard_normal((1000, 6))
        walks = np.mean(np.exp(readings @ paths.T - 0.5 * sigmas**2), axis=1)
        others = np.mean(
            [np.exp(sign * sigmas * readings @ column[:, 0] - 0.5 * sigmas**2) for sign in (-1, 1)], axis=0
        )
        right.append(np.mean((walks > others) == (true == "bias-walk")))
    assert 0.6 < np.mean(right) < 0.9
    assert np.mean(list(found.values())) == pytest.approx(np.mean(right), abs=4.0 * math.sqrt(0.25 / 2000))


def test_a_rival_can_be_taken_for_the_effect() -> None:
    """A line of four sigma, and noise of the same size evenly in six dimensions: Bayes' rule by plain averages."""
    rng, sigmas = np.random.default_rng(11), 4.0
    effects, rivals = {"a": Columns([np.eye(6)[:, :1]])}, {"scatter": Process(np.eye(6))}
    alone, beside = (
        best_possible(effects, {"a": {"a"}}, sigmas, draws=4000, rivals=own)["a"] for own in (None, rivals)
    )
    spread = rng.standard_normal((20_000, 6))
    spread *= sigmas / np.linalg.norm(spread, axis=1)[:, None]
    readings = sigmas * rng.choice([-1.0, 1.0], 2000)[:, None] * np.eye(6)[0] + rng.standard_normal((2000, 6))
    odds = np.cosh(sigmas * readings[:, 0]) > np.mean(np.exp(readings @ spread.T), axis=1)
    assert alone == 1.0 and 0.8 < beside < 1.0
    assert beside == pytest.approx(odds.mean(), abs=0.03)
