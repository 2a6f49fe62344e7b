"""Pairs of effects, which may mask each other, or explain together what neither of them explains alone.

A pair holds the numbers of two candidates of a test. An effect without columns, as the random walk of the biases, is no
candidate, and a pair holds its name instead.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import EQUAL, CandidateTests, chance_fall, margin_of, walk_path_margin

_EQUAL_PAIR = 9.21  # as EQUAL, for two pairs that have no effect in common: 1 %, 2 degrees of freedom

MOST = 3
"""Number of pairs that are refitted, and that are named in a verdict."""

Member = int | str
Pair = tuple[Member, Member]
Pairs = Mapping[Pair, float]
"""The score of each pair: the fall of chi-squared less the thresholds (``chance_fall``) of both effects."""


def candidate_pairs(test: CandidateTests) -> dict[Pair, float]:
    """Pairs of candidates of which each is significant beside the other, with their scores."""
    candidates, falls = test.scan.candidates, test.scan.statistics
    prices = [chance_fall(each, test.effective_tests) if each.dof else 0.0 for each in candidates]
    out = dict[Pair, float]()
    for j, k in itertools.combinations([k for k, each in enumerate(candidates) if each.dof], 2):
        one, two = candidates[j], candidates[k]
        if str(one.effect) == str(two.effect):
            continue
        fall = falls[j] + test.scan.explained(two.basis - one.basis @ (one.basis.T @ two.basis))[0]
        if fall - falls[j] > prices[k] and fall - falls[k] > prices[j]:
            out[j, k] = float(fall - prices[j] - prices[k])
    return out


def walk_path_margin_beside(test: CandidateTests, pairs: Pairs, k: int) -> float:
    """What is added to the score of a random walk beside candidate ``k``, for comparison with other effects beside it.

    With it, the walk ranks ahead of the best other effect beside ``k`` exactly where its likelihood is higher.
    """
    candidates, tests = test.scan.candidates, test.effective_tests
    scores = {j if i == k else i: score for (i, j), score in pairs.items() if k in (i, j)}
    if not scores:
        return 0.0
    best = name_of(test, max(scores, key=lambda j: scores[j]))
    beside = [j for j in scores if isinstance(j, int) and name_of(test, j) == best]
    own = float(test.scan.statistics[k]) - chance_fall(candidates[k], tests)
    falls = np.array([scores[j] - own + chance_fall(candidates[j], tests) for j in beside])
    return walk_path_margin(test.scan, beside, falls, max(scores[j] for j in beside) - own, tests)


def likeliest_pairs(test: CandidateTests, pairs: Pairs) -> list[Pair]:
    """The pairs with the highest scores, each pair of effects once, at the best values of their constants."""
    named = dict[tuple[str, str], Pair]()
    for pair in sorted(pairs, key=lambda pair: -pairs[pair]):
        named.setdefault(names_of(test, pair), pair)
    return list(named.values())[:MOST]


def equal_pairs(test: CandidateTests, pairs: Pairs, score: float, but: Collection[str]) -> list[tuple[str, str]]:
    """Names of the best pairs that explain as much as an explanation with the given score does.

    score: of that explanation. but: the one or two effects of which it consists; pairs with any of them are left out.
    """
    equal = EQUAL if len(but) == 1 else _EQUAL_PAIR
    near = sorted((pair for pair in pairs if pairs[pair] > score - equal), key=lambda pair: -pairs[pair])
    named = dict.fromkeys(names_of(test, pair) for pair in near)
    return [pair for pair in named if not set(pair) & set(but)][:MOST]


def exchangeable_effects(test: CandidateTests, pairs: Pairs, pair: Pair, least: float) -> dict[str, float]:
    """Effects that could take the place of one effect of a pair, with the overlap of each with the one it replaces.

    pairs: scores of all pairs. least: overlap that an effect has to exceed to count.
    """
    both, out = names_of(test, pair), dict[str, float]()
    for other in pairs:
        shared = set(pair) & set(other)
        if len(shared) != 1:
            continue
        (lost,), (new,) = set(pair) - shared, set(other) - shared
        if pairs[other] > pairs[pair] - margin_of(None if isinstance(lost, str) else test.scan.candidates[lost]):
            name, overlap = name_of(test, new), candidate_overlap(test, lost, new)
            if overlap > max(least, out.get(name, 0.0)) and name not in both:
                out[name] = overlap
    return out


def names_of(test: CandidateTests, pair: Pair) -> tuple[str, str]:
    """Names of the two effects of a pair."""
    one, two = (name_of(test, k) for k in pair)
    return one, two


def name_of(test: CandidateTests, member: Member) -> str:
    """Name of one of the effects of a pair."""
    return member if isinstance(member, str) else str(test.scan.candidates[member].effect)


def candidate_overlap(test: CandidateTests, one: Member, other: Member) -> float:
    """The overlap of two effects; it is 1 with one without columns, as a random walk, which can take any path."""
    if isinstance(one, str) or isinstance(other, str):
        return 1.0
    return test.scan.candidates[one].overlap(test.scan.candidates[other])


def overlap_matrix(test: CandidateTests, names: Sequence[str]) -> Floats:
    """The overlaps (n, n) of effects with each other; NaN with one that has no columns in the scan and is no walk."""
    members: list[Member | None] = [test.best.get(name, name if name == test.walking else None) for name in names]
    overlaps = [
        [np.nan if one is None or other is None else candidate_overlap(test, one, other) for other in members]
        for one in members
    ]
    return np.array(overlaps, float).reshape(len(names), len(names))
