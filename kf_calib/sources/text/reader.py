"""What the readers of JSON and CSV lines share: rows, and an account of what was not used."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from kf_calib.bench.raw_input import RawInput
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text.numbers import LineError

_NAMED = 8
_NAME_LENGTH = 40


@contextmanager
def named(name: str) -> Iterator[None]:
    """Puts the name of what is read before the sentence that refuses it, where it is not there yet."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{name}: "):
            raise
        said = f"{name}: {error}"
        raise (CountsError(said, error.keys) if isinstance(error, CountsError) else type(error)(said)) from None


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

    _wrong: ClassVar[str]
    """The reason to give where reading a line raises a ValueError that tells none."""

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
        accel, pose, temperature = LineRows(), LineRows(), LineRows()
        for number, line in enumerate(lines, start=first_line):
            if not line or line.isspace():
                continue
            try:
                self._read_line(line, accel, pose, temperature)
            except LineError as error:
                self._account.refuse(number, str(error))
            except (ValueError, ArithmeticError, RecursionError) as error:
                reasons = {ArithmeticError: "a number is out of range", RecursionError: "it is nested too deeply"}
                known = (reason for kind, reason in reasons.items() if isinstance(error, kind))
                self._account.refuse(number, next(known, self._wrong))
        return Batch(accel.stream(3), pose.stream(self.pose_width), temperature.stream(1))

    @abstractmethod
    def _read_line(self, line: str, accel: LineRows, pose: LineRows, temperature: LineRows) -> None:
        """Adds what one line holds, all of it or nothing. Raises ValueError, ArithmeticError or RecursionError where it
        cannot be used, LineError with the reason."""
