"""Lines of CSV: a header that names quantity and unit, then rows; empty: not measured (docs/format.md)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Sequence

import numpy as np

from kf_calib.bench.streams import Batch
from kf_calib.errors import CountsError
from kf_calib.sources.text.columns import READINGS, Columns
from kf_calib.sources.text.heading import BLANK, cells_of, with_texts, without_empty_end
from kf_calib.sources.text.numbers import DECIMAL_POINT, LineError, written
from kf_calib.sources.text.reader import Account, LineReader, LineRows
from kf_calib.sources.text.units import celsius
from kf_calib.support.text import cut

_MINUTE_NS, _HOUR_NS = 60 * 10**9, 3600 * 10**9
_FEWEST_ROWS, _MOST_UNITS, _APART = 20, 8, 5.0  # rows and labels of several sensors, and sigmas between these


class CsvLines(LineReader):
    """Reads the rows under one header, block by block.

    Poses are gimbal angles (``has_angles``), or the quaternion qx qy qz qw; angles: whether there must be any.
    Raises InputError where the columns do not say what is needed.
    """

    _wrong = "a cell is not a number"

    def __init__(self, columns: Columns, account: Account, angles: bool = True) -> None:
        super().__init__(account)
        self._columns, self._delimiter, self._header = columns, columns.heading.delimiter, columns.header
        self._time, self._accel = columns.time(), columns.accel()
        self._labels = columns.heading.labels
        self._row, self._added_ns, self._last_ns = -1, 0, -(2**63)
        self.raw = columns.raw
        self._numbers = columns.numbers
        self.has_angles = columns.orientation != "attitude"
        self._pose = columns.gimbals(needed=angles) if self.has_angles else columns.quaternion()
        if angles and not self._pose.at:
            raise columns.without_angles()
        self.pose_width = len(self._pose.at)
        self._temperature, self._unit = columns.temperature()
        self.said = columns.said
        used = {*self._time.at, *self._accel.at, *self._pose.at, *self._temperature.at}
        used |= {columns.chosen[0]} if columns.chosen else set()
        _refuse_several_units(columns, used)
        self._account.leave_out(columns.unknown(used))

    @property
    def advice(self) -> str:
        """How columns have to be named."""
        return self._columns.wanted

    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        decimal = (self._numbers or DECIMAL_POINT).decimal
        texts = [
            repr(written(value / unit)).replace(".", decimal)
            for value, unit in zip(readings_mps2, self._columns.written_mps2, strict=True)
        ]
        return with_texts(line, self._columns.heading.spans(line), dict(zip(self._accel.at, texts, strict=True)))

    def heading_of_forces(self, heading: Sequence[str]) -> list[str]:
        names = {at: f"a{'xyz'[self._accel.at.index(at)]}_mps2" for at in self._columns.without_unit}
        lines, numbers = list(heading), self._columns.heading.lines_of_names
        for k in numbers if names else ():
            cells = cells_of(lines[k].lstrip("\ufeff"), self._delimiter)
            if len(cells) >= len(self._header) and cells[self._accel.at[0]]:
                is_first = k == numbers[0]
                texts = names if is_first else dict.fromkeys(names, "m/s^2")
                lines[k] = with_texts(lines[k], self._columns.heading.spans(lines[k]), texts)
        return lines

    def _of_even_clock(self, time_ns: int) -> int:
        """Return a stamp of a calendar with the hour by which local clocks go back at the end of summer time."""
        time_ns += self._added_ns
        if _HOUR_NS - _MINUTE_NS < self._last_ns - time_ns <= _HOUR_NS:
            self._added_ns += _HOUR_NS
            time_ns += _HOUR_NS
            self.said.append("its stamps go back by an hour, as at the end of summer time: those after it count on")
        self._last_ns = max(self._last_ns, time_ns)
        return time_ns

    def read(self, lines: Sequence[str], first_line: int) -> Batch:
        if self._numbers is None:
            self._numbers = self._columns.numbers_in([self._cells(line) for line in lines])
        return super().read(lines, first_line)

    def _cells(self, line: str) -> list[str]:
        if self._labels is not None:
            return self._labels.values(line)
        if '"' not in line and " " not in line and self._delimiter != BLANK:
            return line.split(self._delimiter)
        return cells_of(line, self._delimiter)

    def _read_line(self, line: str, accel: LineRows, pose: LineRows, temperature: LineRows) -> None:
        if not (cells := self._cells(line)) and self._labels is not None:
            return  # of something else than readings
        self._row += 1
        row = without_empty_end(cells, len(self._header))
        if len(row) != len(self._header):
            raise LineError(f"it has {len(row)} cells, the header has {len(self._header)}")
        numbers = self._numbers or DECIMAL_POINT
        if self._columns.chosen is not None and not self._columns.is_chosen(row):
            self._row -= 1
            return
        time_ns = self._time.ns(row, self._header, numbers, self._row)
        if self._time.is_date:
            time_ns = self._of_even_clock(time_ns)
        # everything on the line is understood before any of it is used
        readings, angles, degrees = (
            quantity.values(row, self._header, numbers) for quantity in (self._accel, self._pose, self._temperature)
        )
        if angles and not self.has_angles and not any(angles):
            raise LineError("the quaternion is zero")
        if degrees:
            degrees = [celsius(degrees[0], self._unit)]
        accel.add(time_ns, readings)
        pose.add(time_ns, angles)
        temperature.add(time_ns, degrees)


def _refuse_several_units(columns: Columns, used: Container[int]) -> None:
    """Raise CountsError where a column that means nothing to us tells several sensors apart, whose rows take turns.

    used: columns that have a meaning. Labels are few, each has a tenth of the rows, they change in three of ten
    rows, and readings under different ones differ by more than their scatter lets them.
    """
    places = columns.places(*READINGS)
    if len(places) != 3 or len(columns.rows) < _FEWEST_ROWS:
        return
    for at, name in enumerate(columns.names):
        is_told = at in used or not name or (columns.chosen is not None and at == columns.chosen[0])
        labels = [] if is_told else [row[at].strip() for row in columns.rows]
        shares = Counter(labels)
        turns = [k for k in range(len(labels) - 1) if labels[k] != labels[k + 1]]
        if not 2 <= len(shares) <= _MOST_UNITS or min(shares.values()) < 0.1 * len(labels):
            continue
        if len(turns) < 0.3 * len(labels) or not all(label and len(label) <= 16 for label in shares):
            continue
        values, first = columns.values(places), min(shares)
        signs = np.array([1.0 if labels[k] == first else -1.0 for k in turns])
        steps = (values[np.array(turns) + 1] - values[turns]) * signs[:, None]
        middle = np.nanmedian(steps, axis=0)  # between poses the readings leap
        spread = 1.86 * np.nanmedian(np.abs(steps - middle), axis=0) / math.sqrt(len(turns))
        if not (np.abs(middle) > _APART * np.maximum(spread, 1e-300)).any():
            continue
        shown = ", ".join(sorted(shares)[:4])
        example = f"{cut(name, 40)}={first}"
        raise CountsError(
            f"the rows are of several sensors, told apart by the column {cut(columns.header[at], 40)!r} ({shown}): "
            f"choose one, for example by --where {example!r}, or leave the column out if it means something else "
            f"(--column {cut(columns.header[at], 40) + '=-'!r}).",
            {"where": example},
        )
