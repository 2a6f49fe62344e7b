"""The reliability diagram: of all statements made with some probability, how many are true."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from blind_trials.figure import Figure, rate
from blind_trials.outcome import Outcome
from blind_trials.statements import Statement, family_statements, name_statements

_EDGES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
_WHAT: dict[str, Callable[[Outcome], list[Statement]]] = {"names": name_statements, "families": family_statements}


@dataclass(frozen=True)
class Bin:
    """Statements made with a probability between two limits.

    what: names or families. low, high: the limits of the probability. stated: its mean. true: share of statements that
    are true, with its 95 % limits.
    """

    what: str
    low: float
    high: float
    stated: float
    true: Figure

    @property
    def calibrated(self) -> bool:
        """Whether the mean probability is within the limits of the share."""
        return self.true.low <= self.stated <= self.true.high

    @property
    def words(self) -> str:
        """The range of probabilities in per cent."""
        return f"{100 * self.low:g} to {100 * self.high:g} %"


def bins(outcomes: Sequence[Outcome]) -> list[Bin]:
    """Return the bins that hold statements, of names and of families, from the least probability on."""
    judged = [each for each in outcomes if not each.error]
    return [
        found
        for what, statements in _WHAT.items()
        for found in _bins_of(what, [own for each in judged for own in statements(each)])
    ]


def _bins_of(what: str, stated: Sequence[Statement]) -> list[Bin]:
    """Return the bins of some statements; a probability on an edge belongs to the bin above it, 1 to the last."""
    number = np.digitize([each.probability for each in stated], _EDGES[1:-1])
    out = list[Bin]()
    for k, (low, high) in enumerate(pairwise(_EDGES)):
        own = [each for each, at in zip(stated, number, strict=True) if at == k]
        if own:
            mean = float(np.mean([each.probability for each in own]))
            out.append(Bin(what, low, high, mean, rate("", [each.true for each in own])))
    return out


def reliability_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return the rows of the table: what was stated, and how often it was true."""
    rows = [["of", "stated", "mean", "true", "95 % limits", "statements", ""]]
    for each in bins(outcomes):
        mark = "within" if each.calibrated else "outside"
        limits = f"{each.true.low:.3f} to {each.true.high:.3f}"
        rows.append(
            [each.what, each.words, f"{each.stated:.3f}", f"{each.true.value:.3f}", limits, str(each.true.count), mark]
        )
    return rows


def save_reliability(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the shares of true statements with their limits, over boxes where they should be."""
    from matplotlib.figure import Figure as Sheet

    sheet, found = Sheet(figsize=(10.0, 4.5), layout="constrained"), bins(outcomes)
    for what, axes in zip(_WHAT, sheet.subplots(1, len(_WHAT), sharey=True), strict=True):
        own = [each for each in found if each.what == what]
        places = np.arange(len(own))
        axes.bar(
            places, [each.high - each.low for each in own], 0.8, [each.low for each in own],
            color="0.85", edgecolor="0.6", label="stated: range",
        )  # fmt: skip
        axes.hlines([each.stated for each in own], places - 0.4, places + 0.4, color="0.4", label="stated: mean")
        shares = np.array([each.true.value for each in own])
        limits = np.array([[each.true.low, each.true.high] for each in own]).reshape(-1, 2).T
        axes.errorbar(places, shares, np.abs(limits - shares), fmt="o", capsize=3, label="true, with 95 % limits")
        axes.set_xticks(places, [f"{each.words}\n{each.true.count}" for each in own], rotation=60, fontsize=8)
        axes.set(title=what, xlabel="stated probability, and number of statements", ylim=(-0.03, 1.03))
    sheet.axes[0].set_ylabel("share that is true")
    sheet.axes[0].legend(loc="upper left", fontsize=8)
    sheet.savefig(path, dpi=110)
