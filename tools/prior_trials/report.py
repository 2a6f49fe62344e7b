"""What a trial of the probabilities shows: reliability, ranks of the coefficients, confident names that are wrong."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.table import Table
from scipy.stats import beta, chi2, kstest

from prior_trials.truth import DWELL, NOISE, NOTHING, UNKNOWN

EDGES = (1e-4, 0.01, 0.05, 0.2, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0 + 1e-9)
"""Of the bins of probability."""
_SURE, _RANKS = 0.9, 10


def limits(count: int, trials: int, level: float = 0.99) -> tuple[float, float]:
    """The limits of Clopper and Pearson of a share."""
    tail = 0.5 * (1.0 - level)
    low = float(beta.ppf(tail, count, trials - count + 1)) if count else 0.0
    return low, float(beta.ppf(1.0 - tail, count + 1, trials - count)) if count < trials else 1.0


@dataclass(frozen=True)
class Bin:
    """Explanations whose probabilities are alike: how many, the mean of these, and how many of them were true."""

    low: float
    high: float
    count: int
    mean: float
    true: int

    @property
    def within(self) -> bool:
        """Whether the mean is within the limits of 99 % of the share that was true."""
        low, high = limits(self.true, self.count)
        return low <= self.mean <= high


class Report:
    """The tables of a trial, from its rows."""

    def __init__(self, rows: Sequence[dict[str, Any]]) -> None:
        self.rows = [row for row in rows if not row["refused"]]
        self.refused = Counter(row["refused"].split(":")[0][:60] for row in rows if row["refused"])

    def bins(self, rows: Sequence[dict[str, Any]] | None = None) -> Iterator[Bin]:
        """The reliability of all rows of all tables, those of little probability left out."""
        rows = self.rows if rows is None else rows
        pairs = [(share, label == row["truth"]) for row in rows
                 for label, share in zip(row["labels"], row["probabilities"], strict=True)]  # fmt: skip
        shares, true = np.array([share for share, _ in pairs]), np.array([is_true for _, is_true in pairs])
        for low, high in itertools.pairwise(EDGES):
            inside = (shares >= low) & (shares < high)
            if inside.any():
                yield Bin(low, high, int(inside.sum()), float(shares[inside].mean()), int(true[inside].sum()))

    @property
    def wrong(self) -> list[dict[str, Any]]:
        """The runs in which a name has 90 % and is not true."""
        return [row for row in self.rows if (best := _best(row)) and best[1] >= _SURE
                and best[0] not in {row["truth"], NOTHING, NOISE} and best[0] != UNKNOWN]  # fmt: skip

    @property
    def ranks(self) -> np.ndarray:
        """The ranks of all true coefficients."""
        return np.array([rank for row in self.rows for rank in row["ranks"]])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield f"{len(self.rows)} runs, {sum(self.refused.values())} refused {dict(self.refused)}"
        stated = [("stated", [row for row in self.rows if row["stated"]]),
                  ("not stated", [row for row in self.rows if not row["stated"]])]  # fmt: skip
        yield Group(*(self._reliability(name, rows) for name, rows in stated))
        yield self._kinds()
        if len(ranks := self.ranks):
            counts = np.histogram(ranks, np.linspace(0.0, 1.0, _RANKS + 1))[0]
            statistic = float(np.sum((counts - len(ranks) / _RANKS) ** 2) / (len(ranks) / _RANKS))
            p_values = float(chi2.sf(statistic, _RANKS - 1)), float(kstest(ranks, "uniform").pvalue)
            yield f"ranks of {len(ranks)} coefficients in tenths: {counts.tolist()}, p = {p_values[0]:.2g} by "
            yield f"chi-squared, {p_values[1]:.2g} by Kolmogorov and Smirnov"
        wrong = self.wrong
        yield f"names with 90 % or more that are not so: {len(wrong)} of {len(self.rows)}"
        for row in wrong[:40]:
            label, share = _best(row) or ("", 0.0)
            yield f"  seed {row['seed']}: {row['truth']} was {label} ({share:.1%})"

    def _reliability(self, name: str, rows: Sequence[dict[str, Any]]) -> Table:
        table = Table("said, %", "explanations", "mean, %", "true, %", "99 % limits", "", title=f"noise {name}")
        for each in self.bins(rows):
            low, high = limits(each.true, each.count)
            table.add_row(
                f"{100 * each.low:g} to {100 * min(each.high, 1.0):g}", str(each.count), f"{100 * each.mean:.1f}",
                f"{100 * each.true / each.count:.1f}", f"{100 * low:.1f} to {100 * high:.1f}",
                "" if each.within else "outside",
            )  # fmt: skip
        return table

    def _kinds(self) -> Table:
        table = Table("truth", "runs", "its mean probability, %", "first, %", title="kinds")
        for kind, rows in self._by_kind().items():
            tables = [dict(zip(row["labels"], row["probabilities"], strict=True)) for row in rows]
            shares = [shares.get(row["truth"], 0.0) for shares, row in zip(tables, rows, strict=True)]
            first = [(best := _best(row)) is not None and best[0] == row["truth"] for row in rows]
            table.add_row(kind, str(len(rows)), f"{100 * np.mean(shares):.0f}", f"{100 * np.mean(first):.0f}")
        return table

    def _by_kind(self) -> dict[str, list[dict[str, Any]]]:
        kinds = dict[str, list[dict[str, Any]]]()
        for row in self.rows:
            label = row["truth"]
            several = "effect beside unknown" if UNKNOWN in label else "pair"
            kind = label if label in {NOTHING, NOISE, UNKNOWN, DWELL} else several if "+" in label else "effect"
            kinds.setdefault(kind, []).append(row)
        return dict(sorted(kinds.items(), key=lambda each: -len(each[1])))


def _best(row: dict[str, Any]) -> tuple[str, float] | None:
    """Return the likeliest explanation of a run and its probability."""
    pairs = zip(row["labels"], row["probabilities"], strict=True)
    return max(pairs, key=lambda each: each[1], default=None)
