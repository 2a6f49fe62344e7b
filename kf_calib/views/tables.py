"""Tables that fit the screen: text is folded between words, and numbers are never cut, however narrow the screen is."""

from __future__ import annotations

import copy
import textwrap
from dataclasses import replace

import rich.table
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Column
from rich.text import Text

_GLUE = "\u00a0"  # a space at which no line is broken
_READABLE = 16  # smallest width of a column of text that is longer than this, in characters
_NARROWEST = 20  # smallest width of a record, in characters


class Bar(Text):
    """A number drawn as a bar, which is left out first where the screen is narrow."""

    @property
    def length(self) -> float:
        """Its length in characters, the last of which may be a part of a block (U+2589 is seven eighths of one)."""
        last = ord(self.plain[-1]) if self.plain else 0
        part = (0x2590 - last) / 8.0 if 0x2588 <= last <= 0x258F else 0.0
        return max(len(self.plain) - 1, 0) + part


class ConsoleTable(rich.table.Table):
    """A table whose right-aligned columns hold numbers, which are never folded; other columns are folded between words.

    Where the table does not fit, its frame is left out, then its bars. If that is not enough, each row becomes a record
    of one or more lines, in which every cell follows the heading of its column.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unframed = self._unframed()
        for table in (self, unframed, unframed._without_bars()):
            widths = table._fitting(console, options)
            if widths is not None:
                fitted = [replace(column, width=width) for column, width in zip(table.columns, widths, strict=True)]
                yield from rich.table.Table.__rich_console__(table._of(fitted), console, options)
                return
        yield Text(self._without_bars()._records(max(options.max_width, _NARROWEST)))

    def _of(self, columns: list[Column]) -> ConsoleTable:
        """Return the same rows with other columns."""
        other = copy.copy(self)
        other.columns = [replace(column, _index=k) for k, column in enumerate(columns)]
        return other

    def _unframed(self) -> ConsoleTable:
        """Return the same table with a line under the headings in place of a frame."""
        other = copy.copy(self)
        other.box, other.show_edge, other.padding = self.box and SIMPLE_HEAD, False, (0, 0 if self.box else 1)
        return other

    def _without_bars(self) -> ConsoleTable:
        """Return the same table without columns of bars."""
        return self._of([column for column in self.columns if not any(isinstance(cell, Bar) for cell in column.cells)])

    def _fitting(self, console: Console, options: ConsoleOptions) -> list[int] | None:
        """Return the widths of the columns, as wide as their text if there is room; None if numbers would be cut."""
        widths, least = [_widest(column) for column in self.columns], [_least(column) for column in self.columns]
        unbounded = options.update(width=1 << 16)
        frame = rich.table.Table.__rich_measure__(self, console, unbounded).maximum - sum(widths)
        over = max(sum(widths) + frame - options.max_width, 0)
        spare = [width - own for width, own in zip(widths, least, strict=True)]
        if over > sum(spare):
            return None
        for k in range(len(spare)):  # each column is narrowed in proportion to the width that it can spare
            cut = -(-over * spare[k] // max(sum(spare[k:]), 1))
            widths[k], over = widths[k] - cut, over - cut
        return widths

    def _records(self, width: int) -> str:
        """Return the rows as records of text."""
        headings, cells = [_one_line(column.header) for column in self.columns], [list(c.cells) for c in self.columns]
        lines = [*textwrap.wrap(_one_line(self.title or ""), width)]
        for number, row in enumerate(self.rows):
            label, *said = [_one_line(column[number]) for column in cells]
            named = [f"{heading} {cell}".strip() for heading, cell in zip(headings[1:], said, strict=True) if cell]
            glued = [part.replace(" ", _GLUE) if cell_len(part) <= width // 2 else part for part in named]
            text = f"{label}: {', '.join(glued)}".removeprefix(": ")
            wrapped = textwrap.wrap(
                text, width, initial_indent="" if label else "  ", subsequent_indent="  ",
                break_long_words=False, break_on_hyphens=False,
            )  # fmt: skip
            lines += [line.replace(_GLUE, " ") for line in wrapped]
            if row.end_section and number < len(self.rows) - 1:
                lines.append("")
        return "\n".join(lines)


def _one_line(cell: RenderableType | None) -> str:
    """Return the text of a cell on one line."""
    return " ".join(str(cell or "").split())


def _lengths(texts: list[str]) -> int:
    """Return the width of the longest of some texts."""
    return max(map(cell_len, texts), default=0)


def _widest(column: Column) -> int:
    """Return the width of a column whose text is not folded."""
    return _lengths([line for cell in (column.header, *column.cells) for line in str(cell).splitlines()])


def _least(column: Column) -> int:
    """Return the smallest width of a column: its numbers are not folded, its text is folded between words."""
    if column.no_wrap:
        return _widest(column)
    words = _lengths(str(column.header).split())
    if column.justify == "right":
        return max(words, _lengths([line for cell in column.cells for line in str(cell).splitlines()]))
    words = max(words, _lengths([word for cell in column.cells for word in str(cell).split()]))
    return max(words, min(_widest(column), _READABLE))
