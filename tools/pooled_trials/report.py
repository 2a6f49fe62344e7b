"""Outcomes of trials as shares, and how reliable the probabilities were."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

_FIGURES: tuple[tuple[str, str], ...] = (
    ("named", "effect named"), ("exactly", "by its own name"), ("right_side", "bench or sensors right"),
    ("right", "named and attributed right"), ("more", "a further effect, falsely"), ("units_right", "units right"),
    ("covers", "share in its 95 % interval"), ("date_within", "date in its 95 % set"), ("date_off", "date off by runs"),
)  # fmt: skip
_EDGES = (0.0, 0.05, 0.5, 0.8, 0.95, 0.99, 1.0)


def report(outcomes: Sequence[dict[str, Any]]) -> Group:
    """Return the tables of all outcomes."""
    return Group(_shares(outcomes), _reliability(outcomes))


def right(each: dict[str, Any]) -> bool:
    """Tell whether effect and attribution are right."""
    return bool(each["named"] and each.get("right_side"))


def _shares(outcomes: Sequence[dict[str, Any]]) -> Table:
    out = Table("campaigns", "number", "figure", "mean", title="What was found")
    for kind in dict.fromkeys((each["kind"], each["simulated"]) for each in outcomes):
        own = [each | {"right": right(each)} for each in outcomes if (each["kind"], each["simulated"]) == kind]
        name = kind[0] + (", simulated" if kind[1] else "")
        if kind[0] == "noise":
            out.add_row(name, str(len(own)), "false alarm", f"{np.mean([bool(each['found']) for each in own]):.3f}")
            continue
        for key, words in _FIGURES:
            values = [float(each[key]) for each in own if key in each]
            if values:
                out.add_row(name, str(len(values)), words, f"{np.mean(values):.3f}")
    return out


def _reliability(outcomes: Sequence[dict[str, Any]]) -> Table:
    out = Table("probability", "from", "to", "number", "mean", "true", title="How reliable the probabilities are")
    sides = [each for each in outcomes if "of_bench" in each]
    pairs: dict[str, list[tuple[float, bool]]] = {
        "that the effect is the bench's": [(each["of_bench"], each["kind"] in ("bench", "repaired")) for each in sides],
        "of the effect that was named": [(each["probability"], each["exactly"]) for each in sides],
        "that a unit has the effect": [
            (chance, has) for each in outcomes for chance, has in each.get("units", []) if "covers" in each
        ],
    }
    for words, own in pairs.items():
        _add_rows(out, words, own)
    return out


def _add_rows(out: Table, words: str, own: Iterable[tuple[float, bool]]) -> None:
    values = np.array([(chance, true) for chance, true in own], float).reshape(-1, 2)
    for low, high in itertools.pairwise(_EDGES):
        here = values[(values[:, 0] >= low) & ((values[:, 0] < high) | (high == 1.0))]
        if len(here):
            chance, true = here.mean(axis=0)
            out.add_row(words, f"{low:g}", f"{high:g}", str(len(here)), f"{chance:.3f}", f"{true:.3f}")
