"""Numbers and stamps in the cells of a table, as spreadsheets of different countries write them."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import cast

from kf_calib.sources.tables.grid import Cell, Grid

_NUMBER = re.compile(r"[+\-−]?[\d.,'’ \u00a0\u202f]*\d[\d.,]*(?:[eE][+\-]?\d+)?")
_SPACES = str.maketrans("", "", "'’ \u00a0\u202f")
_LOCAL = re.compile(
    r"(\d{1,4})[./-](\d{1,2})[./-](\d{1,4})[,T ]*\s*(?:(\d{1,2})[:.](\d{2})(?:[:.](\d{2})(?:[.,](\d+))?)?)?"
    r"\s*([AaPp][Mm])?\s*(Z|UTC|GMT|CET|MEZ|CEST|MESZ|[+-]\d{2}:?\d{2})?"
)
_ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}


@dataclass(frozen=True)
class Numbers:
    """How the numbers of a table are written: the sign before decimals, and the one between thousands."""

    decimal: str = "."
    thousands: str = ","

    @classmethod
    def of(cls, grid: Grid) -> Numbers:
        """How the numbers in a grid are written; raises InputError where two cells contradict each other."""
        cell_of_sign = dict[str, tuple[int, int]]()
        if not any(isinstance(cell, str) for row in grid.rows for cell in row):
            return cls()
        for k, row in enumerate(grid.rows):
            if not _shows_another(_joined(row), cell_of_sign):
                continue
            for j, cell in enumerate(row):
                if not isinstance(cell, str) or not _shows_another(cell, cell_of_sign):
                    continue
                if _NUMBER.fullmatch(cell) and (decimal := _decimal_of(cell)):
                    cell_of_sign.setdefault(decimal, (k, j))
        if len(cell_of_sign) == 2:
            (_, (k, j)), (other, _) = sorted(cell_of_sign.items(), key=lambda item: item[1])[::-1]
            raise grid.refuse(k, grid.header[j], grid.rows[k][j], f"other numbers of the table have decimals after "
                              f"{other!r}: write all of them in one way")  # fmt: skip
        decimal = next(iter(cell_of_sign), "")
        if not decimal and grid.is_semicolon:
            cells = (cell for row in grid.rows for cell in row if isinstance(cell, str) and "," in cell)
            decimal = "," if any(_NUMBER.fullmatch(cell) for cell in cells) else ""
        return cls(",", ".") if decimal == "," else cls()

    @classmethod
    def told_by(cls, cells: Iterable[str], *, commas_count: bool) -> Numbers | None:
        """How numbers are written by the first cell that shows it; None where none does.

        commas_count: whether a comma in a cell that could be either is one before decimals, since it separates no
        cells.
        """
        could_be = False
        for cell in cells:
            if ("," in cell or "." in cell) and _NUMBER.fullmatch(cell):
                if decimal := _decimal_of(cell):
                    return _DECIMAL_COMMA if decimal == "," else DECIMAL_POINT
                could_be |= commas_count and "," in cell
        return _DECIMAL_COMMA if could_be else None

    def with_point(self, cell: str) -> str:
        """A number with a point before its decimals; raises ValueError where it has separators of thousands."""
        if self.decimal == ".":
            return cell
        if "." in cell:
            raise ValueError
        return cell.replace(",", ".")

    def value(self, cell: Cell) -> float:
        """The number in a cell; raises ValueError where there is none."""
        if isinstance(cell, str) and self.decimal == "." and _is_plain(cell):
            cell = float(cell)
        elif isinstance(cell, str):
            text = cell.translate(_SPACES).replace("−", "-")
            whole, _, rest = text.partition(self.decimal)
            if self.thousands in rest or self.decimal in rest:
                raise ValueError
            if self.thousands in whole:
                if not re.fullmatch(rf"[+-]?\d{{1,3}}(?:\{self.thousands}\d{{3}})+", whole):
                    raise ValueError
                whole = whole.replace(self.thousands, "")
            if "_" in text:
                raise ValueError
            cell = float(f"{whole}.{rest}" if rest else whole)
        if not isinstance(cell, float) or not math.isfinite(cell):
            raise ValueError
        return cell

    def values(self, cells: Sequence[Cell]) -> list[float] | None:
        """The numbers in cells that are all numbers, or all written as programs write them; None where one is not."""
        texts = cast("Sequence[str]", cells)
        if set(map(type, cells)) == {float}:
            numbers = cast("list[float]", list(cells))
            return numbers if all(map(math.isfinite, numbers)) else None
        try:
            if self.decimal != "." or not _is_plain("".join(texts)):
                return None
            numbers = list(map(float, texts))
        except (TypeError, ValueError):  # a cell of a spreadsheet, or of no number
            return None
        return numbers if all(map(math.isfinite, numbers)) else None

    @property
    def example(self) -> str:
        """A number as it would be read."""
        return f"9{self.decimal}80665"


DECIMAL_POINT = Numbers()
_DECIMAL_COMMA = Numbers(",", ".")


_PLAIN = frozenset("0123456789.+-eE")


def _is_plain(cell: str) -> bool:
    """Whether a number is written as programs write it; raises no error for what is none."""
    return _PLAIN.issuperset(cell)


def _joined(row: Sequence[Cell]) -> str:
    """Return the texts of a row as one."""
    texts = cast("Sequence[str]", row)
    try:
        return "".join(texts)
    except TypeError:  # a cell of a spreadsheet, or an empty one
        return "".join([cell for cell in row if isinstance(cell, str)])


def _shows_another(cell: str, seen: Container[str]) -> bool:
    """Whether a cell may show another sign before decimals than those that were seen."""
    return ("." in cell and "." not in seen) or ("," in cell and "," not in seen)


def _decimal_of(cell: str) -> str:
    """Return the decimal sign that a number shows, or nothing where it could be either or has none."""
    points, commas = cell.count("."), cell.count(",")
    if points and commas:
        return "," if cell.rfind(",") > cell.rfind(".") else "."
    sign = "," if commas else "."
    if points + commas > 1:  # of a date there are groups of other lengths
        groups = re.split(r"[.,]", cell.translate(_SPACES).lstrip("+-−"))
        is_thousands = 1 <= len(groups[0]) <= 3 and all(len(group) == 3 for group in groups[1:])
        return ("." if commas else ",") if is_thousands else ""
    if not points + commas:
        return ""
    whole, _, rest = cell.translate(_SPACES).lstrip("+-−").partition(sign)
    may_be_thousands = len(rest) == 3 and 1 <= len(whole) <= 3 and not whole.startswith("0")
    return "" if may_be_thousands else sign


def stamps_of(grid: Grid, name: str, cells: list[Cell], or_else: str = "") -> list[datetime]:
    """The stamps in a column: ISO 8601, or local with day or month first, whichever all of them allow.

    Raises InputError for a cell that is none; or_else: what else to do then.
    """
    month_first = month_comes_first([cell for cell in cells if isinstance(cell, str)])
    wanted = "write a stamp such as 2026-05-04T13:45:00+02:00 or 04.05.2026 13:45:00, or seconds"
    wanted += f", or {or_else}" if or_else else ""
    stamps = list[datetime]()
    for row, cell in enumerate(cells):
        try:
            stamps.append(cell if isinstance(cell, datetime) else stamp_of(str(cell or ""), month_first))
        except ValueError:
            raise grid.refuse(row, name, cell, wanted) from None
        if (stamps[row].tzinfo is None) != (stamps[0].tzinfo is None):
            raise grid.refuse(row, name, cell, "other stamps have a time zone or have none: write all in one way")
    return stamps


def month_comes_first(texts: Sequence[str]) -> bool:
    """Whether local stamps have the month before the day, by all of them."""
    parts = [found.groups() for text in texts if (found := _LOCAL.fullmatch(text))]
    return any(int(part[1]) > 12 for part in parts) or (
        any(part[7] for part in parts) and not any(int(part[0]) > 12 for part in parts if len(part[0]) <= 2)
    )


def stamp_of(text: str, month_first: bool) -> datetime:
    """The stamp that a text says; raises ValueError where it says none."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        match = _LOCAL.fullmatch(text.strip())
    if not match:
        raise ValueError
    first, second, third, hour, minute, second_s, fraction, half, zone = match.groups()
    year, month, day = (first, second, third) if len(first) == 4 else (third, second, first)
    if month_first and len(first) != 4:
        month, day = day, month
    hours = int(hour or 0) % 12 + 12 * (half.lower() == "pm") if half else int(hour or 0)
    offset = ""
    if zone:
        offset = f"+{_ZONES_H[zone]:02d}:00" if zone in _ZONES_H else f"{zone[:3]}:{zone[-2:]}"
    years = int(year) + 2000 * (len(year) <= 2)
    micro = f".{(fraction + '000000')[:6]}" if fraction else ""
    clock = f"{hours:02d}:{minute or '00'}:{second_s or '00'}{micro}{offset}"
    return datetime.fromisoformat(f"{years:04d}-{int(month):02d}-{int(day):02d}T{clock}")


def written(value: float) -> float:
    """A reading as it is written as text: digits below 1e-12 are those of rounding, and differ between processors."""
    return round(value, 12)
