"""The cells of an Excel file, which is a zip archive of XML: what it says of its own size is not believed.

A file of a few kB can unpack to gigabytes, name a cell in the last row and column, or say that it has one row where it
has seven. All of it is bounded before and while it is read, and what no program writes is refused.

A table of 100 000 rows has a million cells, and a parser of XML makes several objects of each cell. Rows of which all
cells hold numbers or plain texts, as most programs write them, are therefore read by a regular expression, and cut out
of what the parser reads.
"""

from __future__ import annotations

import functools
import heapq
import io
import itertools
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

from kf_calib.errors import InputError, need
from kf_calib.support.text import cut

BEGIN_OF_ROW = re.compile(rb"<(?:\w+:)?row\b")
NUMBERED_ROW = re.compile(rb'<(?:\w+:)?row\b[^<>]*?\sr\s*=\s*["\'](\d{1,9})["\']')
_ATTRIBUTE = rb' [\w:]+="[ !#-%\'-;=?-~]*+"'
_TEXT = rb"[ -%'-;=?-~]"  # ASCII without references to characters
_FORMULA = rb"<f(?:%b)*+(?: ?/>|>%b*+</f>)" % (_ATTRIBUTE, _TEXT)
_NUMBER = rb"(?!-0*<)-?\d{1,20}(?:\.\d{0,25})?+(?:[eE][+-]?\d{1,3})?+"  # -0 is the whole number 0 for a parser
_CELL = (
    rb'<c r="([A-Z]{1,3})[1-9]\d{0,6}"(?: s="(0|[1-9]\d{0,5})")?+'
    rb'(?:(?: t="([ns])")?+(?: ?/>|></c>|>(?:%b)?+<v>(%b)</v></c>)'
    rb'| t="inlineStr"><is><t(?: xml:space="preserve")?+>(%b++)</t></is></c>)'
) % (_FORMULA, _NUMBER, _TEXT)  # column, style, kind, number and text
_CELLS, _NO_GROUPS = re.compile(_CELL), re.sub(rb"\((?!\?)", rb"(?:", _CELL)
_PLAIN_ROW = re.compile(rb'<row r="(\d{1,7})"(?:%b)*+>((?:%b)++)</row>' % (_ATTRIBUTE, _NO_GROUPS))
_NAMESPACE = re.compile(rb"\sxmlns\s*=")
_SHEET = re.compile(
    rb"(?:\xef\xbb\xbf)?\s*(?:<\?xml[^<>]*\?>\s*)?<worksheet\b[^<>]*?"
    rb'\sxmlns="http://schemas\.openxmlformats\.org/spreadsheetml/2006/main"'
)


@dataclass(frozen=True)
class CellContext:
    """What the cells of a sheet refer to: shared texts, the styles of dates and of durations, and the day from which
    dates count."""

    texts: Sequence[str]
    dates: set[int]
    durations: set[int]
    epoch: datetime

    def value(self, style: bytes, kind: bytes, text: bytes) -> Any:
        """The value of a cell with a style or a kind; what is no date of Excel is its error, as openpyxl has it."""
        from openpyxl.utils.datetime import from_excel

        if kind == b"s":
            return self.texts[int(text.decode())]
        if not style or int(style) not in self.dates:
            return float(text)
        try:
            return from_excel(float(text), self.epoch, timedelta=int(style) in self.durations)
        except (OverflowError, ValueError):
            return "#VALUE!"


@dataclass(frozen=True)
class PlainRows:
    """The plain rows of a part of an Excel file: the number of each, and where its cells begin and end in ``content``.

    rest: the part without them.
    """

    content: bytes
    rest: bytes
    spans: list[tuple[int, int, int]]

    @classmethod
    def of(cls, content: bytes) -> PlainRows:
        """The plain rows of a part; none where ``<row`` could mean something else there, or where the number of another
        row follows from the rows before it."""
        begin = _SHEET.match(content)
        if not begin or len(_NAMESPACE.findall(content)) > 1:
            return cls(content, content, [])
        if b"<!" in content or content.find(b"<?", begin.end()) >= 0:
            return cls(content, content, [])
        spans, others, end = list[tuple[int, int, int]](), list[bytes](), 0
        for row in _PLAIN_ROW.finditer(content):
            spans.append((int(row[1]), row.start(2), row.end(2)))
            others.append(content[end : row.start()])
            end = row.end()
        rest = b"".join([*others, content[end:]])
        if len(BEGIN_OF_ROW.findall(rest)) != len(NUMBERED_ROW.findall(rest)):
            return cls(content, content, [])
        return cls(content, rest, spans)

    def rows(self, context: CellContext) -> Iterator[tuple[int, list[Any]]]:
        """The number of each row, and its cells up to that which is written last."""
        for number, begin, end in self.spans:
            cells = _CELLS.findall(self.content, begin, end)
            values = list[Any]([None]) * column_number(cells[-1][0])
            for letters, style, kind, number_text, text in cells:
                place = column_number(letters)
                if place > len(values) or not (number_text or text):
                    continue
                if text:
                    values[place - 1] = text.decode()
                elif style or kind == b"s":
                    values[place - 1] = context.value(style, kind, number_text)
                else:
                    values[place - 1] = float(number_text)
            yield number, values


