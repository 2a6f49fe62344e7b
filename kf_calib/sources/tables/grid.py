"""The cells of a table as they stand in a CSV file, a sheet of Excel, a structured array or a DataFrame."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from os import PathLike
from pathlib import Path
from typing import Any

from kf_calib.errors import InputError
from kf_calib.sources.containers.opening import kind_of_container
from kf_calib.sources.tables.spreadsheet import sheets_of
from kf_calib.sources.text.encoding import text_of, too_large
from kf_calib.sources.text.heading import delimiter_in, header_in, is_comment
from kf_calib.sources.text.labels import Labels
from kf_calib.sources.text.names import face_of
from kf_calib.sources.text.units import choice_of
from kf_calib.support.text import cut

Cell = str | float | datetime | None
"""A cell as it was read; text is not interpreted yet, an empty cell is None."""
ZIP = b"PK\x03\x04"
TEXT_SUFFIXES = (".csv", ".tsv", ".txt")
EXCEL_SUFFIXES = (".xlsx", ".xlsm")
OLD_SUFFIXES = (".xls", ".ods")
_LARGEST = (50_000_000, 50_000_000)  # bytes, of text and of a spreadsheet, which may hold pictures
_SHOWN = 6  # rows in a message
_LONGEST_CELL = 300  # characters; a longer one is a remark, of which the middle is left out
_MOST_COLUMNS, _MOST_CELLS = 1000, 2_000_000
_FEWEST = 3  # columns


@dataclass(frozen=True)
class Grid:
    """A table: name for messages, header, and rows with the number that each has in the file.

    head: numbers of the row of the header and, where there is one, of the row of units below it. remarks: how the file
    was read, where that was a choice. path: the file, if it is from one.
    """

    name: str
    header: tuple[str, ...]
    numbers: tuple[int, ...]
    rows: tuple[tuple[Cell, ...], ...]
    head: tuple[int, ...] = ()
    is_semicolon: bool = False
    remarks: tuple[str, ...] = ()
    path: Path | None = None

    def column(self, index: int) -> list[Cell]:
        """The cells of one column."""
        return [row[index] for row in self.rows]

    def chosen(self, where: str) -> Grid:
        """The rows that have a text in a column, as ``unit=7``; all for an empty one. Raises InputError for none."""
        if not where:
            return self
        name, value = choice_of(where)
        if name not in self.header:
            raise InputError(f"{self.name}: has no column {cut(name, 60)!r} (--where), it has {self.names}.")
        labels = [_as_text(cell) for cell in self.column(self.header.index(name))]
        kept = [k for k, label in enumerate(labels) if label == value]
        if not kept:
            seen = cut(", ".join(dict.fromkeys(labels)), 100)
            raise InputError(f"{self.name}: no row has {value!r} in column {name!r} (--where), they have {seen}.")
        return replace(self, rows=tuple(self.rows[k] for k in kept), numbers=tuple(self.numbers[k] for k in kept))

    @property
    def names(self) -> str:
        """The names of the columns, quoted."""
        return cut(", ".join(map(repr, self.header)), 300)

    def refuse(self, row: int, column: str, value: Cell, wanted: str) -> InputError:
        """The error that names a cell (row counted from 0), its value, and what would be read."""
        said = "is empty" if value is None else f"is {cut(str(value), 60)!r}"
        return InputError(f"{self.name}: row {self.numbers[row]}, column {column!r} {said}: {wanted}.")


def _as_text(cell: Cell) -> str:
    """Return the text of a cell; a whole number of a spreadsheet without decimals."""
    return f"{cell:g}" if isinstance(cell, float) else str("" if cell is None else cell).strip()


def grid_of(table: Any, dataset: str = "") -> Grid:
    """The cells of a file, a structured array, a DataFrame or a mapping of columns; dataset: of a container."""
    if isinstance(table, str | PathLike):
        path = Path(table)
        try:
            with path.open("rb") as file:
                start = file.read(8)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
        if path.suffix.lower() in OLD_SUFFIXES:
            raise InputError(f"{path}: files of the kind {path.suffix} are not read: save it as .xlsx or .csv.")
        if kind_of_container(path):
            return replace(_of_text(path, dataset), path=path)
        is_excel = start.startswith(ZIP)
        if path.stat().st_size > _LARGEST[is_excel]:
            raise too_large(path)
        return replace(_of_excel(path) if is_excel else _of_text(path), path=path)
    return _of_columns(table)


def _of_text(path: Path, dataset: str = "") -> Grid:
    """Return the cells of a CSV file: any usual encoding and delimiter, with or without lines above the header."""
    lines = text_of(path, _LARGEST[0], dataset).splitlines()
    if labels := Labels.of(lines):
        return _headed(str(path), _labelled(lines, labels))
    delimiter, skipped = delimiter_in(lines)
    try:
        reader = csv.reader(lines[skipped:], delimiter=delimiter, skipinitialspace=True)
        rows = [(reader.line_num + skipped, _texts(row)) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV file ({error}): save the table as CSV or .xlsx.") from None
    return replace(_headed(str(path), rows), is_semicolon=delimiter == ";")


def _of_excel(path: Path) -> Grid:
    """Return the cells of the first visible sheet of an Excel file that holds any."""
    sheets = sheets_of(path)
    seen = [sheet for sheet in sheets if not sheet.hidden]
    if not seen:
        hidden = f" that can be seen ({sheets[0].name!r} is hidden)" if sheets else ""
        raise InputError(f"{path}: all sheets{hidden} are empty: write a header and a row for each orientation.")
    lines = [(number, [_cell(value) for value in row]) for number, row in seen[0].lines]
    others = ", ".join(repr(sheet.name) for sheet in seen[1:])
    hidden = ", ".join(repr(sheet.name) for sheet in sheets if sheet.hidden)
    remarks = [f"sheet {seen[0].name!r} was read, not {others}; put the table on the first sheet"] if others else []
    remarks += [f"{hidden} was not read, as it is hidden"] if hidden else []
    if rows := seen[0].left_out:
        numbers = ", ".join(map(str, rows[:_SHOWN])) + " ..." * (len(rows) > _SHOWN)
        one = len(rows) == 1
        remarks.append(
            f"row{'s' * (not one)} {numbers} {'was' if one else 'were'} not read, as hidden rows are no data"
        )
    return replace(_headed(str(path), lines), remarks=tuple(remarks))


def _of_columns(table: Any) -> Grid:
    """Return the cells of a structured array, a DataFrame of pandas or polars, or a mapping of columns."""
    names = getattr(getattr(table, "dtype", None), "names", None)
    if names is None:
        names = list(table) if isinstance(table, Mapping) else getattr(table, "columns", None)
    if names is None or isinstance(table, str):
        raise InputError(
            f"a table of type {type(table).__name__} has no names of columns: give a path, a structured array, a "
            "DataFrame or a dict of columns."
        )
    names = list(names)
    columns = [[_cell(value) for value in _values(table[name])] for name in names]
    lengths = {len(column) for column in columns}
    if len(lengths) > 1:
        raise InputError(f"the columns of the table have different lengths ({sorted(lengths)}): give one row a dwell.")
    rows = list(zip(*columns, strict=True))
    _refuse_without_rows("the table", rows)
    return Grid("the table", tuple(map(str, names)), tuple(range(1, len(rows) + 1)), tuple(rows))


def _values(column: Any) -> Iterable[Any]:
    """Return the values of a column as Python's own types, where it can give them."""
    as_list = getattr(column, "tolist", None) or getattr(column, "to_list", None)
    return as_list() if as_list else column


