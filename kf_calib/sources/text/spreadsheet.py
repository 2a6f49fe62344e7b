"""The cells of an Excel file, which is a zip archive of XML: what it says of its own size is not believed.

A file of a few kB can unpack to gigabytes, name a cell in the last row and column, or say that it has one row where it
has seven. All of it is bounded before and while it is read, and what no program writes is refused.

openpyxl reads all but the sheets: their texts, the styles of dates, names. It makes several objects of each cell, so
that sheets go to expat, which makes none.
"""

from __future__ import annotations

import functools
import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.parsers import expat

from kf_calib.errors import InputError, need
from kf_calib.support.text import cut

SheetRow = tuple[int, list[Any]]
"""Number of a row in its sheet, from 1, and its cells up to the last that is filled."""
_MOST_ROWS, _MOST_COLUMNS = 1 << 20, 1 << 14  # of a sheet of Excel
_MOST_VISITED = 20_000_000  # cells of a sheet, empty ones too
_MOST_FILLED = 2_000_000  # cells from the first to the last of each row
_MOST_BYTES, _MOST_TAGS = 64_000_000, 2_000_000  # unpacked, of all parts but pictures; a tag takes some 120 bytes
_MOST_TAGS_OF_SHEETS = 10_000_000  # which are forgotten as they are read
_PICTURES, _SHEETS = "xl/media/", "xl/worksheets/"
_LONG_FORMAT = re.compile(rb"formatCode\s*=\s*([\"'])[^\"'<>]{1000}")  # of a number; Excel's have at most 255 letters
_MERGED = re.compile(rb'<(?:\w+:)?mergeCell\b[^<>]*?\sref\s*=\s*["\']([A-Z0-9$:]+)["\']')
_DECLARED = (b"<!DOCTYPE", b"<!ENTITY", b"<\0!\0D\0", b"\0<\0!\0D")  # in UTF-8, and in both kinds of UTF-16
_XML = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_ROW, _CELL, *_TEXTS = (f"{_XML} {tag}" for tag in ("row", "c", "v", "t"))
_NO_CELLS = f'<worksheet xmlns="{_XML}"/>'


class Sheet:
    """A sheet of a file: what is filled in it and not hidden, as a parser of XML comes by it.

    name, hidden: of the sheet. lines: rows that are filled. left_out: numbers of filled rows that are hidden, by hand
    or by a filter. Raises InputError where it has more cells than any table, or rows out of order.
    """

    def __init__(self, sheet: Any, content: bytes) -> None:
        """sheet: of openpyxl, content: its part of the file."""
        self.name, self.hidden = str(sheet.title), sheet.sheet_state != "visible"
        self.lines, self.left_out = list[SheetRow](), list[int]()
        self._book, self._texts = sheet.parent, sheet._shared_strings
        self._dates = {str(style) for style in self._book._date_formats}
        self._number = self._column = self._visited = self._filled = 0  # of rows and of cells
        self._row, self._is_hidden = list[Any](), False
        self._cell, self._letters = dict[str, str](), list[str]()  # attributes, and the text in it
        parser = expat.ParserCreate(namespace_separator=" ")
        parser.buffer_text = True
        parser.StartElementHandler, parser.EndElementHandler = self._begin, self._end
        parser.CharacterDataHandler = self._letters.append
        parser.Parse(content, True)

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._letters.clear()
        if tag == _CELL:
            place = attributes.get("r", "").rstrip("0123456789")
            self._column = _column_number(place) if place else self._column + 1
            if self._column > _MOST_COLUMNS:
                raise self._too_large
            self._cell = attributes
        elif tag == _ROW:
            before, self._number = self._number, int(attributes.get("r", self._number + 1))
            if self._number <= before:
                raise InputError("has rows that are out of order, which would be lost: save it again.")
            self._row, self._column = [], 0
            self._is_hidden = attributes.get("hidden") in ("1", "true")

    def _end(self, tag: str) -> None:
        if tag in _TEXTS and (text := "".join(self._letters)):
            self._row += [None] * (self._column - len(self._row))
            before = self._row[self._column - 1]  # of a text in several fonts
            self._row[self._column - 1] = self._value(text) if before is None else f"{before}{text}"
        elif tag == _ROW:
            self._end_row()

    def _value(self, text: str) -> Any:
        """What a cell with this text holds."""
        match self._cell.get("t", "n"):
            case "n":
                style = self._cell.get("s")
                return self._date(float(text), int(style or 0)) if style in self._dates else float(text)
            case "s":
                return self._texts[int(text)]
            case "b":
                return bool(int(text))
            case "d":
                from openpyxl.utils.datetime import from_ISO8601

                return from_ISO8601(text)
            case _:
                return text

    def _date(self, day: float, style: int) -> Any:
        """The date or the duration that is meant, or the error that Excel shows where it is none."""
        from openpyxl.utils.datetime import from_excel

        try:
            return from_excel(day, self._book.epoch, timedelta=style in self._book._timedelta_formats)
        except (OverflowError, ValueError):
            return "#VALUE!"

    def _end_row(self) -> None:
        self._visited, self._filled = self._visited + self._column, self._filled + len(self._row)
        if self._number > _MOST_ROWS or self._visited > _MOST_VISITED or self._filled > _MOST_FILLED:
            raise self._too_large
        if not self._row:
            return
        if self._is_hidden:
            self.left_out.append(self._number)
        else:
            self.lines.append((self._number, self._row))

    @property
    def _too_large(self) -> InputError:
        return InputError(f"sheet {self.name!r} has more cells than any table of orientations: leave out what is not "
                          "part of it, empty rows and columns too.")  # fmt: skip


