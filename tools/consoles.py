"""The console blocks of a page: every command, and what the page shows of its output."""

from __future__ import annotations

import re

GAP = "\n...\n"
"""Stands for lines that a page leaves out."""


def consoles(text: str) -> list[tuple[str, str]]:
    """Every command, and what is shown below it; a backslash goes on in the next line."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    parts = [part for block in blocks for part in re.split(r"^\$ ", block.replace("\\\n", " "), flags=re.MULTILINE)[1:]]
    return [(command, shown) for command, _, shown in (part.partition("\n") for part in parts)]


def not_printed(shown: str, printed: str) -> str:
    """The first part of what a page shows that was not printed in its place; empty where all was.

    Lines are broken differently on a page, so words are compared.
    """
    printed, place = _words(printed), 0
    for part in map(_words, f"\n{shown}\n".split(GAP)):
        if (found := printed.find(part, place)) < 0:
            return part
        place = found + len(part)
    return ""


def _words(text: str) -> str:
    return " ".join(text.split())
