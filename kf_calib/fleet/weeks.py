"""What runs came to, and how many of them in each week."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import Any


@dataclass(frozen=True)
class Weeks:
    """How many runs came to what in each week, the most frequent verdict first; begins: Mondays, without gaps.

    undated: runs of which nobody knows the date.
    """

    begins: tuple[date, ...]
    counts: Mapping[str, tuple[int, ...]]
    undated: int


def counted(rows: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """How many rows came to what verdict, the most frequent first."""
    return dict(Counter(verdict_of(row) for row in rows).most_common())


def verdict_of(row: Mapping[str, Any]) -> str:
    """What the run of a row came to, in a word or two."""
    if row["error"] is not None:
        return "failed"
    if row["consistent"] is None:
        return "not judged"
    return row["missing"] or ("consistent" if row["consistent"] else "inconsistent")


def weeks_of(rows: Sequence[Mapping[str, Any]]) -> Weeks:
    """The verdicts of the runs by week."""
    dated = [(_monday(row["date"]), verdict_of(row)) for row in rows if row["date"] is not None]
    mondays = sorted({monday for monday, _ in dated})
    count = (mondays[-1] - mondays[0]).days // 7 + 1 if mondays else 0
    begins = [mondays[0] + timedelta(weeks=k) for k in range(count)]
    counts = dict[str, list[int]]()
    for monday, verdict in dated:
        counts.setdefault(verdict, [0] * count)[(monday - mondays[0]).days // 7] += 1
    ordered = sorted(counts.items(), key=lambda item: -sum(item[1]))
    return Weeks(tuple(begins), {name: tuple(own) for name, own in ordered}, len(rows) - len(dated))


def _monday(when: datetime) -> date:
    return when.date() - timedelta(days=when.weekday())
