"""Text from files, links and arguments, made safe for a terminal.

Recordings, streams and file names may contain commands to the terminal, which change colours or the title or overwrite
lines. Characters that Python does not call printable are therefore written as their code, ``\x1b``.

Results as text and as HTML: what shows a result knows it, and the result does not know what shows it.

What shows them is loaded when the first is shown (``shown_by``), so that a result is printed alike whatever was
imported before.

Dates: of stamps, and as text by ISO 8601. Where a text names no time zone, it is UTC.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from functools import singledispatch

LONGEST = 1000
"""Characters of a message, at most."""
SHOWN = 6
"""Things of one kind that a sentence names, at most."""
COMMANDS = r"\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069"
"""Control characters, but for line ends and tabs, and what turns the direction of writing: for a regular expression."""
CONTROLS = COMMANDS.replace(r"\x00-\x08\x0b-\x1f", r"\x00-\x1f")
"""The same, and line ends and tabs: what no text of one line has."""
_END = 300  # of a message that is cut: its last words say what to do


def number_from(text: str) -> float:
    """The number that a text is, as instruments and people write it. Raises ValueError: Python would take ``0_1.5``,
    too, and digits of other scripts."""
    if "_" in text or not text.isascii():
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def printable(text: str) -> str:
    """The text with all but its line ends printable."""
    if text.isprintable():
        return text
    return "".join(
        each if each.isprintable() or each == "\n" else each.encode("unicode_escape").decode() for each in text
    )


def sentence(text: str) -> str:
    """The text on one printable line of at most ``LONGEST`` characters; what is too long loses its middle."""
    line = printable(cut(text, LONGEST)).replace("\n", "\\n")
    return cut(line, LONGEST)


def cut(text: str, longest: int) -> str:
    """The text, without what is too much in its middle."""
    if len(text) <= longest:
        return text
    end = min(_END, longest // 3)
    return f"{text[: longest - end - 3]} … {text[-end:]}"


_loaders = list[Callable[[], object]]()


def angles_in_words(degrees: Iterable[float]) -> str:
    """Gimbal angles in deg, outer first, to a hundredth of a degree."""
    return f"{', '.join(f'{round(float(angle), 2) + 0.0:g}' for angle in degrees)} deg"


def counted(count: int, what: str) -> str:
    """So many of something: 1 gap, 2 gaps."""
    return f"{count} {what}{'s' * (count != 1)}"


def listing(words: Iterable[str]) -> str:
    """Some words as ``a``, ``a and b`` or ``a, b and c``; "" of none."""
    *first, last = [*words] or [""]
    return f"{', '.join(first)} and {last}" if first else last


def shown_by(load: Callable[[], object]) -> None:
    """Have ``load`` called before the first result is shown: it imports the modules that register how."""
    _loaders.append(load)


@singledispatch
def printed(value: object) -> str:
    """The value as plain text; ``views`` register how for each kind of result."""
    return printed(value) if _have_loaded() else repr(value)


@singledispatch
def as_html(value: object) -> str | None:
    """The value as HTML for a notebook; ``views`` register how for each kind of result. None: it is shown as text."""
    return as_html(value) if _have_loaded() else None


def _have_loaded() -> bool:
    """Load what shows results, and tell whether anything was left to be loaded."""
    waiting = [_loaders.pop() for _ in list(_loaders)]
    for load in waiting:
        load()
    return bool(waiting)


_DAWN_S, _DUSK_S = 946_684_800, 4_102_444_800  # the years 2000 and 2100


def date_of_stamp(time_ns: int | None) -> datetime | None:
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
