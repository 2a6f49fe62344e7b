"""Lines of CSV: a header that names quantity and unit, then rows; empty: not measured (docs/format.md)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from itertools import pairwise

import numpy as np

from kf_calib.errors import CountsError
from kf_calib.sources.text.cells import DECIMAL_POINT, LineError, written
from kf_calib.sources.text.columns import WANTED, Columns
from kf_calib.sources.text.heading import with_texts, without_empty_end
from kf_calib.sources.text.names import READINGS
from kf_calib.sources.text.reader import LineCounts, LineReader, SampleRow
from kf_calib.sources.text.units import celsius
from kf_calib.support.text import cut

_MINUTE_NS = 60 * 10**9
_BACK = {60 * _MINUTE_NS: "an hour, as at the end of summer time", 1440 * _MINUTE_NS: "a day, as clocks do at midnight"}
_FEWEST_ROWS, _MOST_UNITS, _APART = 20, 8, 5.0  # rows and labels of several sensors, and sigmas between these


class CsvLines(LineReader):
    """Reads the rows under one header, block by block.

    Poses are gimbal angles (``has_angles``), or the quaternion qx qy qz qw; angles: whether there must be any; None:
    where a column tells them.
    Raises InputError where the columns do not say what is needed.
    """

    advice = WANTED

    def __init__(self, columns: Columns, counts: LineCounts, angles: bool | None = True) -> None:
        super().__init__(counts)
        self._columns, self._heading, self._header = columns, columns.heading, columns.header
        self._time, self._accel = columns.time(), columns.accel()
        self._count, self._added_ns, self._last_ns = 0, 0, -(2**63)
        self.raw, self.said, self._numbers = columns.raw, columns.said, columns.numbers_in(columns.rows)
        self.has_angles = columns.orientation != "attitude"
        self.wants_pose = bool(columns.orientation) if angles is None else angles
        self._pose = columns.pose(needed=self.wants_pose)
        self.pose_width = len(self._pose.at)
        self._temperature, self._unit = columns.temperature()
        used = {*self._time.at, *self._accel.at, *self._pose.at, *self._temperature.at}
        used |= {columns.chosen[0]} if columns.chosen else set()
        _refuse_several_units(columns, used)
        columns_named = enumerate(zip(columns.names, columns.meanings, strict=True))
        unknown = [name for at, (name, own) in columns_named if name and at not in used and not own.other]
        self._counts.leave_out(unknown)  # not those of a gyroscope, say, which are of no use here

    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        values = zip(self._accel.at, readings_mps2, self._columns.written_mps2, strict=True)
        decimal = (self._numbers or DECIMAL_POINT).decimal
        texts = {at: repr(written(value / unit)).replace(".", decimal) for at, value, unit in values}
        return with_texts(line, self._heading.spans(line), texts)

    def heading_of_forces(self, heading: Sequence[str]) -> list[str]:
        names = {at: f"a{'xyz'[self._accel.at.index(at)]}_mps2" for at in self._columns.without_unit}
        lines, numbers = list(heading), self._heading.lines_of_names
        for k in numbers if names else ():
            cells = self._heading.cells(lines[k].lstrip("\ufeff"))
            if len(cells) >= len(self._header) and cells[self._accel.at[0]]:
                texts = names if k == numbers[0] else dict.fromkeys(names, "m/s^2")
                lines[k] = with_texts(lines[k], self._heading.spans(lines[k]), texts)
        return lines

    def rows(self, lines: Sequence[str], first_line: int) -> Iterator[tuple[int, SampleRow | None]]:
        if self._numbers is None:
            self._numbers = self._columns.numbers_in(list(map(self._heading.cells, lines)))
        return super().rows(lines, first_line)

    def _row(self, line: str) -> SampleRow | None:
        if not (cells := self._heading.cells(line)):
            if self._heading.has_objects:
                raise LineError("it is no whole object of JSON")
            return None  # of something else than readings
        number, self._count, width = self._count, self._count + 1, len(self._header)
        row = cells if len(cells) == width else without_empty_end(cells, width)
        if len(row) != width:
            raise LineError(f"it has {len(row)} cells, the header has {width}")
        if self._columns.chosen is not None and not self._columns.is_chosen(row):
            self._count -= 1
            return None
        numbers = self._numbers or DECIMAL_POINT
        time_ns = self._time.ns(row, self._header, numbers, number)
        if len(self._time.at) > len(self._time.units_ns):
            time_ns = self._of_even_clock(time_ns)
        readings = self._accel.values(row, self._header, numbers)
        angles = self._pose.values(row, self._header, numbers)
        degrees = self._temperature.values(row, self._header, numbers)
        if angles and not self.has_angles and not any(angles):
            raise LineError("the quaternion is zero")
        return time_ns, readings, angles, degrees and [celsius(degrees[0], self._unit)]

    def _of_even_clock(self, time_ns: int) -> int:
        """Return a stamp with what a calendar or a clock goes back by: an hour at the end of summer time, or a day."""
        time_ns += self._added_ns
        for back_ns, when in _BACK.items():
            if back_ns - _MINUTE_NS < self._last_ns - time_ns <= back_ns:
                self._added_ns += back_ns
                time_ns += back_ns
                self.said.append(f"its stamps go back by {when}: those after it count on")
        self._last_ns = max(self._last_ns, time_ns)
        return time_ns


def _refuse_several_units(columns: Columns, used: Container[int]) -> None:
    """Raise CountsError where a column that means nothing to us tells several sensors apart, whose rows take turns.

    used: columns that have a meaning. Labels are few, each has a tenth of the rows, they change in three of ten
    rows, and readings under different ones differ by more than their scatter lets them.
    """
    places = columns.places(*READINGS)
    if len(places) != 3 or len(columns.rows) < _FEWEST_ROWS:
        return
    values = columns.values(places)
    for at, name in enumerate(columns.names):
        labels = [row[at].strip() for row in columns.rows]
        shares, turns = Counter(labels), np.flatnonzero([one != other for one, other in pairwise(labels)])
        are_few = name and at not in used and 2 <= len(shares) <= _MOST_UNITS and max(map(len, shares)) <= 40
        if not are_few or "" in shares or min(shares.values()) < 0.1 * len(labels) or len(turns) < 0.3 * len(labels):
            continue
        first = min(shares)
        signs = np.array([1.0 if labels[k] == first else -1.0 for k in turns])
        steps = (values[turns + 1] - values[turns]) * signs[:, None]
        middle = np.nanmedian(steps, axis=0)  # between poses the readings leap
        spread = 1.86 * np.nanmedian(np.abs(steps - middle), axis=0) / math.sqrt(len(turns))
        if (np.abs(middle) > _APART * np.maximum(spread, 1e-300)).any():
            theirs = cut(columns.header[at], 40)
            example = f"{cut(name, 40)}={first}"
            raise CountsError(
                f"the rows are of several sensors, told apart by the column {theirs!r} "
                f"({', '.join(sorted(shares)[:4])}): choose one, for example by --where {example!r}, or leave the "
                f"column out if it means something else (--column {theirs + '=-'!r}).",
                {"where": example},
            )
