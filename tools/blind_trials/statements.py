"""What the program states with a probability, and whether it is true."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from blind_trials.outcome import NOISE, NOTHING, Hypothesis, Outcome


@dataclass(frozen=True)
class Statement:
    """Something that is true with a stated probability, and whether it is."""

    probability: float
    true: bool


def name_statements(each: Outcome) -> list[Statement]:
    """Return a statement for each hypothesis: what is missing is this, and nothing else."""
    return _together([Statement(own.probability, is_true(own, each)) for own in each.hypotheses])


def family_statements(each: Outcome) -> list[Statement]:
    """Return a statement for each physical family that has a probability: something of it is missing."""
    true = true_families(each)
    stated = [Statement(probability, family in true) for family, probability in each.families]
    return stated if len(each.truth) > 1 else _together(stated)


def is_true(own: Hypothesis, each: Outcome) -> bool:
    """Tell whether a hypothesis is true.

    Names are true if they mean all hidden effects; a formula or an unknown cause is true if the effect is in no
    catalogue.
    """
    if own.effects:
        return not own.formula and bool(each.truth) and each.explained_by(own.effects)
    if NOISE in own.families:
        return each.is_noise
    return not (each.truth or each.is_noise) if NOTHING in own.families else bool(each.outside)


def probability_of_truth(each: Outcome) -> float:
    """Return the probability that the program gives to what is true."""
    return sum(own.probability for own in name_statements(each) if own.true)


def true_families(each: Outcome) -> tuple[str, ...]:
    """Return the families of what is missing; where nothing is hidden it is noise, or nothing."""
    return each.true_families if each.truth else (NOISE,) if each.is_noise else (NOTHING,)


def _together(stated: Iterable[Statement]) -> list[Statement]:
    """Return statements that exclude each other; the true ones mean the same in this run and become one."""
    own = list(stated)
    true, false = ([each for each in own if each.true is which] for which in (True, False))
    return [*([Statement(sum(each.probability for each in true), True)] if true else []), *false]
