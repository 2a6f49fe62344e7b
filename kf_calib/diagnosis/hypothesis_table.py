"""Explanations of a misfit with their probabilities, as one table.

Its rows are made and weighed by ``posterior``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import weights

NOTHING, NOISE, NONE = "nothing", "unstated noise", "none of the known"
"""Families of the rows that name no effect: nothing missing, noise that was not stated, and no known effect."""

IRREGULAR = "irregular"
"""Driver of changes that follow nothing that was recorded."""

ALIKE = "like a known effect"
"""Driver of a cause in no catalogue that looks in this run like a known effect."""

SURE = 0.95
"""Probability from which an effect is taken for certain enough to be added without asking."""

CREDIBLE = 0.99
"""Probability of the set of explanations that is told."""

LISTED = 0.01
"""Least probability of an explanation that has a line of its own where the table is shown."""

AS_WELL = " as well as "
"""Between the drivers of two unknown functions."""

PRIOR = {
    "nothing": 0.4, "effect": 0.36, "pair": 0.08, "three": 0.005, "unknown": 0.1, "unknowns": 0.01, "beside": 0.02,
    "two beside": 0.005, "dwell": 0.02,
}  # fmt: skip
"""Prior probability of each kind of explanation; ``dwell``: one dwell is off; of several, each has that of one."""

KINDS = {
    (1, 0): "effect", (2, 0): "pair", (3, 0): "three", (0, 1): "unknown", (0, 2): "unknowns", (1, 1): "beside",
    (2, 1): "two beside",
}  # fmt: skip
"""What an explanation of so many effects, and so many unknown functions, is called in ``PRIOR``."""

_ALIKE = 0.05 * PRIOR["unknown"]  # of what has a known effect's look: what is in no catalogue, and 1 of 20 looks so


@dataclass(frozen=True)
class Hypothesis:
    """One row of the table.

    - effects: names of the effects that would be missing. formulas: those of no known effect, as they can be added,
      alone or beside an effect.
    - driver: in words, what the formulas depend on, one thing or two; "irregular" for changes of an unknown cause that
      follow nothing, "like a known effect" for a cause that cannot be told from one.
    - families: the physical classes of the effects.
    - log_evidence: of the row with its prior, natural logarithm. probability: its share in all rows.
    - statistic, dof: fall of chi-squared in the likeliest noise, and the number of coefficients; of a random walk alone
      twice its gain in likelihood; 0 of what was not fitted.
    - refit: the calibration with it; None where none was made.
    - dwells: the numbers of those that alone are off, the clearest first.
    """

    effects: tuple[str, ...] = ()
    formulas: tuple[str, ...] = ()
    driver: str = ""
    families: tuple[str, ...] = ()
    log_evidence: float = 0.0
    statistic: float = 0.0
    dof: int = 0
    refit: Calibration | None = None
    probability: float = 0.0
    dwells: tuple[int, ...] = ()

    @property
    def unknown(self) -> bool:
        """Whether the row says that nothing is missing but what no known effect explains."""
        return bool(self.driver) and not self.effects

    @property
    def causes(self) -> frozenset[str]:
        """The effects, and what the unknown function depends on."""
        return frozenset({*self.effects, *self.driver.split(AS_WELL)} - {""})


@dataclass(frozen=True)
class HypothesisTable:
    """All rows, the likeliest first; their probabilities sum to one.

    certain: the row of effects that are missing for sure, where the likeliest row has further ones that nothing shows.
    scattering: the accelerometer, or the gimbal, that alone scatters from dwell to dwell, if something does; "" where
    others do, too. same: effects that explain in this run just what the one of the likeliest row does.
    """

    rows: tuple[Hypothesis, ...]
    certain: Hypothesis | None = None
    scattering: str = ""
    same: tuple[str, ...] = ()

    def __repr__(self) -> str:
        def name(row: Hypothesis) -> str:
            beside = [f"unknown, goes with {row.driver}"] if row.effects and row.driver else []
            return " + ".join([*(row.effects or row.families), *beside])

        return "\n".join(f"{row.probability:7.2%} {name(row)}" for row in self.listed)

    @cached_property
    def families(self) -> dict[str, float]:
        """Probability that something of each family is missing; with two effects at once they sum to more than one."""
        probabilities = dict[str, float]()
        for row in self.rows:
            for family in row.families:
                probabilities[family] = probabilities.get(family, 0.0) + row.probability
        return dict(sorted(probabilities.items(), key=lambda each: -each[1]))

    def probability(self, effects: Sequence[str]) -> float:
        """Probability that all these effects are missing, alone or with others."""
        return sum(row.probability for row in self.rows if set(effects) <= set(row.effects))

    def probability_of_dwell(self, number: int) -> float:
        """Probability that a dwell is off, alone or with others."""
        return sum(row.probability for row in self.rows if number in row.dwells)

    def with_dwell_alone(self, number: int) -> HypothesisTable:
        """The table where it turned out that all other dwells agree without one that is off."""
        share = self.probability_of_dwell(number)
        first = replace(self.first, driver=f"dwell {number} alone", dwells=(number,), probability=share)
        return replace(self, rows=(first, *(row for row in self.rows if number not in row.dwells)))

    def probability_with(self, row: Hypothesis) -> float:
        """Probability of the causes of a row, alone or with others."""
        return sum(each.probability for each in self.rows if row.causes <= each.causes)

    def probability_of_class(self, effects: Sequence[str]) -> float:
        """Probability that all these effects are missing, alone or with others, or what is the same as the first."""
        if tuple(effects) != self.first.effects or not self.same:
            return self.probability(effects)
        names = {*effects, *self.same}
        return sum(row.probability for row in self.rows if names & {*row.effects})

    def probability_of_just(self, effects: Sequence[str]) -> float:
        """Probability that these effects are missing, and no others: that of their row."""
        return sum(row.probability for row in self.rows if set(effects) == set(row.effects) and not row.formulas)

    def probability_of_just_known(self, effects: Sequence[str]) -> float:
        """Probability that these effects are missing, and of the known ones no others."""
        return sum(row.probability for row in self.rows if set(effects) == set(row.effects))

    def probability_of_families(self, families: Iterable[str]) -> float:
        """Probability that something of any of these families is missing."""
        return sum(row.probability for row in self.rows if set(row.families) & set(families))

    def probability_of_added(self, text: str, name: str) -> float | None:
        """Probability that what was added to a model is missing, alone or with others; None where no row has it.

        text: the effect as it was added, which a formula is told by. name: its name.
        """
        rows = [row for row in self.rows if name in row.effects or text in row.formulas]
        return sum(row.probability for row in rows) if rows else None

    @cached_property
    def log10_odds(self) -> tuple[float | None, ...]:
        """Log10 of the odds of each row to the next; None of the last."""
        logs = [row.log_evidence / math.log(10.0) for row in self.rows]
        return (*(one - next_ for one, next_ in itertools.pairwise(logs)), None)

    @property
    def listed(self) -> tuple[Hypothesis, ...]:
        """The rows that have a line of their own where the table is shown, those of ``LISTED`` or more, and the
        first."""
        return tuple(row for row in self.rows if row.probability >= LISTED or row is self.first)

    @property
    def first(self) -> Hypothesis:
        """The likeliest explanation, with nothing missing left out, or what is certain of it."""
        return self.certain or next(row for row in self.rows if row.families != (NOTHING,))

    @cached_property
    def rivals(self) -> tuple[Hypothesis, ...]:
        """The explanations in place of the first that have ``CREDIBLE`` of the probability together with it and with
        those that only add to its effects; without those that look like it."""
        first, rows = self.first, [row for row in self.rows if row.families != (NOTHING,) and row.driver != ALIKE]
        told = frozenset(first.effects) or first.causes
        agreeing = [row for row in rows if row is first or (told and told <= row.causes)]
        others = [row for row in rows if all(row is not each for each in agreeing)]
        shares = [sum(row.probability for row in agreeing), *(row.probability for row in others)]
        before = np.cumsum(shares) / sum(shares)
        same = [{name} for name in self.same]
        credible = [row for row, share in zip(others, before[:-1], strict=True) if share < CREDIBLE]
        return tuple(row for row in credible if row.formulas or not any(each <= {*row.effects} for each in same))


def table_of(rows: Iterable[Hypothesis]) -> HypothesisTable:
    """The table of rows, of which only the evidence is known, with one for causes that look like a known effect."""
    rows = [replace(row, log_evidence=row.log_evidence + math.log1p(-_ALIKE)) if row.effects else row for row in rows]
    if with_effects := [row.log_evidence for row in rows if row.effects]:
        alike = float(np.logaddexp.reduce(with_effects)) + math.log(_ALIKE / (1.0 - _ALIKE))
        rows.append(Hypothesis(driver=ALIKE, families=(NONE,), log_evidence=alike))
    logs = np.array([row.log_evidence for row in rows])
    weighed = [replace(row, probability=share) for row, share in zip(rows, weights(logs).tolist(), strict=True)]
    return HypothesisTable(tuple(sorted(weighed, key=lambda row: -row.probability)))


def noise_p(table: HypothesisTable) -> float:
    """P-value of noise alone, stated or not, against all that a table has beside it.

    In noise the odds of the others to it, over their odds before the readings, have the mean 1, so that they exceed 1/p
    with a probability of p at most (Markov's inequality).
    """
    alone = table.families.get(NOTHING, 0.0) + table.families.get(NOISE, 0.0)
    before = PRIOR["nothing"] / (1.0 - PRIOR["nothing"])
    return min(1.0, alone / max(1.0 - alone, 1e-300) / before)
