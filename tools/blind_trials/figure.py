"""A figure of the report, and a share with its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

ENOUGH_TRIALS = 20  # with fewer, a figure is shown and not judged


@dataclass(frozen=True)
class Figure:
    """One line of the report.

    low, high: 95 % limits. count: number of trials. bar: what is asked for. meets: whether the value meets it (None:
    not judged). refused: number of trials without an answer; each counts as not right.
    """

    name: str
    value: float
    low: float
    high: float
    count: int
    bar: str = ""
    meets: bool | None = None
    refused: int = 0


def rate(name: str, hits: Sequence[bool], least: float | None = None, most: float | None = None) -> Figure:
    """Return the share of hits with its exact 95 % limits (Clopper and Pearson)."""
    if not hits:
        return Figure(name, float("nan"), 0.0, 1.0, 0, _bar(least, most), None)
    found = binomtest(sum(hits), len(hits)).proportion_ci(0.95, method="exact")
    value = sum(hits) / len(hits)
    judged = (least, most) != (None, None) and len(hits) >= ENOUGH_TRIALS
    meets = (least or 0.0) <= value <= (1.0 if most is None else most) if judged else None
    return Figure(name, value, float(found.low), float(found.high), len(hits), _bar(least, most), meets)


def _bar(least: float | None, most: float | None) -> str:
    """Return what is asked for in words."""
    if least is not None and most is not None:
        return f"{least:.0%} to {most:.0%}"
    return f">= {least:.0%}" if least is not None else f"<= {most:.0%}" if most is not None else ""
