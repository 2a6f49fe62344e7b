"""The tables of a trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from rich.console import Group
from rich.table import Table

from blind_trials.confusion import confusion
from blind_trials.criteria import APART, overlap_of
from blind_trials.figures import figures
from blind_trials.outcome import Outcome
from blind_trials.reliability import reliability_rows
from blind_trials.task import FAR_SIGMA, OUTSIDE


def report(outcomes: Sequence[Outcome]) -> Group:
    """Return the figures, then the names given for each effect in rows: a matrix of forty columns fits no terminal."""
    tables = list[Table]()
    for title, rows in _tables(outcomes).items():
        if len(rows) == 1:
            continue
        tables.append(Table(*rows[0], title=title, title_justify="left"))
        for row in rows[1:]:
            tables[-1].add_row(*(f"[bold red]{cell}" if cell == "missed" else cell for cell in row))
    return Group(*tables, *notes(outcomes))


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the same tables in Markdown, for docs/blind_trial.md."""
    tables = [
        "\n".join("| " + " | ".join(row) + " |" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:]))
        for rows in _tables(outcomes).values()
        if len(rows) > 1
    ]
    return "\n\n".join([*tables, *notes(outcomes)]) + "\n"


def _tables(outcomes: Sequence[Outcome]) -> dict[str, list[list[str]]]:
    """Return the rows of each table by its title, the heads first."""
    return {
        "Figures": figure_rows(outcomes),
        "What was stated, and how often it was true": reliability_rows(outcomes),
        "Hidden, and what was named": effect_rows(outcomes),
    }


def figure_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return the rows of the table of figures."""
    rows = [["figure", "value", "95 % limits", "trials", "refused", "asked for", ""]]
    for each in figures(outcomes):
        mark = {True: "met", False: "missed", None: ""}[each.meets]
        limits, refused = f"{each.low:.3f} to {each.high:.3f}", str(each.refused) if each.refused else ""
        rows.append([each.name, f"{each.value:.3f}", limits, str(each.count), refused, each.bar, mark])
    return rows


def effect_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return the rows of the table of hidden effects: trials, how many were right, and what was named instead."""
    judged = [each for each in outcomes if (each.refused or not each.error) and len(each.truth) == 1]
    heads = {
        "name@8": "8",
        "name@10": "10",
        "name@15": "15",
        "unstated@10": "nothing stated, 10",
        f"unstated@{FAR_SIGMA}": f"nothing stated, {FAR_SIGMA}",
        "outside@15": "unknown",
        "unstated-outside@15": "unknown, nothing stated",
    }
    rows = [["hidden", *(f"right, {head}" for head in heads.values()), "set holds it", "power", "named instead"]]
    said = confusion([each for each in judged if each.task.family not in OUTSIDE or overlap_of(each) < APART])
    for true in dict.fromkeys(each.truth[0] for each in judged):
        own = [each for each in judged if each.truth[0] == true]
        named = {figure: [each for each in own if each.task.figure == figure] for figure in heads}
        right = [[e.outside_right if e.task.family in OUTSIDE else e.right for e in each] for each in named.values()]
        given = [each.held for each in own if each.task.family in ("name", "unstated") and each.ambiguity]
        noticed = [each.consistent is False for each in own if each.task.family == "power"]
        others = [f"{name} {count}" for name, count in said.get(true, Counter()).most_common() if name != true]
        rows.append([true, *map(_share, [*right, given, noticed]), ", ".join(others)])
    rows[1:] = [row for row in rows[1:] if any(row[1:])]
    used = [k for k in range(len(rows[0])) if k == 0 or any(row[k] for row in rows[1:])]
    return [[row[k] for k in used] for row in rows]


def _share(hits: Sequence[bool]) -> str:
    """Return hits and trials as text."""
    return f"{sum(hits)}/{len(hits)}" if hits else ""


def notes(outcomes: Sequence[Outcome]) -> list[str]:
    """Return sentences on trials without an answer, on those that could not be made, and on processor time."""
    errors = Counter((each.refused, f"{each.task.figure}: {each.error}") for each in outcomes if each.error)
    words = {True: "Refused", False: "Not judged"}
    return [*(f"{words[kind]}, {count} times: {text}" for (kind, text), count in errors.most_common()), _cost(outcomes)]


def _cost(outcomes: Sequence[Outcome]) -> str:
    """Return a sentence on the processor time of a trial, by family."""
    spent = dict[str, list[float]]()
    for each in outcomes:
        spent.setdefault(each.task.family, []).append(sum(each.seconds.values()))
    words = [f"{family} {np.mean(own):.2f}" for family, own in spent.items() if any(own)]
    return f"Processor seconds a trial: {', '.join(words)}; in all {sum(map(sum, spent.values())):.0f}."
