"""What the readers of JSON and CSV lines share: units, exact stamps, rows, and an account of what was not used.

A CSV file begins with a heading: comments and titles, the names of the columns, perhaps their units.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import ClassVar, NamedTuple

import numpy as np

from kf_calib.bench.raw_input import RawInput
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.tables.grid import delimiter_of, with_commented_header
from kf_calib.sources.tables.words import is_unit
from kf_calib.support.text import number_from
from kf_calib.support.units import WORDS

ACCEL_UNITS = {unit: WORDS["m/s^2"][unit] for unit in ("mps2", "g", "mg")}
TIME_DECIMALS = {"time_ns": 0, "time_us": 3, "time_ms": 6, "time_s": 9}
"""Names of the stamp, and how many decimals its unit has in nanoseconds."""

_NAMED = 8
_NAME_LENGTH = 40


class LineError(ValueError):
    """A line cannot be used; the message is the reason in a few words."""


@dataclass
class Account:
    """Lines read, lines that could not be used (with the first of them), and names that mean nothing to us."""

    lines: int = 0
    malformed: int = 0
    first_malformed: tuple[int, str] | None = None
    unknown: Counter[str] = field(default_factory=Counter[str])
    what: str = "lines"

    def refuse(self, line: int, reason: str) -> None:
        self.malformed += 1
        if self.first_malformed is None or line < self.first_malformed[0]:
            self.first_malformed = (line, reason)

    def leave_out(self, names: Iterable[str]) -> None:
        """Counts values under unknown names; of the names, the first few are kept."""
        for name in names:
            short = name[:_NAME_LENGTH]
            self.unknown[short if short in self.unknown or len(self.unknown) < _NAMED else "others"] += 1

    def sentences(self) -> list[str]:
        sentences = list[str]()
        if self.first_malformed:
            line, reason = self.first_malformed
            sentences.append(
                f"{self.malformed} of {self.lines} {self.what} were malformed and skipped "
                f"(first {self.what.removesuffix('s')} {line}: {reason})."
            )
        if self.unknown:
            names = ", ".join(f"{name!r} ({count})" for name, count in dict(self.unknown).items())
            sentences.append(f"names that are not known were left out, with the values under them: {names}.")
        return sentences


class LineRows:
    """Stamped rows on their way to a stream."""

    def __init__(self) -> None:
        self._stamps = list[int]()
        self._values = list[list[float]]()

    def add(self, time_ns: int, values: list[float] | None) -> None:
        """Adds a row, unless there is nothing to add."""
        if values:
            self._stamps.append(time_ns)
            self._values.append(values)

    def stream(self, width: int) -> Stream:
        if not self._stamps:
            return Stream.empty(width)
        return Stream(np.array(self._stamps, np.int64), np.array(self._values, float))


class LineReader(ABC):
    """Reads lines block by block; those that cannot be used are put down in the account.

    Readings are in batches as they stand in the lines. ``raw``: what they are in, where that is settled, ``unit``: by
    their names; None where they name none (``is_bare``), or none has come yet. ``metadata``: of the bench, as strings.
    ``has_angles``: poses are angles; ``pose_width``: numbers of one. ``said``: what was taken for what, where that is
    not plain.
    """

    _faults: ClassVar[tuple[tuple[type[Exception], str], ...]]
    """What reading a line may raise beside LineError, and the reason to give."""

    def __init__(self, account: Account) -> None:
        self.metadata: dict[str, str] = {}
        self.has_angles = True
        self.pose_width = 0
        self.raw: RawInput | None = None
        self.unit: str | None = None
        self.is_bare = False
        self.said = list[str]()
        self._account = account

    @property
    @abstractmethod
    def advice(self) -> str:
        """How quantities have to be named."""

    @abstractmethod
    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        """A line that was read and holds readings, with these in their place; all else in it stays as it is."""

    def heading_of_forces(self, heading: Sequence[str]) -> list[str]:
        """The heading of lines in which specific force stands in the place of readings."""
        return list(heading)

    def read(self, lines: Sequence[str], first_line: int) -> Batch:
        """The batch of consecutive lines, the first of them of that number."""
        self._begin_block(lines)
        accel, pose, temperature = LineRows(), LineRows(), LineRows()
        faults = tuple(kind for kind, _ in self._faults)
        for number, line in enumerate(lines, start=first_line):
            if not line or line.isspace():
                continue
            try:
                self._read_line(line, accel, pose, temperature)
            except LineError as error:
                self._account.refuse(number, str(error))
            except faults as error:
                reason = next(reason for kind, reason in self._faults if isinstance(error, kind))
                self._account.refuse(number, reason)
        return Batch(accel.stream(3), pose.stream(self.pose_width), temperature.stream(1))

    def _begin_block(self, lines: Sequence[str]) -> None:  # noqa: B027 (not every reader has to look ahead)
        """Called with the lines before any of them is read."""

    @abstractmethod
    def _read_line(self, line: str, accel: LineRows, pose: LineRows, temperature: LineRows) -> None:
        """Adds what one line holds, all of it or nothing; raises LineError or one of ``_faults``."""


def number_of(text: str) -> float:
    """The number that a text says. Raises LineError where it is too small for one, as when two have run together:
    1.234e-01700001234567 is no zero."""
    value = number_from(text)
    if value == 0.0 and float(text.lower().partition("e")[0]):
        raise LineError("a number is out of range")
    return value


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


_FEWEST_CELLS = 3
"""Of a header; a line of fewer is a title, a date or a serial number."""
_ROWS = 1000  # that are looked at


class CsvHeading(NamedTuple):
    """The names of the columns, what is between cells, how many lines go before the first row, and the first rows."""

    header: Sequence[str]
    delimiter: str
    lines: int
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(cls, lines: Sequence[str]) -> CsvHeading:
        """The heading of lines from the beginning of a file or a stream, of which there is at least one."""
        lines = with_commented_header([lines[0].lstrip("\ufeff"), *lines[1:]])
        first = lines[0].strip()
        stated = first[-1] if first.lower().startswith("sep=") and len(first) == 5 else ""
        plain = [line for line in lines[bool(stated) : _ROWS] if line.strip() and not line.startswith("#")]
        delimiter = stated or delimiter_of(plain)
        at = next((k for k, line in enumerate(lines) if _is_header(line, delimiter)), None)
        if at is None:  # whatever it is, it is told by its first line
            at = next((k for k, line in enumerate(lines) if line.strip()), 0)
        header = cells_of(lines[at].lstrip("\ufeff"), delimiter)
        rows = [cells_of(line, delimiter) for line in lines[at + 1 : at + 1 + _ROWS]]
        if rows and _are_units(rows[0]):
            units, at = [*rows.pop(0), *[""] * len(header)], at + 1
            header = [f"{name} [{unit}]" if unit else name for name, unit in zip(header, units, strict=False)]
        while header and not header[-1]:  # a delimiter at the end of the line
            header.pop()
        return cls(header, delimiter, at + 1, [without_empty_end(row, len(header)) for row in rows])


def _is_header(line: str, delimiter: str) -> bool:
    text = line.lstrip("\ufeff").strip()
    if not text or text.startswith("#"):
        return False
    return sum(bool(cell) for cell in cells_of(text, delimiter)) >= _FEWEST_CELLS


def _are_units(cells: Sequence[str]) -> bool:
    has_letters = any(character.isalpha() for cell in cells for character in cell)
    return has_letters and all(not cell or is_unit(cell) for cell in cells)


def without_empty_end(row: list[str], count: int) -> list[str]:
    """A row without empty cells beyond so many, as of a delimiter at the end of the line."""
    return row[:count] if len(row) > count and not any(cell.strip() for cell in row[count:]) else row


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line without blanks and quotes around them; a quote left open ends with the line."""
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:  # a cell beyond csv's own limit
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


