"""What the readers of JSON and CSV lines share: rows, and counts of what was not used."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import BenchKeys
from kf_calib.bench.raw_input import CONVERTED, PLAIN, RESTATE, RawInput, merged_metadata
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.text.cells import LineError

_NAMED = 8
_NAME_LENGTH = 40


@contextmanager
def named(name: str) -> Iterator[None]:
    """Puts the name of what is read before the sentence that refuses it, where it is not there yet."""
    try:
        yield
    except InputError as error:
        if not str(error).startswith(f"{name}: "):
            error.args = (f"{name}: {error}",)
        raise


@dataclass
class LineCounts:
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
        line, reason = self.first_malformed or (0, "")
        names = ", ".join(f"{name!r} ({count})" for name, count in self.unknown.items())
        malformed = (f"{self.malformed} of {self.lines} {self.what} were malformed and skipped "
                     f"(first {self.what.removesuffix('s')} {line}: {reason}).")  # fmt: skip
        unknown = f"names that are not known were left out, with the values under them: {names}."
        return [malformed] * bool(self.malformed) + [unknown] * bool(names)

    def refusal(self, what: str, advice: str) -> InputError:
        """That what was read cannot be used, and what of it was not."""
        unused = "".join(f"; {sentence.rstrip('.')}" for sentence in self.sentences())
        return InputError(f"{what} in {self.lines} {self.what}{unused}: {advice}.")


def first_line(lines: Sequence[str]) -> int:
    """How many lines are blank before the first that is not."""
    return next((k for k, line in enumerate(lines) if line.lstrip("\ufeff").strip()), len(lines))


def is_json(first: str) -> bool:
    """Whether the first line that is not blank begins JSON lines, or one array of objects."""
    return re.match(r"\ufeff?\s*(\{|\[\s*(\{|$))", first) is not None


class Described:
    """What has been learnt of the bench from what it sent.

    metadata: of the bench, as strings. has_angles: poses are angles; pose_width: numbers of one, 0 until it is known.
    raw: what the readings are in, where that is settled, unit: by their names; empty where they name none, None where
    none has come yet. said: what was taken for what, where that is not plain.
    """

    has_angles = True
    pose_width = 0
    raw: RawInput | None = None
    unit: str | None = None

    def __init__(self, counts: LineCounts) -> None:
        self.metadata, self.said = dict[str, str](), list[str]()
        self._counts = counts

    def stated(self, name: str, overrides: BenchKeys, default: RawInput | None = None) -> dict[str, Any]:
        """The bench keys that what came, options and the names of the readings state; name: of the source, default: the
        raw input where neither what came nor options state one.

        Raises BenchError where they contradict each other, or no unit is stated.
        """
        by_name = {"accel_unit": self.unit} if self.unit else {}
        if self.raw is not None:
            by_name = {"accel_scale": self.raw.scale, "accel_unit": self.raw.unit}
        elif default is not None and default.sizes == PLAIN.sizes and self.unit:
            default = replace(default, unit=self.unit)  # a unit, which the names state anew
        with named(name):
            stated = merged_metadata(self.metadata, overrides, "the first line", default)
            now = RawInput.from_metadata(stated)
            if CONVERTED in stated:
                raise BenchError(f"lines hold what the device sends: leave out {CONVERTED} in the bench's keys.")
            if self.unit not in (None, "", now.unit) and "accel_unit" in stated and RESTATE not in overrides:
                raise BenchError(
                    f"the readings are in {self.unit} by their names, and stated is {now.unit_words}: rename them by "
                    "--column, or where their names are wrong, give --accel-unit and --restate-input."
                )
            if self.unit == "" and not {"accel_unit", "accel_scale"} & set(stated):
                raise BenchError(
                    "the names of the readings do not tell their unit: name them accel_mps2 (or accel_g ...), or give "
                    "it by --accel-unit, and the size of counts by --accel-scale."
                )
        return stated | by_name if self.raw is not None else by_name | stated

    def bench(self, name: str, overrides: BenchKeys, default: RawInput | None = None) -> Bench:
        """The bench, once a pose has been read; arguments as of ``stated``. Raises InputError where it cannot be that
        one."""
        stated = self.stated(name, overrides, default)
        with named(name):
            bench = Bench.from_metadata(stated, self.has_angles)
            if bench.pose_width != self.pose_width:
                raise InputError(
                    f"poses have {self.pose_width} angles and the bench has {bench.pose_width} axes: state as many "
                    'axes as there are angles, outer first, for example --axes "y z x".'
                )
            return bench


SampleRow = tuple[int, list[float] | None, list[float] | None, list[float] | None]
"""The stamp of a line, ns, its readings, its pose and its temperature, degC; None or empty: not measured."""


class LineReader(Described, ABC):
    """Reads lines block by block; those that cannot be used are counted.

    Readings are in batches as they stand in the lines. advice: how quantities have to be named. wants_pose: whether
    orientations count.
    """

    advice: ClassVar[str]
    wants_pose = True

    @abstractmethod
    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        """A line that was read and holds readings, with these in their place; all else in it stays as it is."""

    def heading_of_forces(self, heading: Sequence[str]) -> list[str]:
        """The heading of lines in which specific force stands in the place of readings."""
        return list(heading)

    def read(self, lines: Sequence[str], first_line: int) -> Batch:
        """The batch of consecutive lines, the first of them of that number."""
        rows = [row for _, row in self.rows(lines, first_line) if row]
        return Batch(_stream(rows, 1, 3), _stream(rows, 2, self.pose_width), _stream(rows, 3, 1))

    def rows(self, lines: Sequence[str], first_line: int) -> Iterator[tuple[int, SampleRow | None]]:
        """The number of each line that can be used, and what it holds; None where that is no sample."""
        for number, line in enumerate(lines, start=first_line):
            try:
                yield number, self._row(line) if line and not line.isspace() else None
            except LineError as error:
                self._counts.refuse(number, str(error))

    @abstractmethod
    def _row(self, line: str) -> SampleRow | None:
        """What one line holds; None where that is no sample. Raises LineError where it cannot be used."""


def _stream(rows: Sequence[SampleRow], at: int, width: int) -> Stream:
    """Return the stream of one quantity in rows."""
    filled = [row for row in rows if row[at]]
    if not filled:
        return Stream.empty(width)
    return Stream(np.array([row[0] for row in filled], np.int64), np.array([row[at] for row in filled], float))
