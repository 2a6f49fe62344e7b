"""When the rows of a text were measured: numbers of a unit, or stamps of a calendar, in one column or in two."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal

from kf_calib.sources.text.numbers import LineError, Numbers
from kf_calib.support.text import cut

_LOCAL = re.compile(
    r"(\d{1,4})[./-](\d{1,2})[./-](\d{1,4})[,T ]*\s*(?:(\d{1,2})[:.](\d{2})(?:[:.](\d{2})(?:[.,](\d+))?)?)?"
    r"\s*([AaPp][Mm])?\s*(Z|UTC|GMT|CET|MEZ|CEST|MESZ|[+-]\d{2}:?\d{2})?"
)
_ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}
_FIRST = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class Stamps:
    """How a row's time is written: a number of a unit, or the stamp of a calendar, in one column or in two.

    decimals: of a unit in nanoseconds; factor: how many of it one is. is_date: whether it is a stamp; month_first: how
    it is written; has_zone: whether it names its time zone. rate_hz: of the rows, which have no time then.
    """

    at: tuple[int, ...]
    decimals: int = 9
    factor: int = 1
    is_date: bool = False
    month_first: bool = False
    has_zone: bool = False
    rate_hz: float | None = None

    @classmethod
    def of_dates(cls, at: Sequence[int], texts: Sequence[str]) -> Stamps:
        """How the stamps of a calendar in columns ``at`` are written; raises ValueError where the first is none."""
        month_first = _month_comes_first(texts)
        has_zone = bool(texts) and _stamp_of(texts[0], month_first).tzinfo is not None
        return cls(tuple(at), is_date=True, month_first=month_first, has_zone=has_zone)

    def ns(self, row: Sequence[str], header: Sequence[str], numbers: Numbers, number: int = 0) -> int:
        """The stamp of a row in nanoseconds; number: of the row, from 0. Raises LineError where it has none."""
        if self.rate_hz is not None:
            return round(number * 1e9 / self.rate_hz)
        cell = row[self.at[0]] if len(self.at) == 1 else " ".join(row[at] for at in self.at)
        try:
            if not self.is_date:
                return stamp_ns(self.factor * numbers.exact(cell), self.decimals)
            stamp, why = _stamp_of(cell, self.month_first), "whose time zone other stamps do not have"
            if (stamp.tzinfo is not None) is self.has_zone:
                since = (stamp if self.has_zone else stamp.replace(tzinfo=UTC)) - _FIRST
                return stamp_ns((since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000, 0)
        except LineError:
            raise
        except (ValueError, ArithmeticError):
            why = "which is no time"
        raise LineError(f"column {cut(header[self.at[0]], 40)!r} is {cut(cell, 40)!r}, {why}", self.at[0]) from None


def stamp_ns(number: int | Decimal, decimals: int) -> int:
    """A stamp in whole nanoseconds from one in a unit of 10^decimals ns, exactly; halves go to the even one."""
    if isinstance(number, Decimal):
        if not number.is_finite() or abs(number.adjusted()) > 20:  # before an exponent is written out in full
            raise LineError("the time stamp is out of range")
        nanoseconds = round(number.scaleb(decimals))
    else:
        nanoseconds = number * 10**decimals
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
    """Return the stamp that a text says; raises ValueError where it says none."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        match = _LOCAL.fullmatch(text.strip())
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
