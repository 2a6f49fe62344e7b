"""Rows of a sheet of Excel that are written as most programs write them, read without a parser of XML.

A table of 100 000 rows has a million cells, and a parser makes several objects of each cell. Rows of which all cells
hold numbers or plain texts are therefore read by a regular expression, and cut out of what the parser reads.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

BEGIN_OF_ROW = re.compile(rb"<(?:\w+:)?row\b")
NUMBERED_ROW = re.compile(rb'<(?:\w+:)?row\b[^<>]*?\sr\s*=\s*["\'](\d{1,9})["\']')
_ATTRIBUTE = rb' [\w:]+="[ !#-%\'-;=?-~]*+"'
_TEXT = rb"[ -%'-;=?-~]"  # ASCII without references to characters
_FORMULA = rb"<f(?:%b)*+(?: ?/>|>%b*+</f>)" % (_ATTRIBUTE, _TEXT)
_NUMBER = rb"(?!-0*<)-?\d{1,20}(?:\.\d{0,25})?+(?:[eE][+-]?\d{1,3})?+"  # -0 is the whole number 0 for a parser
_CELL = (
    rb'<c r="([A-Z]{1,3})[1-9]\d{0,6}"(?: s="(0|[1-9]\d{0,5})")?+'
    rb'(?:(?: t="([ns])")?+(?: ?/>|>(?:%b)?+<v>(%b)</v></c>)'
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
