"""The heading of a text: comments and titles, what is between cells, the names of the columns, perhaps their units."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from kf_calib.sources.text.labels import Labels
from kf_calib.sources.text.names import NAMELESS, face_of, is_unit

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


class TextHeading(NamedTuple):
    """The names of the columns, what is between cells, how many lines go before the first row, and the first rows.

    lines_of_names: numbers, from 0, of the line with the names and, where there is one, of that with units. labels:
    where each value has its name before it. numbers: of the lines of the rows, from 0.
    """

    header: Sequence[str]
    delimiter: str
    lines: int
    rows: Sequence[Sequence[str]]
    lines_of_names: tuple[int, ...] = ()
    labels: Labels | None = None
    numbers: Sequence[int] = ()

    @classmethod
    def of(cls, lines: Sequence[str], *, is_whole: bool = False) -> TextHeading:
        """The heading of lines from the beginning of a file or a stream, of which there is at least one.

        is_whole: whether these are all; rows are then all as well, and a cell may go over several lines. Raises
        csv.Error for such a cell without an end.
        """
        if labels := Labels.of(lines):
            return cls._of_labelled(lines if is_whole else lines[: 2 * _ROWS], labels, is_whole)
        delimiter, start = delimiter_in(lines[:_ROWS])
        if is_whole:
            reader = csv.reader(lines[start:], delimiter=delimiter, skipinitialspace=True)
            cells = [(start + reader.line_num - 1, [cell.strip() for cell in row]) for row in reader]
            return cls.of_cells(cells, delimiter)
        first = enumerate(lines[start : start + 2 * _ROWS], start)
        heading = cls.of_cells([(k, cells_of(line.lstrip("\ufeff"), delimiter)) for k, line in first], delimiter)
        return heading._replace(rows=heading.rows[:_ROWS])

    @classmethod
    def of_cells(cls, cells: Sequence[tuple[int, list[str]]], delimiter: str) -> TextHeading:
        """The heading of cells with the number of the line of each."""
        filled = [own for own in cells if any(own[1])]
        header, begin, named = header_in([own for _, own in filled]) if filled else ([], 0, ())
        rows = [(k, without_empty_end(own, len(header))) for k, own in filled[begin:] if not is_comment(own)]
        behind = filled[begin][0] if begin < len(filled) else cells[-1][0] + 1 if cells else 0
        names = tuple(filled[k][0] for k in named)
        return cls(header, delimiter, behind, [own for _, own in rows], names, numbers=[k for k, _ in rows])

    @classmethod
    def _of_labelled(cls, lines: Sequence[str], labels: Labels, is_whole: bool) -> TextHeading:
        """Return the heading of lines with labels; of all lines, with the face that a line before them names where all
        have one."""
        rows, face = list[tuple[int, list[str]]](), ""
        for number, line in enumerate(lines):
            if values := labels.values(line):
                rows.append((number, [face, *values]))
            elif face_of(line.strip().rstrip(": ")):
                face = line.strip().rstrip(": ")
        has_faces = is_whole and all(cells[0] for _, cells in rows)
        header = ["face"] * has_faces + labels.header
        cells = [own[not has_faces :] for _, own in rows]
        return cls(header, ",", rows[0][0], cells, labels=labels, numbers=[number for number, _ in rows])

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
        widths = [len(cells_of(line, delimiter)) for line in lines[:_TELLING]]
        return max((widths.count(width) for width in set(widths) - {0, 1}), default=0)

    best = max(_DELIMITERS, key=fitness)
    return best if fitness(best) or fitness(BLANK) < 2 else BLANK


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
    if '"' not in line:
        return line.split() if delimiter == BLANK else [cell.strip() for cell in line.split(delimiter)]
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
