"""Dates: of stamps, and as text by ISO 8601. Where a text names no time zone, it is UTC."""

from __future__ import annotations

from datetime import UTC, datetime

_DAWN_S, _DUSK_S = 946_684_800, 4_102_444_800  # the years 2000 and 2100


def of_stamp(time_ns: int | None) -> datetime | None:
    """A stamp as a date in UTC; None for stamps that count from some start of a clock, as those of most boards do."""
    if time_ns is None or not _DAWN_S <= time_ns / 1e9 < _DUSK_S:
        return None
    return datetime.fromtimestamp(time_ns / 1e9, UTC)


def parse_date(text: str) -> datetime:
    """The date that a text says; raises ValueError if it says none."""
    date = datetime.fromisoformat(text)
    try:
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).astimezone(UTC)
    except OverflowError:  # the first and the last day that there is, in another time zone
        raise ValueError(f"{text} is no date in UTC") from None


def format_date(date: datetime) -> str:
    """A date as text that ``parse_date`` takes, to the millisecond."""
    return date.isoformat(timespec="milliseconds")
