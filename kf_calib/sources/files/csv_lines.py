"""Batches from CSV lines (docs/format.md): a header that names quantity and unit, then rows; empty: not measured."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from kf_calib.sources.files.csv_columns import CsvColumns
from kf_calib.sources.files.csv_heading import cells_of, without_empty_end
from kf_calib.sources.files.line_parts import Account, LineError, LineReader, LineRows
from kf_calib.sources.tables.numbers import DECIMAL_POINT

_FROM_UNIT = {"c": (1.0, 0.0), "k": (1.0, -273.15), "f": (1.0 / 1.8, -32.0 / 1.8)}


class CsvLines(LineReader):
    """Reads the rows under one header, block by block.

    Poses are gimbal angles (``has_angles``), or the quaternion qx qy qz qw; angles: whether there must be any.
    Raises InputError where the columns do not say what is needed.
    """

    _faults = ((ValueError, "a cell is not a number"), (ArithmeticError, "a cell is not a number"))

    def __init__(self, columns: CsvColumns, account: Account, angles: bool = True) -> None:
        super().__init__(account)
        self._columns, self._delimiter, self._header = columns, columns.delimiter, columns.header
        self._time, self._accel = columns.time(), columns.accel()
        self.raw = columns.raw
        self._numbers = columns.numbers
        attitude = columns.quaternion()
        self.has_angles = columns.has_usual_gimbals or not attitude.at
        self._pose = columns.gimbals(needed=angles) if self.has_angles else attitude
        if angles and not self._pose.at:
            raise columns.without_angles()
        self.pose_width = len(self._pose.at)
        self._temperature, unit = columns.temperature()
        self._warmth = _FROM_UNIT[unit]
        self.said = columns.said
        used = {*self._time.at, *self._accel.at, *self._pose.at, *self._temperature.at}
        self._account.leave_out(name for at, name in enumerate(columns.names) if at not in used)

    @property
    def advice(self) -> str:
        """How columns have to be named."""
        return self._columns.wanted

    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        is_quoted = '"' in line
        row = next(csv.reader([line], delimiter=self._delimiter)) if is_quoted else line.split(self._delimiter)
        decimal = (self._numbers or DECIMAL_POINT).decimal
        for at, factor, value in zip(self._accel.at, self._accel.factors, readings_mps2, strict=True):
            row[at] = repr(value / factor).replace(".", decimal)
        if not is_quoted:
            return self._delimiter.join(row)
        out = io.StringIO()
        csv.writer(out, delimiter=self._delimiter, lineterminator="").writerow(row)
        return out.getvalue()

    def _begin_block(self, lines: Sequence[str]) -> None:
        if self._numbers is None:
            self._numbers = self._columns.numbers_in([self._cells(line) for line in lines])

    def _cells(self, line: str) -> list[str]:
        is_plain = '"' not in line and " " not in line
        return line.split(self._delimiter) if is_plain else cells_of(line, self._delimiter)

    def _read_line(self, line: str, accel: LineRows, pose: LineRows, temperature: LineRows) -> None:
        row = without_empty_end(self._cells(line), len(self._header))
        if len(row) != len(self._header):
            raise LineError(f"it has {len(row)} cells, the header has {len(self._header)}")
        numbers = self._numbers or DECIMAL_POINT
        time_ns = self._time.ns(row, self._header, numbers)
        # everything on the line is understood before any of it is used
        readings, angles, degrees = (
            quantity.values(row, self._header, numbers) for quantity in (self._accel, self._pose, self._temperature)
        )
        if angles and not self.has_angles and not any(angles):
            raise LineError("the quaternion is zero")
        if degrees:
            degrees = [self._warmth[0] * degrees[0] + self._warmth[1]]
        accel.add(time_ns, readings)
        pose.add(time_ns, angles)
        temperature.add(time_ns, degrees)
