"""Writes the pages of reference that follow from the program itself: effects, commands and the Python interface.

    python tools/reference_pages.py [--check]

What stands above the line ``WRITTEN`` of such a page is kept; what is below it is written anew. A test compares.
"""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import click
from click.testing import CliRunner

import kf_calib
from kf_calib.cli import cli

WRITTEN = "<!-- What follows is written by tools/reference_pages.py. -->"
"""The line of a page below which it is written."""

_DOCS = Path(__file__).parent.parent / "docs"
_WIDTH = 100  # of a block of text


def pages() -> dict[Path, str]:
    """The texts of all these pages."""
    written = {"effects.md": _of_effects, "command_line.md": _of_commands, "api.md": _of_python}
    return {_DOCS / name: _whole(_DOCS / name, lines()) for name, lines in written.items()}


def _whole(path: Path, lines: Iterator[str]) -> str:
    kept = path.read_text().partition(WRITTEN)[0].rstrip()
    text = "\n".join([kept, "", WRITTEN, *lines])
    return re.sub(r"\n{3,}", "\n\n", text).rstrip() + "\n"


def _said(*words: str) -> str:
    """What a command prints."""
    runner = CliRunner(env={"COLUMNS": str(_WIDTH), "TERMINAL_WIDTH": str(_WIDTH), "NO_COLOR": "1"})
    return runner.invoke(cli, words, prog_name="kf-calib", catch_exceptions=False).stdout


# Effects, from what ``kf-calib effects --json`` and ``simulate --hide help`` say


def _of_effects() -> Iterator[str]:
    """An overview of all effects, then each with its formula, coefficients, source and rivals."""
    every = [list(of_name) for _, of_name in groupby(json.loads(_said("effects", "--json"))["effects"], key=_name)]
    yield from (*_overview(every), *_details(every), *_typical_sizes())


def _typical_sizes() -> Iterator[str]:
    yield from ("", "## Sizes to hide", "")
    yield "What `simulate --hide EFFECT=SIZE` can hide, and how large it is in sensors of navigation grade and, below"
    said = _said("simulate", "--hide", "help").rstrip().splitlines()
    wrapped = [part for line in said for part in (textwrap.wrap(line, _WIDTH) if len(line) > _WIDTH else [line])]
    yield from ("that, in MEMS sensors:", "", "```text", *wrapped, "```")


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
        yield from ("```text", *textwrap.wrap(first["formula"], _WIDTH), "```", "")
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


# Commands, from their help


def _of_commands() -> Iterator[str]:
    context = click.Context(cli)
    yield from ("", "## kf-calib", "", "```text", *_help(), "```")
    for name in cli.list_commands(context):
        yield from ("", f"## {name}", "", "```text", *_help(name), "```")


def _help(*words: str) -> Iterator[str]:
    option = "--help-all" if words and "--help-all" in _said(*words, "--help") else "--help"
    yield from (line.rstrip() for line in _said(*words, option).strip("\n").splitlines())


# Python, from signatures and docstrings

_KINDS = ("Functions", "Classes", "Exceptions", "Modules")
_LITERAL = re.compile(r"(``.*?``)", re.DOTALL)
_MARKUP = re.compile(r"(?<=\w)_(?=\W|$)|[\\*|`<>$#]")


def _of_python() -> Iterator[str]:
    for kind in _KINDS:
        names = sorted((name for name in kf_calib.__all__ if _kind(name) == kind), key=str.lower)
        yield from ("", f"## {kind}")
        for name in names:
            yield from ("", f"### {name}", *_described(f"kf_calib.{name}", getattr(kf_calib, name)))
            if kind == "Classes":
                yield from _members(getattr(kf_calib, name))


def _kind(name: str) -> str:
    value = getattr(kf_calib, name)
    if inspect.isclass(value):
        return "Exceptions" if issubclass(value, Exception) else "Classes"
    return "Modules" if inspect.ismodule(value) else "Functions"


def _described(name: str, value: Any) -> Iterator[str]:
    """The signature of a function or class, and its docstring."""
    if callable(value) and not (inspect.isclass(value) and issubclass(value, Exception)):
        yield from ("", "```python", *_signature(name, value), "```")
    yield from ("", *_docstring(value))


def _signature(name: str, value: Any) -> list[str]:
    """How it is called, in as many lines as it needs."""
    try:
        told = inspect.signature(value)
    except ValueError:  # of a class of another language
        return [name]
    parameters = [p for p in told.parameters.values() if p.name != "self"]
    words = [_parameter(each) for each in parameters]
    kinds = [each.kind for each in parameters]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        words.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    is_given = told.return_annotation is not told.empty and not inspect.isclass(value)
    result = f" -> {told.return_annotation}".replace("'", "") if is_given else ""
    line = f"{name}({', '.join(words)}){result}"
    return [line] if len(line) <= _WIDTH else [f"{name}(", *(f"    {each}," for each in words), f"){result}"]


def _parameter(parameter: inspect.Parameter) -> str:
    """A parameter with its type, where that is a few words, and its default, where that is a value."""
    kind, default = parameter.annotation, repr(parameter.default)
    words = parameter.name + (f": {kind}" if isinstance(kind, str) else "")
    if parameter.default is parameter.empty:
        return words
    return f"{words} = {default if len(words + default) < _WIDTH - 10 and ' at 0x' not in default else '...'}"


def _docstring(value: Any) -> list[str]:
    return _as_markdown(inspect.getdoc(value) or "").splitlines()


def _as_markdown(text: str) -> str:
    """The text of a docstring, in which only ``code`` is markup."""
    parts = _LITERAL.split(text)
    return "".join(part[1:-1] if k % 2 else _MARKUP.sub(r"\\\g<0>", part) for k, part in enumerate(parts))


def _members(kind: type) -> Iterator[str]:
    """Methods and properties of a class, in the order in which they are written, each with its docstring."""
    rows = list[str]()
    for name, member in vars(kind).items():
        if name.startswith("_") or not (inspect.isfunction(member) or _is_told(member)):
            continue
        function = getattr(member, "__func__", member)
        call = "()" if inspect.isfunction(function) else ""
        first = " ".join((inspect.getdoc(member) or "").partition("\n\n")[0].split())
        if first:
            told = f"- `{name}{call}`: {_as_markdown(first)}"
            rows += textwrap.wrap(told, 118, subsequent_indent="  ", break_on_hyphens=False)
    yield from (["", *rows] if rows else [])


def _is_told(member: Any) -> bool:
    return isinstance(member, (property, classmethod, staticmethod)) or type(member).__name__ == "cached_property"


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; end with 1 where a page is not as it would be.")
def main(check: bool) -> None:
    """Write the pages of reference."""
    stale = {path: text for path, text in pages().items() if path.read_text() != text}
    for path, text in stale.items():
        if not check:
            path.write_text(text)
        click.echo(f"{path.name} {'is not' if check else 'was not'} as the program says")
    raise SystemExit(1 if check and stale else 0)


if __name__ == "__main__":
    main()
