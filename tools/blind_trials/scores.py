"""Scores of the stated probabilities: the smaller, the better."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from blind_trials.figure import Figure
from blind_trials.outcome import Outcome
from blind_trials.statements import Statement, family_statements, name_statements, true_families

_LEAST = 1e-6  # probability that the log score takes for a truth that is not stated at all


def score_figures(done: Sequence[Outcome]) -> Iterator[Figure]:
    """Yield the log score and the Brier score of names and of families, the means over all trials with probabilities.

    A truth that is not stated at all counts as stated with probability zero.
    """
    names = [_with_truth(name_statements(each), 1) for each in done if each.hypotheses]
    families = [_with_truth(family_statements(each), _families_of(each)) for each in done if each.families]
    for what, stated in (("names", names), ("families", families)):
        if stated:
            yield _mean(f"{what}: log score, -ln of the probability of the truth, mean", _log_score, stated)
            yield _mean(f"{what}: Brier score, sum of squared errors, mean", _brier_score, stated)


def _families_of(each: Outcome) -> int:
    """Return the number of true statements about families that a trial needs: one, or one a family for two effects."""
    return len(true_families(each)) if len(each.truth) > 1 else 1


def _with_truth(stated: list[Statement], count: int) -> list[Statement]:
    """Return statements with those added that are true and missing among them."""
    return [*stated, *[Statement(0.0, True)] * (count - sum(each.true for each in stated))]


def _log_score(stated: list[Statement]) -> float:
    """Return -ln of the probability of what is true."""
    return -float(np.mean([np.log(max(each.probability, _LEAST)) for each in stated if each.true]))


def _brier_score(stated: list[Statement]) -> float:
    """Return the sum of the squared differences of probability and truth."""
    return sum((each.true - each.probability) ** 2 for each in stated)


def _mean(name: str, score: Callable[[list[Statement]], float], stated: Sequence[list[Statement]]) -> Figure:
    """Return the mean of a score with its 95 % limits."""
    values = [score(each) for each in stated]
    mean, half = float(np.mean(values)), 1.96 * float(np.std(values) / np.sqrt(len(values)))
    return Figure(name, mean, mean - half, mean + half, len(values))
