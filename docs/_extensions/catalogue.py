"""The page of effects, written from what ``kf-calib effects --json`` and ``simulate --hide help`` say."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from typing import Any

from click.testing import CliRunner
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from kf_calib.cli import cli


class Catalogue(SphinxDirective):
    """``:::{catalogue}``: an overview of all effects, then each with its formula, coefficients, source and rivals."""

    def run(self) -> list[nodes.Node]:
        every = [list(own) for _, own in groupby(json.loads(_said("effects", "--json"))["effects"], key=_name)]
        lines = [*_overview(every), *_details(every), *_typical_sizes()]
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True)


def _said(*words: str) -> str:
    return CliRunner().invoke(cli, words, catch_exceptions=False).stdout


def _typical_sizes() -> Iterator[str]:
    yield from ("", "## Sizes to hide", "")
    yield "What `simulate --hide EFFECT=SIZE` can hide, and how large it is in sensors of navigation grade and, below"
    yield from ("that, in MEMS sensors:", "", "```text", _said("simulate", "--hide", "help").rstrip(), "```")


def _name(effect: dict[str, Any]) -> str:
    """Of all gimbals' variants of an effect."""
    return effect["effect"].partition(":")[0]


def _overview(every: list[list[dict[str, Any]]]) -> Iterator[str]:
    yield from ("## All effects", "")
    yield from ("| effect | what it is | borne by | confused with, shown by |", "|---|---|---|---|")
    for own in every:
        first = own[0]
        name, confused = _name(first), _plain(first["confused_with"])
        yield f"| [`{name}`](#{name}) | {first['title']} | {first['borne_by']} | {confused} |"


def _details(every: list[list[dict[str, Any]]]) -> Iterator[str]:
    for own in every:
        first = own[0]
        yield from ("", f"## {_name(first)}", "", f"{_sentence(first['title'])}", "")
        yield from ("```text", first["formula"], "```", "")
        if len(own) > 1:
            names = ", ".join(f"`{each['effect']}`" for each in own)
            yield f"One effect for each gimbal: {names}.\n"
        yield from _coefficients(first)
        yield from _typical(first)
        if first["confused_with"]:
            yield f"\n**Confused with, shown by:** {_plain(first['confused_with'])}."
        yield f"\n**Source:** {_plain(first['source'])}."


def _coefficients(effect: dict[str, Any]) -> Iterator[str]:
    """Coefficients of one unit and size share a row."""
    if not effect["coefficients"] and not effect["unknown"]:
        return
    yield from ("| coefficient | unit | large is |", "|---|---|---|")
    alike = groupby(effect["coefficients"], key=lambda c: (c["unit"], c["scale"] * c["per_si"], c["shown_unit"]))
    for (unit, size, shown_unit), own in alike:
        symbols = " ".join(f"`{each['symbol']}`" for each in own)
        yield f"| {symbols} | `{unit}` | {_number(size)} {shown_unit} |"
    if unknown := effect["unknown"]:
        between = f"looked for from {_number(unknown['low'])} to {_number(unknown['high'])} {unknown['unit']}"
        yield f"| `{unknown['symbol']}` | `{unknown['unit']}` | {between} |"


def _typical(effect: dict[str, Any]) -> Iterator[str]:
    """Usual sizes of a coefficient in sensors of each grade."""
    said = list[str]()
    for grade, words in (("navigation", "in sensors of navigation grade"), ("mems", "in MEMS sensors")):
        if (sizes := effect["typical"][grade]) is not None:
            own = effect["coefficients"][0]
            low, high = (_number(size * own["per_si"]) for size in sizes)
            between = high if low == high else f"up to {high}" if not sizes[0] else f"{low} to {high}"
            said.append(f"{between} {own['shown_unit']} {words}")
    if said:
        yield f"\n**Typical size:** {', '.join(said)}."


def _number(value: float) -> str:
    return f"{float(f'{value:.3g}'):g}"


def _sentence(text: str) -> str:
    return _plain(text[:1].upper() + text[1:]) + "."


def _plain(text: str) -> str:
    """Text of the program, in which no sign is markup."""
    return "".join(f"\\{sign}" if sign in "\\`*_[]<>|$#" else sign for sign in text)


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("catalogue", Catalogue)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