def _cell(value: Any) -> Cell:
    """Return a cell of a spreadsheet or an array: number, stamp or text; None where there is nothing."""
    if value is None or value != value:  # NaN and NaT
        return None
    if type(value) is float:
        return value
    if isinstance(value, datetime) or (isinstance(value, str) and value.strip()):
        return _text(value) if isinstance(value, str) else value
    if isinstance(value, str):
        return None
    if isinstance(value, bytes):
        return _text(value.decode(errors="replace"))
    try:
        return float(value) if not isinstance(value, bool) else str(value)
    except (TypeError, ValueError, OverflowError):
        return _text(str(value))


def _texts(row: list[str]) -> Sequence[str | None]:
    """Return the texts of the cells of a row; most rows have no blank and no long cell."""
    texts = list(map(str.strip, row))
    return texts if all(texts) and max(map(len, texts), default=0) <= _LONGEST_CELL else [_text(cell) for cell in row]


def _text(cell: str) -> str | None:
    """Return the text of a cell, None where it is blank; of bounded length, as it is looked at in many ways."""
    text = cell.strip()
    return (text if len(text) <= _LONGEST_CELL else cut(text, _LONGEST_CELL)) or None


def _headed(name: str, lines: Sequence[tuple[int, Sequence[Cell]]]) -> Grid:
    """Return the grid of lines, with the number that each has in the file."""
    filled = [(number, list(cells)) for number, cells in lines if cells.count(None) < len(cells)]
    header, begin, named = header_in([cells for _, cells in filled]) if filled else ([], 0, ())
    if len(header) < _FEWEST:
        raise InputError(f"{name}: has no table: write a header and a row for each orientation (docs/tables.md).")
    width, head = len(header), tuple(filled[k][0] for k in named if filled[k][0])
    rows = [line for line in filled[begin:] if not is_comment(line[1])]
    if width > _MOST_COLUMNS or width * len(rows) > _MOST_CELLS:
        raise InputError(f"{name}: has {width} columns and {len(rows)} rows, more than any table of orientations: "
                         "leave out what is not part of it.")  # fmt: skip
    for number, cells in rows:
        beyond = [cell for cell in cells[width:] if cell is not None]
        if beyond:
            raise InputError(
                f"{name}: row {number} has {width + len(beyond)} cells where the header has {width}, the last is "
                f"{cut(str(beyond[-1]), 60)!r}: write one cell for each column, and quote a cell that holds a "
                "delimiter."
            )
    _refuse_without_rows(name, rows)
    full = tuple(tuple([*own[:width], *[None] * (width - len(own))]) for _, own in rows)
    return Grid(name, tuple(header), tuple(number for number, _ in rows), full, head)


def _labelled(lines: Sequence[str], labels: Labels) -> list[tuple[int, list[Cell]]]:
    """Return labelled lines as rows under a header, with the face that a line before them names where all have one."""
    rows, face = list[tuple[int, list[Cell]]](), None
    for number, line in enumerate(lines, start=1):
        if values := labels.values(line):
            rows.append((number, [face, *values]))
        elif face_of(line.strip().rstrip(": ")):
            face = line.strip().rstrip(": ")
    if any(cells[0] is None for _, cells in rows):
        return [(0, list[Cell](labels.header)), *((number, cells[1:]) for number, cells in rows)]
    return [(0, ["face", *labels.header]), *rows]


def _refuse_without_rows(name: str, rows: Sequence[object]) -> None:
    if not rows:
        raise InputError(f"{name}: has a header and no rows: write a row for each orientation.")
