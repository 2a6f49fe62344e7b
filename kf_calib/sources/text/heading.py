"""The heading of a text: comments and titles, what is between cells, the names of the columns, perhaps their units.

In lines as on a serial port each value has its name before it: ``aX: -0.06, aY: 0.00, aZ: 8.44``.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

from kf_calib.sources.text.cells import are_stamps
from kf_calib.sources.text.names import READINGS, face_of, is_unit, meaning_of, meanings_of, nameless

T = TypeVar("T")

_DELIMITERS = ";\t,|"
BLANK = " "
"""Between cells where no other delimiter is: any run of blanks."""
_TELLING = 200  # lines by which the delimiter is told
_FEWEST_CELLS = 3
"""Of a header; a line of fewer is a title, a date or a serial number."""
_ROWS = 1000  # that are looked at
_TITLES, _RUN = 30, 50  # rows among which the names are, and rows of values that are no list above them
_MARK = re.compile(r"\s*(?:#|%|;|//)+\s*")
"""Before a comment, or before names."""
_NUMBER = re.compile(r"[+\-−]?[\d.,]*\d[\d.,]*(?:[eE][+\-]?\d+)?|[+\-]?nan", re.IGNORECASE)
_BLANK_CELL = re.compile(r'"[^"]*"|\S+')
_IN_TEXT = re.compile(
    r"(?<![\w.*])(?:\d{1,4}[./-]\d\d?[./-]\d{1,4}[T ])?(?:\d\d?:\d\d:\d\d(?:[.,]\d+)?"
    r"|[+\-−]?(?:\d+\.?\d*|\.\d+)(?:[eE][+\-]?\d+)?)(?![\d.xX])"
)
"""A number or a stamp amid other text; what follows an asterisk is a sum of a check."""
_LABEL = re.compile(r"([^\W\d][^:=,;|\t\"{}]{0,40}?)\s*[:=]\s*[(\[]?\s*$")
_UNIT_BEHIND = re.compile(r"\s*([^\s\d:=,;|][^\s:=,;|]*)(?=[\s,;|]|$)(?!\s*[:=])")
_FEWEST_LABELS, _LONGEST_LABELLED, _LONGEST_LABEL = 3, 1000, 60
_JSON, _QUOTES = "{", "\"'"
_JSON_TOKEN = re.compile(r"""(["'])((?:(?!\1)[^\\]|\\.)*)\1(\s*:)?|[{}\[\],]|[^\s{}()\[\],:"']+""")
"""A text, as Python prints it perhaps in single quotes, a mark, or a number."""
_QUANTITY = re.compile(rf"(?:{_NUMBER.pattern})\s*([^\d\s.,].*)", re.IGNORECASE)
_RATE = re.compile(r"(?:rate|sampl\w*|(?<!pass )\bat)\b[^\d\n]{0,30}?(\d+(?:[.,]\d+)?)\s*Hz\b", re.IGNORECASE)


class TextHeading(NamedTuple):
    """The names of the columns, what is between cells, how many lines go before the first row, and the first rows.

    lines_of_names: numbers, from 0, of the line with the names and, where there is one, of that with units. labels:
    the names in each line that has readings, where each value has its name before it. numbers: of the lines of the
    rows, from 0. suffixes: the unit that each cell of a column has behind its number. above: what stands above the
    names.
    """

    header: Sequence[str]
    delimiter: str
    lines: int
    rows: Sequence[Sequence[str]]
    lines_of_names: tuple[int, ...] = ()
    labels: Sequence[str] = ()
    numbers: Sequence[int] = ()
    suffixes: Sequence[str] = ()
    above: Sequence[str] = ()

    @classmethod
    def of(cls, lines: Sequence[str], *, is_whole: bool = False) -> TextHeading:
        """The heading of lines from the beginning of a file or a stream, of which there is at least one.

        is_whole: whether these are all; rows are then all as well, and a cell may go over several lines. Raises
        csv.Error for such a cell without an end.
        """
        lines = lines if is_whole else lines[: 2 * _ROWS]
        if labelled := _first_labelled(lines[:_ROWS]):
            return cls._of_labelled(lines, *labelled, is_whole)
        delimiter, start = _delimiter_in(lines[:_ROWS])
        if is_whole:
            reader = csv.reader(lines[start:], delimiter=delimiter, skipinitialspace=True)
            cells = [(start + reader.line_num - 1, [cell.strip() for cell in row]) for row in reader]
        else:
            cells = [(k, cells_of(lines[k].lstrip("\ufeff"), delimiter)) for k in range(start, len(lines))]
        heading = cls.of_cells(cells, delimiter)
        if count := _numbers_amid(lines[:_ROWS], heading):
            return cls._of_labelled(lines, [""] * count, nameless(count), is_whole)
        heading = heading._replace(above=lines[: heading.lines])
        return heading if is_whole else heading._replace(rows=heading.rows[:_ROWS])

    @classmethod
    def of_json(cls, lines: Sequence[str]) -> TextHeading | None:
        """The heading of lines with an object each, of which the scalars are the cells; None where these are too few
        for three readings."""
        found = [{path: line[start:end] for path, start, end in scalars(line)} for line in lines[:_ROWS]]
        header = list(dict.fromkeys(path for cells in found for path in cells if path))
        rows = [[cells.get(path, "").strip(_QUOTES) for path in header] for cells in found]
        if len(header) < _FEWEST_CELLS:
            return None
        return cls(header, _JSON, 0, rows, labels=header, numbers=range(len(rows)))

    @classmethod
    def of_cells(cls, cells: Sequence[tuple[int, list[str]]], delimiter: str) -> TextHeading:
        """The heading of cells with the number of the line of each."""
        filled = [own for own in cells if any(own[1])]
        header, begin, named = _header_in([own for _, own in filled]) if filled else ([], 0, ())
        widest = max((len(own) for _, own in filled[begin:]), default=0)
        header = header[:widest] if widest >= _FEWEST_CELLS else header
        rows = [(k, without_empty_end(own, len(header))) for k, own in filled[begin:] if not _is_comment(own)]
        behind = filled[begin][0] if begin < len(filled) else cells[-1][0] + 1 if cells else 0
        names = tuple(filled[k][0] for k in named)
        suffixes = _suffixes_in([own for _, own in rows], len(header))
        values = [own for _, own in rows]
        if suffixes:
            named = zip(header, suffixes, strict=True)
            header = [f"{name} [{unit}]" if unit and not meaning_of(name).unit else name for name, unit in named]
            values = [_without(own, suffixes) for own in values]
        return cls(header, delimiter, behind, values, names, numbers=[k for k, _ in rows], suffixes=suffixes)

    @classmethod
    def _of_labelled(cls, lines: Sequence[str], labels: list[str], header: list[str], is_whole: bool) -> TextHeading:
        """Return the heading of lines with labels; of all lines, with the face that a line before them names where all
        have one."""
        rows, faces, numbers, face = list[list[str]](), list[str](), list[int](), ""
        for number, line in enumerate(lines):
            if spans := _labelled_spans(line, labels):
                rows.append([line[start:end] for start, end in spans])
                faces.append(face)
                numbers.append(number)
            elif face_of(line.strip().rstrip(": ")):
                face = line.strip().rstrip(": ")
        if is_whole and all(faces):
            rows, header = [[face, *cells] for face, cells in zip(faces, rows, strict=True)], ["face", *header]
        return cls(header, ",", numbers[0], rows, labels=labels, numbers=numbers)

    @property
    def rate_hz(self) -> float | None:
        """The rate of the rows that the lines above the names state; None where none does, or several."""
        rates = {match[1].replace(",", ".") for line in self.above for match in _RATE.finditer(line)}
        return float(rates.pop()) if len(rates) == 1 else None

    @property
    def has_objects(self) -> bool:
        """Whether each line below is an object of JSON."""
        return self.delimiter == _JSON

    def cells(self, line: str) -> list[str]:
        """The cells of a line below; none where it has other labels than those of readings."""
        if self.labels:
            return [line[start:end].strip(_QUOTES) for start, end in self.spans(line)]
        return _without(cells_of(line, self.delimiter), self.suffixes)

    def spans(self, line: str) -> list[tuple[int, int]]:
        """Where the cells of a line stand, with their quotes and without blanks around them, those of columns that it
        does not have at its beginning; the mark of a comment in a cell of its own is none."""
        if self.has_objects:
            places = {path: (start, end) for path, start, end in scalars(line)}
            return [places.get(path, (0, 0)) for path in self.labels] if places else []
        if self.labels:
            lacking = len(self.header) - len(self.labels)  # of a face that stands in a line of its own
            return [(0, 0)] * lacking + _labelled_spans(line, self.labels)
        if self.delimiter == BLANK:
            spans = [match.span() for match in _BLANK_CELL.finditer(line)]
            is_mark = bool(spans) and not line[slice(*spans[0])].strip("#%/")
            return spans[1:] if is_mark and _MARK.match(line) else spans
        mark = re.escape(self.delimiter)  # which a quoted cell may hold; a quote left open ends with the line
        cell = rf'(?:^|{mark})((?:"(?:[^"]|"")*+"?)?[^{mark}]*)'
        cells = [(match[1], *match.span(1)) for match in re.finditer(cell, line)]
        spans = [
            (start + len(cell) - len(cell.lstrip()), end - len(cell) + len(cell.rstrip())) for cell, start, end in cells
        ]
        return [_number_in(line, *own) for own in _beside(spans, self.suffixes)] if self.suffixes else spans


def scalars(line: str) -> list[tuple[str, int, int]]:
    """The path of each scalar in an object of JSON, as ``acc.x``, and where it stands; null is none. Of an object that
    does not end there are none: the last number may lack digits."""
    keys, places = list[str | int](), list[tuple[str, int, int]]()
    for match in _JSON_TOKEN.finditer(line):
        if match[3] and keys:
            keys[-1] = match[2]
        elif match[0] in ("{", "["):
            keys.append("" if match[0] == "{" else 0)
        elif match[0] in ("}", "]"):
            del keys[-1:]
        elif match[0] == ",":
            keys[-1:] = [key + 1 if isinstance(key, int) else key for key in keys[-1:]]
        elif match[0] not in ("null", "None"):
            places.append((".".join(map(str, keys)), *match.span()))
    return [] if keys else places


def _first_labelled(lines: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the labels in the first of lines that name an accelerometer, and with their units the names of the columns
    that they make; None where none do."""
    seen = list[list[str]]()
    for line in lines:
        labels, units, _ = _labelled_in(line) if ":" in line or "=" in line else ([], [], [])
        if sum(map(bool, labels)) < _FEWEST_LABELS or labels in seen:
            continue
        seen.append(labels)
        named = [(label or name, unit or units[-1] if label else "")
                 for label, name, unit in zip(labels, nameless(len(labels)), units, strict=True)]  # fmt: skip
        header = [f"{name} [{unit}]" if unit else name for name, unit in named]
        if _tell_readings(header):
            return labels, header
    return None


def _labelled_spans(line: str, labels: Sequence[str]) -> list[tuple[int, int]]:
    """Return where the values stand in a line; none where it has other labels."""
    found, _, spans = _labelled_in(line)
    return spans if found == labels else []


def _labelled_in(line: str) -> tuple[list[str], list[str], list[tuple[int, int]]]:
    """Return the labels and units of all numbers and stamps in a line, empty where there are none, and where they
    stand; a label before three numbers is that of a vector."""
    spans = [match.span() for match in _IN_TEXT.finditer(line)] if len(line) < _LONGEST_LABELLED else []
    labels, units, end = list[str](), list[str](), 0
    for (start, behind), (after, _) in itertools.pairwise([*spans, (len(line), 0)]):
        label = _LABEL.search(line[max(end, start - _LONGEST_LABEL) : start])
        unit = _UNIT_BEHIND.match(line, behind, after)
        labels.append(label[1] if label else "")
        units.append(unit[1] if unit and is_unit(unit[1]) else "")
        end = unit.end() if unit and units[-1] else behind
    for k, label in enumerate(labels):
        if label and labels[k + 1 : k + 3] == ["", ""] and all(labels[k + 3 : k + 4]):
            labels[k : k + 3] = [f"{label} {axis}" for axis in "xyz"]
    return labels, units, spans


def _numbers_amid(lines: Sequence[str], heading: TextHeading) -> int:
    """Return how many numbers most lines of a print have, amid other text and without labels; 0 where cells are told
    better by a delimiter."""
    rows = heading.rows[:_TELLING]
    if _tell_readings(heading.header) or 2 * sum(any(map(_is_amid, row)) for row in rows) <= len(rows):
        return 0
    counts = [len(labels) for line in lines if not any(labels := _labelled_in(line)[0])]
    counts = [count for count in counts if count >= _FEWEST_CELLS]
    return max(set(counts), key=counts.count) if 2 * len(counts) > len(lines) else 0


def _is_amid(cell: str) -> bool:
    """Return whether a number stands amid other text in a cell."""
    return not _NUMBER.fullmatch(cell) and _IN_TEXT.search(cell) is not None and not are_stamps([cell])


def _delimiter_in(lines: Sequence[str]) -> tuple[str, int]:
    """Return what is between the cells of lines, and how many lines state it (``sep=;``: one): the delimiter with which
    the most of them have the same number of cells, two or more."""
    first = lines[0].lstrip("\ufeff").strip() if lines else ""
    if first.lower().startswith("sep=") and len(first) == 5:
        return first[-1], 1
    filled = [line for line in lines if line.strip()]
    told = [line for line in filled if not _MARK.match(line)] or filled

    def fitness(delimiter: str) -> int:
        widths = [len(cells_of(line, delimiter)) for line in told[:_TELLING]]
        return max((widths.count(width) for width in set(widths) - {0, 1}), default=0)

    best = max(_DELIMITERS, key=fitness)
    return best if fitness(best) or fitness(BLANK) < 2 else BLANK, 0


def _header_in(rows: Sequence[Sequence[str]]) -> tuple[list[str], int, tuple[int, ...]]:
    """Return the names of the columns, the place of the first row of values, and those of names and units.

    rows: cells of lines that have any. Comments and titles are passed over. The names are the first line of three cells
    or more that tell three readings, or else the first such line that is not followed by another one above all values,
    or, where that holds numbers, the comment before it that has as many; where there is none, columns have numbers.
    """
    wide = [k for k, row in enumerate(rows) if sum(map(bool, row)) >= _FEWEST_CELLS and not _is_comment(row)]
    if not wide:  # whatever it is, it is told by its first line
        return _names(rows[0]), 1, (0,)
    named = (k for k in wide[:_TITLES] if _tell_readings(_names(rows[k])))
    at = next(itertools.chain(named, _above_values(rows, wide), wide))
    first = _names(rows[at])
    if _are_values(first):
        above = _names(rows[at - 1]) if at and _is_comment(rows[at - 1]) else [""]
        name = _MARK.sub("", above[0], count=1)
        names = [name] * bool(name) + above[1:]  # the mark, or a word for the names, may stand in a cell of its own
        names = names[1:] if len(names) == len(first) + 1 else names
        if len(names) != len(first) or _are_values(names):
            return nameless(len(first)), at, ()
        return names, at, (at - 1,)
    units = _names(rows[at + 1]) if at + 1 < len(rows) else []
    if any(is_unit(text) and text.strip("-1") for text in units) and not any(map(_NUMBER.fullmatch, units)):
        padded = zip(first, [*units, *[""] * len(first)], strict=False)
        named = [f"{name} [{unit[1:-1] if unit[0] in '[(' else unit}]" if unit else name for name, unit in padded]
        return named, at + 2, (at, at + 1)
    return first, at + 1, (at,)


def _tell_readings(names: Sequence[str]) -> bool:
    """Return whether names are those of columns with three readings."""
    return not _are_values(names) and {own.ours for own in meanings_of(names, {})} >= set(READINGS)


def _above_values(rows: Sequence[Sequence[str]], wide: Sequence[int]) -> Iterator[int]:
    """Yield which of the wide rows are the last before a long run of values."""
    are_values = [_are_values(rows[k]) for k in wide]
    for k in range(1, len(wide) - _RUN):
        if not are_values[k - 1] and all(are_values[k : k + _RUN]):
            yield wide[k - 1]


def _are_values(cells: Sequence[str]) -> bool:
    """Return whether cells are the values of a row and no names: most are numbers. Those that count from 0 or 1 on are
    names, as libraries give them to columns without any."""
    filled = [cell for cell in cells if cell]
    numbers = [cell for cell in filled if _NUMBER.fullmatch(cell)]
    are_counted = any(numbers == [str(k + first) for k in range(len(numbers))] for first in (0, 1))
    return 2 * len(numbers) > len(filled) and not are_counted


def _names(row: Sequence[str]) -> list[str]:
    """Return the names in a row without the empty cells at its end, as of a delimiter at the end of the line."""
    last = max((k for k, text in enumerate(row) if text), default=-1)
    return list(row[: last + 1])


def _is_comment(row: Sequence[str]) -> bool:
    """Return whether the cells of a line begin with the mark of a comment."""
    return bool(row) and _MARK.match(row[0]) is not None


def without_empty_end(row: list[str], count: int) -> list[str]:
    """A row without empty cells beyond so many, as of a delimiter at the end of the line."""
    return row[:count] if len(row) > count and not any(cell.strip() for cell in row[count:]) else row


def _suffixes_in(rows: Sequence[Sequence[str]], count: int) -> list[str]:
    """Return the unit that stands behind the number in each cell of a column, for so many columns; "" where there is
    none, or not one alone, and nothing at all where no column has one."""
    found = [set[str]() for _ in range(count)]
    for row in rows[:_TELLING]:
        for units, cell in zip(found, row, strict=False):
            match = _QUANTITY.fullmatch(cell) if cell else None
            units |= {match[1] if match and match[1] != "-" and is_unit(match[1]) else ""} if cell else set()
    units_of = [units.pop() if len(units) == 1 else "" for units in found]
    return units_of if any(units_of) else []


def _without(cells: list[str], suffixes: Sequence[str]) -> list[str]:
    """Return the cells of a row without the units behind their numbers."""
    return [cell.removesuffix(unit).rstrip() for cell, unit in _beside(cells, suffixes)] if suffixes else cells


def _beside(cells: Sequence[T], suffixes: Sequence[str]) -> Iterator[tuple[T, str]]:
    """Yield what stands for each cell of a row with the unit of its column; a row may have more cells than columns."""
    return zip(cells, itertools.chain(suffixes, itertools.repeat("")), strict=False)


def _number_in(line: str, span: tuple[int, int], unit: str) -> tuple[int, int]:
    """Return where the number stands in a cell that has this unit behind it."""
    start, end = span
    number, behind, _ = line[start:end].rpartition(unit) if unit else ("", "", "")
    return (start + number.startswith('"'), start + len(number.rstrip())) if behind else span


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line without blanks and quotes around them; a quote left open ends with the line."""
    if '"' not in line:
        cells = line.split(None if delimiter == BLANK else delimiter)
        return [cell.strip() for cell in cells] if " " in line else cells
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=delimiter == BLANK), [])
    except csv.Error:  # a cell beyond csv's own limit
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def with_texts(line: str, spans: Sequence[tuple[int, int]], texts: Mapping[int, str]) -> str:
    """A line with other texts in cells, by where these stand, and all else in it as it is."""
    for at in sorted(texts, reverse=True):
        start, end = spans[at]
        line = line[:start] + texts[at] + line[end:]
    return line