LONGEST_LINE_BYTES = 1 << 20


class Cutter:
    """Bytes as they come, cut into lines; a line that is too long is refused and left empty."""

    def __init__(self, account: Account) -> None:
        self._account, self._tail, self._cut = account, bytearray(), 0

    @property
    def is_amid(self) -> bool:
        """Whether the last line has not ended yet."""
        return bool(self._tail)

    def push(self, block: bytes) -> list[str]:
        """The lines that end in ``block``."""
        end, lines = block.rfind(b"\n") + 1, list[str]()
        if end:
            lines = self._decode(bytes(self._tail) + block[: end - 1])
            self._tail.clear()
        if len(self._tail) <= LONGEST_LINE_BYTES:  # else what comes up to the next end of line is not kept
            self._tail += block[end:]
        return lines

    def rest(self) -> list[str]:
        """The line without an end, if there is one."""
        block = bytes(self._tail)
        self._tail.clear()
        return self._decode(block) if block else []

    def _decode(self, block: bytes) -> list[str]:
        lines = block.replace(b"\r\n", b"\n").removesuffix(b"\r").split(b"\n")
        if len(block) > LONGEST_LINE_BYTES:
            for i, line in enumerate(lines):
                if len(line) > LONGEST_LINE_BYTES:
                    self._account.refuse(self._cut + i + 1, "it is longer than 1 MiB")
                    lines[i] = b""
        self._cut += len(lines)
        return b"\n".join(lines).decode("utf-8", errors="replace").split("\n")
