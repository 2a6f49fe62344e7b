"""The Rich console on which results are drawn, and what Rich has not: remarks, bars, tables that fit the screen, and
plots in letters. Control characters in a text never reach the terminal as commands.
"""

from __future__ import annotations

import copy
import textwrap
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rich.table
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.segment import Segment
from rich.table import Column
from rich.text import Text

from kf_calib.bench.arrays import Floats
from kf_calib.support.text import printable, sentence
from kf_calib.support.units import Unit, shown, significant
from kf_calib.views.notation import unit_across

if TYPE_CHECKING:
    from kf_calib.diagnosis.explanation import EffectShape


class PlainConsole(Console):
    """A console that reads no markup in its text, and shows control characters as their codes."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of a renderable with control characters in its text replaced."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


class Note(Text):
    """A remark beside a result, on a line of its own."""


def note(said: str) -> Note:
    """The remark of these words."""
    return Note(f"Note: {sentence(said)}", style="yellow")


VERDICT_STYLES: Mapping[bool | None, str] = {True: "bold green", False: "bold yellow", None: "bold"}
"""Of what is said of an agreement: there is one, there is none, it cannot be judged."""
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

    Where the table does not fit the screen, its frame is left out, then its bars. If that is not enough, each row
    becomes a record of one or more lines, in which every cell follows the heading of its column.
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


FOURS = range(3, 12, 4)
"""The last rows of the four parameters of each accelerometer."""
LINED: Mapping[str, Any] = {"box": SIMPLE_HEAD, "pad_edge": False}
"""A table without a frame, but with a line below its headings."""
BARE: Mapping[str, Any] = {"box": None, "pad_edge": False}
"""A table without any line."""


def table(
    title: str, headings: Iterable[str], rows: Iterable[Iterable[RenderableType]], ends: Container[int] = (),
    whole: Container[str] = (), **style: Any,
) -> ConsoleTable:  # fmt: skip
    """A table of these rows.

    headings: of its columns; one of numbers, which are aligned to the right, begins with ``>``. ends: numbers of the
    rows, from 0, below which there is a line. whole: headings of columns of text that is never folded. style: as
    Rich has it.
    """
    drawn = ConsoleTable(title=title or None, title_justify="left", **style)
    for heading in headings:
        name, justify = heading.removeprefix(">"), "right" if heading.startswith(">") else "left"
        drawn.add_column(name, justify=justify, no_wrap=name in whole)
    for number, row in enumerate(rows):
        drawn.add_row(*row, end_section=number in ends)
    return drawn


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


_WIDTH, _HEIGHT = 64, 8
_LEFT = 9  # letters of the numbers beside the plot
_READING, _FITTED, _ZERO = "●", "·", "┈"


@dataclass(frozen=True)
class TextPlot:
    """A point a dwell of the channel that shows an effect most, and the effect as a dotted curve."""

    shape: EffectShape

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The plot, as wide as there is room, and its axes in words."""
        shape, k = self.shape, self.shape.clearest
        width = min(_WIDTH, options.max_width - _LEFT)
        across = unit_across(shape)
        symbol = f" ({shape.symbol})" if "·" in shape.symbol else ""
        of = f"{shape.channels[k]}, {shown(shape.quantity).label}"
        yield Text(f"What {shape.effect} must explain {_READING} and what it adds {_FITTED} ({of})")
        yield Text("\n".join(_lines(shape, k, across, width)), no_wrap=True)
        words = f"{shape.words}{symbol}, {across.label}"
        yield Text(f"{'':{_LEFT}}{words.center(width)}".rstrip() if len(words) <= width else words)


def _lines(shape: EffectShape, k: int, across: Unit, width: int) -> list[str]:
    """Return the plot of a channel in so many columns, with numbers at the ends of its axes."""
    known, upward = np.isfinite(shape.readings[:, k]), shown(shape.quantity)
    x, y = shape.values[known, k] * across.per_si, shape.readings[known, k] * upward.per_si
    at, middle = x, shape.component[known, k] * upward.per_si
    if shape.is_curve:
        at, middle = (each * unit.per_si for each, unit in zip(shape.curve(k)[:2], (across, upward), strict=True))
    low, high = min(y.min(), middle.min(), 0.0), max(y.max(), middle.max(), 0.0)
    left, right = float(x.min()), float(x.max())
    canvas = [[" "] * width for _ in range(_HEIGHT)]
    for mark, columns, rows in ((_ZERO, np.linspace(left, right, width), np.zeros(width)), (_FITTED, at, middle),
                                (_READING, x, y)):  # fmt: skip
        places = zip(_cells(columns, left, right, width), _cells(rows, low, high, _HEIGHT), strict=True)
        for column, row in places:
            canvas[_HEIGHT - 1 - row][column] = mark
    labels = {0: significant(high, 2), _HEIGHT - 1: significant(low, 2)}
    lines = [f"{labels.get(row, ''):>{_LEFT - 2}} ┤{''.join(cells)}".rstrip() for row, cells in enumerate(canvas)]
    first, last = significant(left), significant(right)
    return [*lines, f"{'':{_LEFT - 1}}└{'─' * width}", f"{'':{_LEFT}}{first}{last:>{width - len(first)}}"]


def _cells(values: Floats, low: float, high: float, count: int) -> list[int]:
    """Return the number of the cell, from 0, in which each value lies between two ends."""
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return np.clip((share * count).astype(int), 0, count - 1).tolist()
