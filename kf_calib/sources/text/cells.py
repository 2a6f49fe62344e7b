"""What stands in the cells of a text, as programs and spreadsheets of different countries write it: numbers, quantities
made of them, and when a row was measured."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from operator import mul

from kf_calib.sources.text.names import VOCABULARY
from kf_calib.support.text import cut, number_from

CsvRow = Sequence[str]

_NUMBER = re.compile(r"[+\-−]?[\d.,'’ \u00a0\u202f]*\d[\d.,]*(?:[eE][+\-]?\d+)?")
_PLAIN = str.maketrans("−", "-", "'’ \u00a0\u202f")
_LOCAL = re.compile(
    r"(\d{1,4})[./-](\d{1,2})[./-](\d{1,4})[,T ]*\s*(?:(\d{1,2})[:.](\d{2})(?:[:.](\d{2})(?:[.,:](\d+))?)?)?"
    r"\s*([AaPp][Mm])?\s*(Z|UTC|GMT|CET|MEZ|CEST|MESZ|[+-]\d{2}:?\d{2})?"
)
_CLOCK = re.compile(r"(?:(\d+) days? )?(?:(\d{1,3}):)?(\d{1,2}):(\d{2})(?:[.,:](\d{1,6})\d*)?")
_MONTH = re.compile(r"(?<=\d)[-/. ]+([^\W\d]{3})[^\W\d]*[-/. ,]+(?=\d)")
_MONTHS = {name: k for k, names in enumerate(VOCABULARY["months"], 1) for name in names.split()}
_ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}
_FIRST = datetime(1970, 1, 1, tzinfo=UTC)


class LineError(ValueError):
    """A line cannot be used; the message is the reason in a few words."""


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

    def exact(self, cell: str) -> Decimal:
        """The number in a cell with all its digits; raises ValueError or ArithmeticError where there is none."""
        try:
            return Decimal(cell.replace(self.thousands, "x").replace(self.decimal, "."))
        except ArithmeticError:  # not as programs write it
            return Decimal(self._plain(cell))

    def value(self, cell: str) -> float:
        """The number in a cell, which need not be finite; NaN where there is none."""
        try:
            return number_of(self._plain(cell))
        except ValueError:
            return math.nan

    def values(self, cells: Sequence[str]) -> list[float]:
        """The numbers in cells, as by ``value``; at once where all are as programs write them."""
        try:
            if self.decimal == ".":
                return list(map(number_of, cells))
            if "." not in "".join(cells):
                return [number_of(cell.replace(self.decimal, ".")) for cell in cells]
        except ValueError:
            pass
        return list(map(self.value, cells))

    def _plain(self, cell: str) -> str:
        """Return a number as programs write it, without separators of thousands and blanks; raises ValueError where
        these separate other groups of digits."""
        whole, point, rest = cell.translate(_PLAIN).partition(self.decimal)
        if self.thousands in whole:
            if not re.fullmatch(rf"[+-]?\d{{1,3}}(?:\{self.thousands}\d{{3}})+", whole):
                raise ValueError
            whole = whole.replace(self.thousands, "")
        if self.thousands in rest:
            raise ValueError
        return f"{whole}.{rest}" if point else whole


DECIMAL_POINT = Numbers()
_DECIMAL_COMMA = Numbers(",", ".")


def _decimal_of(cell: str) -> str:
    """Return the decimal sign that a number shows, or nothing where it could be either or has none."""
    if "." in cell and "," in cell:
        return "," if cell.rfind(",") > cell.rfind(".") else "."
    sign, other = (",", ".") if "," in cell else (".", ",")
    whole, *groups = cell.translate(_PLAIN).lstrip("+-").split(sign)
    are_thousands = 1 <= len(whole) <= 3 and all(len(group) == 3 for group in groups)
    if len(groups) > 1:  # of a date there are groups of other lengths
        return other if are_thousands else ""
    return "" if not groups or (are_thousands and not whole.startswith("0")) else sign


@dataclass(frozen=True)
class QuantityColumns:
    """Where a quantity stands in a row, the factors that bring it to our units, none where it is in them, and texts
    that stand for no value."""

    at: tuple[int, ...] = ()
    factors: tuple[float, ...] = ()
    absent: frozenset[str] = frozenset()

    def values(self, row: CsvRow, header: Sequence[str], numbers: Numbers) -> list[float] | None:
        """The quantity, None where it is not measured. Raises LineError where it cannot be used."""
        cells = [row[at] for at in self.at]
        if not any(cells):
            return None
        if not all(cells):
            raise LineError("some components of a vector are missing")
        values = numbers.values(cells)
        if not math.isfinite(sum(values)):  # which numbers beyond 1e308 together are not, either
            if cells[0].lower() in self.absent:
                return None
            for at, cell, value in zip(self.at, cells, values, strict=True):
                if not math.isfinite(value):
                    raise LineError(f"column {cut(header[at], 40)!r} is {cut(cell, 40)!r}, which is no number")
        return list(map(mul, values, self.factors)) if self.factors else values


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


@dataclass(frozen=True)
class Stamps:
    """How a row's time is written: a number of a unit, or the stamp of a calendar, in one column or in several.

    units_ns: nanoseconds in the unit of each of the last columns; stamps of a calendar have none, to which these are
    added. month_first: how stamps of a calendar are written; has_zone: whether they name their time zone. rate_hz: of
    the rows, which have no time then.
    """

    at: tuple[int, ...]
    units_ns: tuple[int, ...]
    month_first: bool = False
    has_zone: bool = False
    rate_hz: float | None = None

    @classmethod
    def of_dates(cls, at: Sequence[int], texts: Sequence[str]) -> Stamps:
        """How the stamps of a calendar in columns ``at`` are written; raises ValueError where the first is none."""
        month_first = _month_comes_first(texts)
        has_zone = bool(texts) and _stamp_of(texts[0], month_first).tzinfo is not None
        return cls(tuple(at), (), month_first, has_zone)

    def ns(self, row: Sequence[str], header: Sequence[str], numbers: Numbers, number: int = 0) -> int:
        """The stamp of a row in nanoseconds; number: of the row, from 0. Raises LineError where it has none."""
        if self.rate_hz is not None:
            return round(number * 1e9 / self.rate_hz)
        dated = self.at[: len(self.at) - len(self.units_ns)]
        cell = " ".join([row[at] for at in dated or self.at])
        try:
            counted = zip(self.at[len(dated) :], self.units_ns, strict=True)
            since_ns = sum([stamp_ns(numbers.exact(row[at]), unit) for at, unit in counted])
            if not dated:
                return since_ns
            stamp, why = _stamp_of(cell, self.month_first), "whose time zone other stamps do not have"
            if (stamp.tzinfo is not None) is self.has_zone:
                since = (stamp if self.has_zone else stamp.replace(tzinfo=UTC)) - _FIRST
                return stamp_ns(since // timedelta(microseconds=1), 1000) + since_ns
        except LineError:
            raise
        except (ValueError, ArithmeticError):
            why = "which is no time"
        raise LineError(f"column {cut(header[self.at[0]], 40)!r} is {cut(cell, 40)!r}, {why}") from None


def stamp_ns(number: int | Decimal, unit_ns: int) -> int:
    """A stamp in whole nanoseconds from one in a unit of so many, exactly; halves go to the even one."""
    is_sound = isinstance(number, int) or (number.is_finite() and abs(number.adjusted()) <= 20)
    nanoseconds = round(number * unit_ns) if is_sound else 2**63  # before an exponent is written out in full
    if not -(2**63) <= nanoseconds < 2**63:
        raise LineError("the time stamp is out of range")
    return nanoseconds


def are_stamps(texts: Sequence[str]) -> bool:
    """Whether texts, of which there are any, are all stamps of a calendar."""
    month_first = _month_comes_first(texts)
    try:
        return bool(texts) and all(_stamp_of(text, month_first) for text in texts)
    except ValueError:
        return False


def _month_comes_first(texts: Sequence[str]) -> bool:
    """Return whether local stamps have the month before the day, by all of them."""
    parts = [found.groups() for text in texts if (found := _LOCAL.fullmatch(text))]
    return any(int(part[1]) > 12 for part in parts) or (
        any(part[7] for part in parts) and not any(int(part[0]) > 12 for part in parts if len(part[0]) <= 2)
    )


def _stamp_of(text: str, month_first: bool) -> datetime:
    """Return the stamp that a text says, one of a clock alone since 1970; raises ValueError where it says none."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        match = _LOCAL.fullmatch(_MONTH.sub(_numbered, text.strip()))
    if clock := _CLOCK.fullmatch(text.strip()):
        days, *times, fraction = clock.groups("")
        if not times[0] and not fraction:
            times = [*times[1:], ""]  # hours and minutes
        hours, minutes, seconds = (int(each or 0) for each in times)
        return datetime(1970, 1, 1) + timedelta(int(days or 0), seconds, int(f"{fraction:0<6}"), 0, minutes, hours)
    if not match:
        raise ValueError
    first, second, third, hour, minute, second_s, fraction, half, zone = match.groups("")
    if len(first) == 4:
        year, month, day = first, second, third
    else:
        year, month, day = (third, first, second) if month_first else (third, second, first)
    hours = int(hour or 0) % 12 + 12 * (half.lower() == "pm") if half else int(hour or 0)
    offset = f"+{_ZONES_H[zone]:02d}:00" if zone in _ZONES_H else f"{zone[:3]}:{zone[-2:]}" if zone else ""
    date = f"{int(year) + 2000 * (len(year) <= 2):04d}-{int(month):02d}-{int(day):02d}"
    clock = f"{hours:02d}:{minute or '00'}:{second_s or '00'}.{(fraction + '000000')[:6]}"
    return datetime.fromisoformat(f"{date}T{clock}{offset}")


def _numbered(month: re.Match[str]) -> str:
    """Return the name of a month between day and year as its number."""
    number = _MONTHS.get(month[1].lower())
    return f"-{number}-" if number else month[0]
