"""Which trials are played."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from blind_trials.families import ROWS, Request, Row
from blind_trials.plays import PLAYS
from blind_trials.task import FAMILIES, Task
from blind_trials.visible_effects import visible_effects


def tasks(
    families: Sequence[str], runs: int, seed: int, effects: Sequence[str] = (), setting: str = Task.setting
) -> list[Task]:
    """Return all trials of some families; their seeds do not depend on which other families are asked for.

    runs: the scale of ``COUNTS``. seed: of the whole trial. effects: hide only these (empty: all that the run shows).
    setting: setting error of an orientation, deg.
    """
    needed = set(families) - {"noise", "invisible", "outside", "unstated-outside"}
    visible = list(effects) or (visible_effects() if needed else [])
    return [task for each in families for task in _family_tasks(each, runs, seed, effects, visible, setting)]


def _family_tasks(
    family: str, runs: int, seed: int, effects: Sequence[str], visible: Sequence[str], setting: str
) -> list[Task]:
    """Return the trials of one family."""
    first = 10_000_000 * seed + 100_000 * FAMILIES.index(family)
    numbers = itertools.count(first)
    play = family if family in PLAYS else "diagnose"

    def task(row: Row) -> Task:
        """Return the trial of a row, with the next seed unless the row has one."""
        own = next(numbers) if row.round is None else first + row.round
        return Task(f"{family}@{row.which}", play, own, row.hidden, row.options, row.setting or setting)

    rows = ROWS[family](Request(family, runs, effects, visible, np.random.default_rng(seed)))
    return [task(row) for row in rows]


def thin(every: list[Task], limit: int | None) -> list[Task]:
    """Return at most ``limit`` trials of each figure, spread evenly; all of them where there is no limit."""
    if limit is None:
        return every
    groups = dict[str, list[Task]]()
    for task in every:
        groups.setdefault(task.figure, []).append(task)
    return [own[k] for own in groups.values() for k in np.unique(np.linspace(0, len(own) - 1, limit).astype(int))]