@functools.cache
def column_number(letters: bytes) -> int:
    """The number of a column from 1, of its one to three letters."""
    return functools.reduce(lambda number, letter: 26 * number + letter - 64, letters, 0)


SheetRow = tuple[int, list[Any]]
"""Number of a row in its sheet, from 1, and its cells up to the last that is filled."""
_MOST_ROWS = 1 << 20  # of a sheet of Excel
_MOST_VISITED = 20_000_000  # cells of a sheet, empty ones too
_MOST_FILLED = 2_000_000  # cells from the first to the last of each row
_MOST_BYTES, _MOST_TAGS = 64_000_000, 2_000_000  # unpacked, of all parts but pictures; a tag takes some 120 bytes
_MOST_TAGS_OF_SHEETS, _MOST_TAGS_OF_A_ROW = 10_000_000, 200_000  # rows are forgotten one by one as they are read
_PICTURES, _SHEETS = "xl/media/", "xl/worksheets/"
_HIDDEN_ROW = re.compile(
    rb'<(?:\w+:)?row\b(?=[^<>]*?\shidden\s*=\s*["\'](?:1|true)["\'])[^<>]*?\sr\s*=\s*["\'](\d{1,9})["\']'
)
_LONG_FORMAT = re.compile(rb"formatCode\s*=\s*([\"'])[^\"'<>]{1000}")  # of a number; Excel's have at most 255 letters
_MERGED = re.compile(
    rb'<(?:\w+:)?mergeCell\b[^<>]*?\sref\s*=\s*["\']\$?([A-Z]{1,3})\$?(\d{1,9}):\$?([A-Z]{1,3})\$?(\d{1,9})["\']'
)
_DECLARED = (b"<!DOCTYPE", b"<!ENTITY", b"<\0!\0D\0", b"\0<\0!\0D")  # in UTF-8, and in both kinds of UTF-16


@dataclass(frozen=True)
class Sheet:
    """A sheet of a file: what is filled in it and not hidden. left_out: numbers of filled rows that are hidden, by hand
    or by a filter."""

    name: str
    hidden: bool
    lines: list[SheetRow]
    left_out: list[int]


def sheets_of(path: Path) -> list[Sheet]:
    """All sheets of an Excel file that hold anything, in its order. Raises InputError, with the path, where it cannot
    be read."""
    need("openpyxl", "tables", f"reading {path}")
    import openpyxl

    try:
        with path.open("rb") as file:
            parts = {name: PlainRows.of(content) for name, content in _fit_parts(file).items()}
        with warnings.catch_warnings(action="ignore"):  # of what openpyxl leaves out, which no cell is part of
            book: Any = openpyxl.load_workbook(_archive_of_rest(parts), read_only=True, data_only=True)
            sheets = [_sheet(sheet, parts[sheet._worksheet_path.lstrip("/")]) for sheet in book.worksheets]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:
        raise _unreadable(path, error) from None
    return [sheet for sheet in sheets if sheet.lines]


