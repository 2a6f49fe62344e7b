"""A table as text, from a CSV file, a sheet of Excel, a structured array or a DataFrame."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from kf_calib.errors import InputError
from kf_calib.sources.containers.opening import kind_of_container
from kf_calib.sources.text.cells import DECIMAL_POINT, Numbers
from kf_calib.sources.text.encoding import LARGEST_TABLE_BYTES, TOO_LARGE, encoding_of, unpacked
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.spreadsheet import sheets_of
from kf_calib.support.text import SHOWN, cut

ZIP = b"PK\x03\x04"
TEXT_SUFFIXES = (".csv", ".tsv", ".txt")
EXCEL_SUFFIXES = (".xlsx", ".xlsm")
OLD_SUFFIXES = (".xls", ".ods")
_LONGEST_CELL = 300  # characters; a longer one is a remark, of which the middle is left out
_MOST_COLUMNS, _MOST_CELLS = 1000, 2_000_000
_FEWEST = 3  # columns


Grid = tuple[TextHeading, list[str]]
"""The heading of a table with all its rows, and how its file was read, where that was a choice."""


def grid_of(table: Any, dataset: str = "") -> Grid:
    """The cells of the file at a path, a structured array, a DataFrame or a mapping of columns; dataset: of a
    container."""
    path = table if isinstance(table, Path) else None
    heading, remarks = (_of_columns(table), []) if path is None else _of_file(path, dataset)
    return heading._replace(rows=_full_rows(heading)), remarks


def _of_file(path: Path, dataset: str) -> Grid:
    """Return the cells of a file as they stand there."""
    try:
        with path.open("rb") as file:
            is_excel = file.read(8).startswith(ZIP) and not kind_of_container(path)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror}).") from None
    if path.suffix.lower() in OLD_SUFFIXES:
        raise InputError(f"files of the kind {path.suffix} are not read: save it as .xlsx or .csv.")
    if is_excel:
        return _of_excel(path)
    content = unpacked(path, dataset)
    text = content.decode(encoding_of(content), errors="replace").rstrip("\0")  # which a power cut leaves at the end
    if "\0" in text:
        raise InputError("is no text (it has bytes of zero): save the table as CSV or .xlsx.")
    try:  # any usual delimiter, with or without lines above the header
        return TextHeading.of(text.removeprefix("\ufeff").splitlines(), is_whole=True), []
    except csv.Error as error:
        raise InputError(f"is no CSV file ({error}): save the table as CSV or .xlsx.") from None


def _of_excel(path: Path) -> Grid:
    """Return the cells of the first visible sheet of an Excel file that holds any."""
    if path.stat().st_size > LARGEST_TABLE_BYTES:
        raise InputError(TOO_LARGE.format(path))
    sheets = sheets_of(path)
    seen = [sheet for sheet in sheets if not sheet.hidden]
    if not seen:
        hidden = f" that can be seen ({sheets[0].name!r} is hidden)" if sheets else ""
        raise InputError(f"all sheets{hidden} are empty: write a header and a row for each orientation.")
    remarks, read = list[str](), seen[0]
    if others := ", ".join(repr(sheet.name) for sheet in seen[1:]):
        remarks.append(f"sheet {read.name!r} was read, not {others}; put the table on the first sheet")
    if hidden := ", ".join(repr(sheet.name) for sheet in sheets if sheet.hidden):
        remarks.append(f"{hidden} was not read, as it is hidden")
    if rows := read.left_out:
        numbers = ", ".join(map(str, rows[:SHOWN])) + " ..." * (len(rows) > SHOWN)
        were = f"row {numbers} was" if len(rows) == 1 else f"rows {numbers} were"
        remarks.append(f"{were} not read, as hidden rows are no data")
    texts, delimiter = _texts([row for _, row in read.lines])
    lines = [(number - 1, row) for (number, _), row in zip(read.lines, texts, strict=True)]
    return TextHeading.of_cells(lines, delimiter), remarks


def _of_columns(table: Any) -> TextHeading:
    """Return the cells of a structured array, a DataFrame of pandas or polars, or a mapping of columns."""
    names = getattr(getattr(table, "dtype", None), "names", None)
    if names is None:
        names = list(table) if isinstance(table, Mapping) else getattr(table, "columns", None)
    if names is None:
        raise InputError(
            f"a table of type {type(table).__name__} has no names of columns: give a path, a structured array, a "
            "DataFrame or a dict of columns."
        )
    columns = list[list[Any]]()
    for name in names:  # as Python's own types, where they can be given so
        as_list = getattr(table[name], "tolist", None) or getattr(table[name], "to_list", None)
        columns.append(list(as_list() if as_list else table[name]))
    lengths = {len(column) for column in columns}
    if len(lengths) > 1:
        raise InputError(f"the columns of the table have different lengths ({sorted(lengths)}): give one row a dwell.")
    rows, delimiter = _texts(list(zip(*columns, strict=True)))
    return TextHeading(list(map(str, names)), delimiter, 0, rows, numbers=range(len(rows)))


def _texts(rows: Sequence[Sequence[Any]]) -> tuple[list[list[str]], str]:
    """Return cells of a spreadsheet or an array as texts, and what could be between them; numbers have the sign before
    decimals that texts beside them have."""
    texts = (cell for row in rows for cell in row if isinstance(cell, str))
    decimal = (Numbers.told_by(texts, commas_count=False) or DECIMAL_POINT).decimal
    return [[_cell(cell, decimal) for cell in row] for row in rows], ";" if decimal == "," else ","


def _cell(value: Any, decimal: str) -> str:
    """Return the text of a cell: number, stamp or text; none where there is nothing."""
    if value is None or value != value:  # NaN and NaT
        return ""
    if isinstance(value, datetime):
        return str(value).removesuffix(" 00:00:00")
    if isinstance(value, bytes):
        return value.decode(errors="replace").strip()
    try:
        number = None if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = None
    return str(value).strip() if number is None else repr(number).removesuffix(".0").replace(".", decimal)


def _full_rows(heading: TextHeading) -> list[list[str]]:
    """Return the rows with as many cells as the header; cells are cut to a bounded length, as they are looked at in
    many ways."""
    width, rows = len(heading.header), heading.rows
    if width < _FEWEST:
        begins = f" of three columns, it begins with {cut(heading.delimiter.join(heading.header), 60)!r}" * bool(width)
        raise InputError(f"has no table{begins}: write a header and a row for each orientation (docs/tables.md).")
    if width > _MOST_COLUMNS or width * len(rows) > _MOST_CELLS:
        raise InputError(f"has {width} columns and {len(rows)} rows, more than any table of orientations: leave out "
                         "what is not part of it.")  # fmt: skip
    for line, cells in zip(heading.numbers, rows, strict=True):
        if beyond := [cell for cell in cells[width:] if cell]:
            raise InputError(
                f"row {line + 1} has {width + len(beyond)} cells where the header has {width}, the last is "
                f"{cut(beyond[-1], 60)!r}: write one cell for each column, and quote a cell that holds a delimiter."
            )
    if not rows:
        raise InputError("has a header and no rows: write a row for each orientation.")
    return [[*(cut(cell, _LONGEST_CELL) for cell in cells), *[""] * (width - len(cells))] for cells in rows]
