"""Numbers in the cells of a text, as programs and spreadsheets of different countries write them."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from operator import mul

from kf_calib.support.text import cut, number_from

CsvRow = Sequence[str]

_NUMBER = re.compile(r"[+\-−]?[\d.,'’ \u00a0\u202f]*\d[\d.,]*(?:[eE][+\-]?\d+)?")
_SPACES = str.maketrans("", "", "'’ \u00a0\u202f")


class LineError(ValueError):
    """A line cannot be used; the message is the reason in a few words. at: the column for the sake of whose cell."""

    def __init__(self, reason: str, at: int = 0) -> None:
        super().__init__(reason)
        self.at = at


@dataclass(frozen=True)
class Numbers:
    """How the numbers of a text are written: the sign before decimals, and the one between thousands."""

    decimal: str = "."
    thousands: str = ","

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

    def exact(self, cell: str) -> Decimal:
        """The number in a cell with all its digits; raises ValueError or ArithmeticError where there is none."""
        try:
            return Decimal(self.with_point(cell))
        except (ValueError, ArithmeticError):
            return Decimal(self._plain(cell))

    def value(self, cell: str) -> float:
        """The number in a cell, which need not be finite. Raises ValueError where there is none, LineError for one that
        is too small."""
        try:
            return number_of(self.with_point(cell))
        except LineError:
            raise
        except ValueError:
            return number_of(self._plain(cell))

    def or_nan(self, cell: str) -> float:
        """The same, NaN where there is none."""
        try:
            return self.value(cell)
        except ValueError:
            return math.nan

    def values(self, cells: Sequence[str]) -> list[float]:
        """The numbers in cells; raises as ``value``."""
        try:
            if self.decimal == "." or "." not in "".join(cells):
                return [number_of(cell.replace(self.decimal, ".")) for cell in cells]
        except ValueError:  # not as programs write them
            pass
        return list(map(self.value, cells))

    def _plain(self, cell: str) -> str:
        """Return a number without separators of thousands and blanks, and with a point before its decimals."""
        whole, point, rest = cell.translate(_SPACES).replace("−", "-").partition(self.decimal)
        if self.thousands in whole:
            if not re.fullmatch(rf"[+-]?\d{{1,3}}(?:\{self.thousands}\d{{3}})+", whole):
                raise ValueError
            whole = whole.replace(self.thousands, "")
        if self.thousands in rest:
            raise ValueError
        return whole + "." * bool(point) + rest

    @property
    def example(self) -> str:
        """A number as it would be read."""
        return f"9{self.decimal}80665"


DECIMAL_POINT = Numbers()
_DECIMAL_COMMA = Numbers(",", ".")


def _decimal_of(cell: str) -> str:
    """Return the decimal sign that a number shows, or nothing where it could be either or has none."""
    if "." in cell and "," in cell:
        return "," if cell.rfind(",") > cell.rfind(".") else "."
    sign, other = (",", ".") if "," in cell else (".", ",")
    whole, *groups = cell.translate(_SPACES).lstrip("+-−").split(sign)
    are_thousands = 1 <= len(whole) <= 3 and all(len(group) == 3 for group in groups)
    if len(groups) > 1:  # of a date there are groups of other lengths
        return other if are_thousands else ""
    return "" if not groups or (are_thousands and not whole.startswith("0")) else sign


@dataclass(frozen=True)
class QuantityColumns:
    """Where a quantity stands in a row, the factors that bring it to our units, and texts that stand for no value."""

    at: tuple[int, ...] = ()
    factors: tuple[float, ...] = ()
    absent: Container[str] = ()

    def values(self, row: CsvRow, header: Sequence[str], numbers: Numbers) -> list[float] | None:
        """The quantity, None where it is not measured. Raises LineError where it cannot be used."""
        cells = [row[at] for at in self.at]
        if not all(cells):
            if any(cells):
                raise LineError("some components of a vector are missing", self.at[cells.index("")])
            return None
        try:
            values = numbers.values(cells)
        except ValueError:
            values = [math.nan]
        if not math.isfinite(sum(values)):  # which numbers beyond 1e308 together are not, either
            if cells[0].lower() in self.absent:
                return None
            for at, cell in zip(self.at, cells, strict=True):
                reason = f"column {cut(header[at], 40)!r} is {cut(cell, 40)!r}, which is no number"
                try:
                    is_number = math.isfinite(numbers.value(cell))
                except ValueError as error:
                    is_number, reason = False, str(error) if isinstance(error, LineError) else reason
                if not is_number:
                    raise LineError(reason, at)
        return list(map(mul, values, self.factors))


def number_of(text: str) -> float:
    """The number that a text says. Raises LineError where it is too small for one, as when two have run together:
    1.234e-01700001234567 is no zero."""
    value = number_from(text)
    if value == 0.0 and float(text.lower().partition("e")[0]):
        raise LineError("a number is out of range")
    return value


def written(value: float) -> float:
    """A reading as it is written as text: digits below 1e-12 are those of rounding, and differ between processors."""
    return round(value, 12)