def workbook_of(path: Path) -> Any:
    """The whole workbook of a file that ``sheets_of`` has read, to be written again. Raises InputError, with the path,
    where it cannot be read as a whole."""
    import openpyxl

    try:
        with zipfile.ZipFile(path) as archive:
            if sum(_merged(archive.read(part)) for part in archive.infolist() if part.filename.startswith(_SHEETS)) > (
                _MOST_FILLED
            ):
                raise InputError("has more merged cells than any table of orientations: part them.")
        with warnings.catch_warnings(action="ignore"):
            return openpyxl.load_workbook(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:
        raise _unreadable(path, error) from None


def _merged(content: bytes) -> int:
    """Return how many cells of a sheet are merged with others: all of them are made when it is read as a whole."""
    places = [(column_number(a), int(b), column_number(c), int(d)) for a, b, c, d in _MERGED.findall(content)]
    return sum((abs(right - left) + 1) * (abs(below - above) + 1) for left, above, right, below in places)


def _unreadable(path: Path, error: Exception) -> InputError:
    """Return the error for what openpyxl raises for a damaged file, which depends on where the damage is."""
    cause = error.__cause__ or error  # openpyxl says it again, with the name of the archive
    said = cut(" ".join(str(cause).split()), 80) or type(cause).__name__
    return InputError(f"{path}: is no Excel file that can be read ({said}): save it again.")


def _fit_parts(file: Any) -> dict[str, bytes]:
    """Return the parts of an archive but its pictures; raises InputError where it unpacks to too much, or has XML that
    is none of a spreadsheet."""
    size, tags, tags_of_sheets, parts = 0, 0, 0, dict[str, bytes]()
    with zipfile.ZipFile(file) as archive:
        for part in archive.infolist():
            size += part.file_size  # no more than this is ever unpacked
            if size > _MOST_BYTES and not part.filename.startswith(_PICTURES):
                raise InputError("unpacks to more than any table of orientations: leave out what is not part of it.")
            if part.filename.startswith(_PICTURES):
                size -= part.file_size
                continue
            parts[part.filename] = content = archive.read(part)
            is_sheet, count = part.filename.startswith(_SHEETS), content.count(b"<")
            tags += _most_tags_of_a_row(content) if is_sheet else count
            tags_of_sheets += count if is_sheet else 0
            if tags > _MOST_TAGS or tags_of_sheets > _MOST_TAGS_OF_SHEETS:
                raise InputError("has more cells than any table of orientations: leave out what is not part of it.")
            _refuse_part(content)
    return parts


def _archive_of_rest(parts: Mapping[str, PlainRows]) -> io.BytesIO:
    """Return an archive of parts without their plain rows."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as rest:
        for name, part in parts.items():
            rest.writestr(name, part.rest)
    return archive


def _most_tags_of_a_row(content: bytes) -> int:
    """Return the largest number of tags from the beginning of a row, or of the sheet, to that of the next row.

    It is as if there were too many in all if there are more than Excel has columns for.
    """
    begins = [0, *(found.start() for found in BEGIN_OF_ROW.finditer(content)), len(content)]
    most = max(content.count(b"<", begin, end) for begin, end in itertools.pairwise(begins))
    return most if most <= _MOST_TAGS_OF_A_ROW else _MOST_TAGS + 1


def _refuse_part(content: bytes) -> None:
    if any(word in content for word in _DECLARED):
        raise InputError("has XML that declares entities, as no spreadsheet does: save it again.")
    if _LONG_FORMAT.search(content):
        raise InputError("has a number format longer than Excel allows: save it again.")
    numbers = list(map(int, NUMBERED_ROW.findall(content)))
    if any(after <= before for before, after in itertools.pairwise(numbers)):
        raise InputError("has rows that are out of order, which would be lost: save it again.")


def _sheet(sheet: Any, part: PlainRows) -> Sheet:
    hidden_rows = set(map(int, _HIDDEN_ROW.findall(part.content)))  # openpyxl does not tell them row by row
    lines = _lines(sheet, part)
    seen = [line for line in lines if line[0] not in hidden_rows]
    left_out = [number for number, _ in lines if number in hidden_rows]
    return Sheet(sheet.title, sheet.sheet_state != "visible", seen, left_out)


def _lines(sheet: Any, part: PlainRows) -> list[SheetRow]:
    """Return the rows of a sheet that hold anything."""
    sheet.reset_dimensions()  # what the file says of its size may be wrong
    lines, visited, filled, book = list[SheetRow](), 0, 0, sheet.parent
    plain = part.rows(CellContext(sheet._shared_strings, book._date_formats, book._timedelta_formats, book.epoch))
    for number, row in heapq.merge(enumerate(sheet.iter_rows(values_only=True), 1), plain, key=itemgetter(0)):
        visited += len(row)
        last = len(row)
        while last and row[last - 1] is None:
            last -= 1
        filled += last
        if number > _MOST_ROWS or number + visited > _MOST_VISITED or filled > _MOST_FILLED:
            raise InputError(f"sheet {sheet.title!r} has more cells than any table of orientations: leave out what is "
                             "not part of it, empty rows and columns too.")  # fmt: skip
        if last:
            lines.append((number, list(row[:last])))
    return lines
