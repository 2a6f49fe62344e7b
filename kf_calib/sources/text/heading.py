"""The heading of a text: comments and titles, what is between cells, the names of the columns, perhaps their units."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from kf_calib.sources.text.labels import Labels
from kf_calib.sources.text.names import is_unit

_DELIMITERS = ";\t,|"
BLANK = " "
"""Between cells where no other delimiter is: any run of blanks."""
_TELLING = 200  # lines by which the delimiter is told
_FEWEST_CELLS = 3
"""Of a header; a line of fewer is a title, a date or a serial number."""
_ROWS = 1000  # that are looked at
_MARK = re.compile(r"\s*(?:#|%|//)+\s*")
"""Before a comment, or before names."""
_NUMBER = re.compile(r"[+\-−]?[\d.,]*\d[\d.,]*(?:[eE][+\-]?\d+)?|[+\-]?nan", re.IGNORECASE)
NAMELESS = "column {}"
"""The name of a column of a text without a heading, counted from 1."""


class TextHeading(NamedTuple):
    """The names of the columns, what is between cells, how many lines go before the first row, and the first rows.

    lines_of_names: numbers, from 0, of the line with the names and, where there is one, of that with units. labels:
    where each value has its name before it.
    """

    header: Sequence[str]
    delimiter: str
    lines: int
    rows: Sequence[Sequence[str]]
    lines_of_names: tuple[int, ...] = ()
    labels: Labels | None = None

    @classmethod
    def of(cls, lines: Sequence[str]) -> TextHeading:
        """The heading of lines from the beginning of a file or a stream, of which there is at least one."""
        if labels := Labels.of(lines[:_ROWS]):
            values = [(k, own) for k, line in enumerate(lines[: 2 * _ROWS]) if (own := labels.values(line))]
            return cls(labels.header, ",", values[0][0], [own for _, own in values], labels=labels)
        delimiter, start = delimiter_in(lines[:_ROWS])
        cells = [cells_of(line.lstrip("\ufeff"), delimiter) for line in lines[start : start + 2 * _ROWS]]
        header, begin, named = header_in(cells)
        rows = [without_empty_end(row, len(header)) for row in cells[begin : begin + _ROWS]]
        return cls(header, delimiter, start + begin, rows, tuple(start + k for k in named))

    def spans(self, line: str) -> list[tuple[int, int]]:
        """Where the cells of a line stand, those of columns that it does not have at its beginning."""
        if self.labels is None:
            return cell_spans(line, self.delimiter)
        lacking = len(self.header) - len(self.labels.names)  # of a face that stands in a line of its own
        return [(0, 0)] * lacking + self.labels.spans(line)


def delimiter_in(lines: Sequence[str]) -> tuple[str, int]:
    """What is between the cells of lines, and how many lines state it (``sep=;``: one)."""
    first = lines[0].lstrip("\ufeff").strip() if lines else ""
    if first.lower().startswith("sep=") and len(first) == 5:
        return first[-1], 1
    plain = [line for line in lines if line.strip()]
    return _delimiter_of([line for line in plain if not _MARK.match(line)] or plain), 0


def _delimiter_of(lines: Sequence[str]) -> str:
    """Return the delimiter with which the most of some lines have the same number of cells, two or more."""

    def fitness(delimiter: str) -> int:
        rows = csv.reader(lines[:_TELLING], delimiter=delimiter, skipinitialspace=delimiter == BLANK)
        widths = [len(row) for row in rows if len(row) > 1]
        return max(map(widths.count, set(widths)), default=0)

    try:
        best = max(_DELIMITERS, key=fitness)
        return best if fitness(best) or fitness(BLANK) < 2 else BLANK
    except csv.Error:
        return ","


def header_in(rows: Sequence[Sequence[str]]) -> tuple[list[str], int, tuple[int, ...]]:
    """The names of the columns, the place of the first row of values, and those of names and units.

    rows: cells of lines. Comments and titles are passed over. The names are the first line of three cells or more, or,
    where that holds numbers, the comment before it that has as many; where there is none, columns have numbers.
    """
    at = next((k for k, row in enumerate(rows) if _filled(row) >= _FEWEST_CELLS and not is_comment(row)), None)
    if at is None:  # whatever it is, it is told by its first line
        at = next((k for k, row in enumerate(rows) if _filled(row)), 0)
        return _names(rows[at]), at + 1, (at,)
    first = _names(rows[at])
    if are_values(first):
        above = next((k for k in range(at - 1, -1, -1) if _filled(rows[k])), None)
        names = _uncommented(rows[above]) if above is not None and is_comment(rows[above]) else []
        if above is None or len(names) != len(first) or are_values(names):
            return [NAMELESS.format(k + 1) for k in range(len(first))], at, ()
        return names, at, (above,)
    if at + 1 < len(rows) and _are_units(rows[at + 1]):
        units = [*rows[at + 1], *[""] * len(first)]
        named = [f"{name} [{unit}]" if unit else name for name, unit in zip(first, units, strict=False)]
        return named, at + 2, (at, at + 1)
    return first, at + 1, (at,)


def are_values(cells: Sequence[str]) -> bool:
    """Whether cells are the values of a row and no names: most are numbers. Those that count from 0 or 1 on are names,
    as libraries give them to columns without any."""
    filled = [cell for cell in cells if cell]
    numbers = [cell for cell in filled if _NUMBER.fullmatch(cell)]
    are_counted = any(numbers == [str(k + first) for k in range(len(numbers))] for first in (0, 1))
    return 2 * len(numbers) > len(filled) and not are_counted


def _filled(row: Sequence[str]) -> int:
    return sum(map(bool, row))


def _names(row: Sequence[str]) -> list[str]:
    """Return the names in a row without the empty cells at its end, as of a delimiter at the end of the line."""
    texts = list(row)
    while texts and not texts[-1]:
        texts.pop()
    return texts


def is_comment(row: Sequence[str]) -> bool:
    """Whether the cells of a line begin with the mark of a comment."""
    return bool(row) and _MARK.match(row[0]) is not None


def _uncommented(row: Sequence[str]) -> list[str]:
    """Return the names in a comment; its mark may stand in a cell of its own."""
    first, *others = _names(row)
    mark = _MARK.match(first)
    first = first[mark.end() :] if mark else first
    return [first, *others] if first else others


def _are_units(row: Sequence[str]) -> bool:
    texts = _names(row)
    return any(map(str.isalpha, "".join(texts))) and all(not text or is_unit(text) for text in texts)


def without_empty_end(row: list[str], count: int) -> list[str]:
    """A row without empty cells beyond so many, as of a delimiter at the end of the line."""
    return row[:count] if len(row) > count and not any(cell.strip() for cell in row[count:]) else row


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line without blanks and quotes around them; a quote left open ends with the line."""
    if delimiter == BLANK and '"' not in line:
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=delimiter == BLANK), [])
    except csv.Error:  # a cell beyond csv's own limit
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def cell_spans(line: str, delimiter: str) -> list[tuple[int, int]]:
    """Where the cells of a line stand, with their quotes and without blanks around them; the mark of a comment in a
    cell of its own is none."""
    if delimiter == BLANK:
        spans = [match.span() for match in re.finditer(r'"[^"]*"|\S+', line)]
        return spans[1:] if spans and _is_mark(line[slice(*spans[0])]) else spans
    spans, at = list[tuple[int, int]](), 0
    while True:
        end = _quote_end(line, at) if line[at : at + 1] == '"' else at
        end = line.find(delimiter, end)
        end = len(line) if end < 0 else end
        cell = line[at:end]
        spans.append((at + len(cell) - len(cell.lstrip()), end - len(cell) + len(cell.rstrip())))
        if end == len(line):
            return spans
        at = end + 1


def with_texts(line: str, spans: Sequence[tuple[int, int]], texts: Mapping[int, str]) -> str:
    """A line with other texts in cells, by where these stand, and all else in it as it is."""
    for at in sorted(texts, reverse=True):
        start, end = spans[at]
        line = line[:start] + texts[at] + line[end:]
    return line


def _is_mark(cell: str) -> bool:
    return is_comment([cell]) and not cell.strip("#%/")


def _quote_end(line: str, at: int) -> int:
    """The place behind the quote that ends what the one at ``at`` begins; the end of the line where none does."""
    while (at := line.find('"', at + 1)) >= 0:
        if line[at + 1 : at + 2] != '"':
            return at + 1
        at += 1
    return len(line)