@functools.cache
def _column_number(letters: str) -> int:
    """The number of a column from 1, of its one to three letters."""
    return functools.reduce(lambda number, letter: 26 * number + int(letter, 36) - 9, letters, 0)


def sheets_of(path: Path) -> list[Sheet]:
    """All sheets of an Excel file that hold anything, in its order. Raises InputError, with the path, where it cannot
    be read."""
    need("openpyxl", "tables", f"reading {path}")
    import openpyxl

    with _read_by_openpyxl(path):
        with path.open("rb") as file:
            parts = _fit_parts(file)
        book: Any = openpyxl.load_workbook(_archive_without_cells(parts), read_only=True, data_only=True)
        sheets = [Sheet(sheet, parts[sheet._worksheet_path.lstrip("/")]) for sheet in book.worksheets]
    return [sheet for sheet in sheets if sheet.lines]


def workbook_of(path: Path) -> Any:
    """The whole workbook of a file that ``sheets_of`` has read, to be written again. Raises InputError, with the path,
    where it cannot be read as a whole."""
    import openpyxl

    with _read_by_openpyxl(path):
        with zipfile.ZipFile(path) as archive:
            sheets = [part for part in archive.infolist() if part.filename.startswith(_SHEETS)]
            merged = sum(_merged(archive.read(sheet)) for sheet in sheets)
        if merged > _MOST_FILLED:
            raise InputError("has more merged cells than any table of orientations: part them.")
        return openpyxl.load_workbook(path)


def _merged(content: bytes) -> int:
    """Return how many cells of a sheet are merged with others: all of them are made when it is read as a whole."""
    from openpyxl.worksheet.cell_range import CellRange

    sizes = [CellRange(place.decode()).size for place in _MERGED.findall(content)]
    return sum(size["rows"] * size["columns"] for size in sizes)


@contextmanager
def _read_by_openpyxl(path: Path) -> Iterator[None]:
    """Raises InputError, with the path, for what is raised of a damaged file, which depends on where the damage is."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of what openpyxl leaves out, which no cell is part of
            yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except KeyError:  # of a part that any spreadsheet has
        raise InputError(f"{path}: is an archive of files: unpack it, and give the one with the readings.") from None
    except Exception as error:
        cause = error.__cause__ or error  # openpyxl says it again, with the name of the archive
        said = cut(" ".join(str(cause).split()), 80) or type(cause).__name__
        raise InputError(f"{path}: is no Excel file that can be read ({said}): save it again.") from None


def _fit_parts(file: Any) -> dict[str, bytes]:
    """Return the parts of an archive but its pictures; raises InputError where it unpacks to too much, or has XML that
    is none of a spreadsheet."""
    size, tags, parts = 0, Counter[bool](), dict[str, bytes]()
    with zipfile.ZipFile(file) as archive:
        for part in archive.infolist():
            if part.filename.startswith(_PICTURES):
                continue
            size += part.file_size  # no more than this is ever unpacked
            if size > _MOST_BYTES:
                raise InputError("unpacks to more than any table of orientations: leave out what is not part of it.")
            parts[part.filename] = content = archive.read(part)
            tags[part.filename.startswith(_SHEETS)] += content.count(b"<")
            if tags[False] > _MOST_TAGS or tags[True] > _MOST_TAGS_OF_SHEETS:
                raise InputError("has more cells than any table of orientations: leave out what is not part of it.")
            if any(word in content for word in _DECLARED):
                raise InputError("has XML that declares entities, as no spreadsheet does: save it again.")
            if _LONG_FORMAT.search(content):
                raise InputError("has a number format longer than Excel allows: save it again.")
    return parts


def _archive_without_cells(parts: Mapping[str, bytes]) -> io.BytesIO:
    """Return an archive of parts in which sheets are empty."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as empty:
        for name, content in parts.items():
            empty.writestr(name, _NO_CELLS if name.startswith(_SHEETS) and name.endswith(".xml") else content)
    return archive
