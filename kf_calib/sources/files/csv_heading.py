"""The lines at the beginning of a CSV file: comments and titles, the names of the columns, perhaps their units."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from typing import NamedTuple

from kf_calib.sources.tables.grid import delimiter_of
from kf_calib.sources.tables.words import is_unit

_FEWEST_CELLS = 3
"""Of a header; a line of fewer is a title, a date or a serial number."""
_ROWS = 1000  # that are looked at


class CsvHeading(NamedTuple):
    """The names of the columns, what is between cells, how many lines go before the first row, and the first rows."""

    header: Sequence[str]
    delimiter: str
    lines: int
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(cls, lines: Sequence[str]) -> CsvHeading:
        """The heading of lines from the beginning of a file or a stream, of which there is at least one."""
        first = lines[0].lstrip("\ufeff").strip()
        stated = first[-1] if first.lower().startswith("sep=") and len(first) == 5 else ""
        plain = [line for line in lines[bool(stated) : _ROWS] if line.strip() and not line.startswith("#")]
        delimiter = stated or delimiter_of(plain)
        at = next((k for k, line in enumerate(lines) if _is_header(line, delimiter)), None)
        if at is None:  # whatever it is, it is told by its first line
            at = next((k for k, line in enumerate(lines) if line.strip()), 0)
        header = cells_of(lines[at].lstrip("\ufeff"), delimiter)
        rows = [cells_of(line, delimiter) for line in lines[at + 1 : at + 1 + _ROWS]]
        if rows and _are_units(rows[0]):
            units, at = [*rows.pop(0), *[""] * len(header)], at + 1
            header = [f"{name} [{unit}]" if unit else name for name, unit in zip(header, units, strict=False)]
        while header and not header[-1]:  # a delimiter at the end of the line
            header.pop()
        return cls(header, delimiter, at + 1, [without_empty_end(row, len(header)) for row in rows])


def _is_header(line: str, delimiter: str) -> bool:
    text = line.lstrip("\ufeff").strip()
    if not text or text.startswith("#"):
        return False
    return sum(bool(cell) for cell in cells_of(text, delimiter)) >= _FEWEST_CELLS


def _are_units(cells: Sequence[str]) -> bool:
    has_letters = any(character.isalpha() for cell in cells for character in cell)
    return has_letters and all(not cell or is_unit(cell) for cell in cells)


def without_empty_end(row: list[str], count: int) -> list[str]:
    """A row without empty cells beyond so many, as of a delimiter at the end of the line."""
    return row[:count] if len(row) > count and not any(cell.strip() for cell in row[count:]) else row


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line without blanks and quotes around them; a quote left open ends with the line."""
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:  # a cell beyond csv's own limit
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]
