"""Texts of a calibration file in the formats of other programs: nothing in them is ever more than text there.

Every text that an export takes from a file goes through one of these, as a file may come from anybody.
"""

from __future__ import annotations

import re
import unicodedata

_LONGEST = 120


def in_comment(text: str) -> str:
    """The text without what could end a comment, or mean anything, in C, YAML or a list of parameters."""
    return re.sub(r"[^\w.+:-]+", "_", text)[:_LONGEST]


def in_cell(text: str) -> str:
    """The text as a cell of a table that no spreadsheet takes for a formula: with an apostrophe before = + - @."""
    begin = unicodedata.normalize("NFKC", text).lstrip()[:1]  # a wide equals sign begins a formula, too
    return f"'{text}" if begin and begin in "=+-@" else text
