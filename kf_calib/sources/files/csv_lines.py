"""Batches from CSV lines (docs/format.md): a header that names quantity and unit, then rows; empty: not measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
        decimal = (self._numbers or DECIMAL_POINT).decimal
        texts = [
            repr(value / unit).replace(".", decimal)
            for value, unit in zip(readings_mps2, self._columns.written_mps2, strict=True)
        ]
        return self._replaced(line, dict(zip(self._accel.at, texts, strict=True)))

    def heading_of_forces(self, heading: Sequence[str]) -> list[str]:
        names = {at: f"a{'xyz'[self._accel.at.index(at)]}_mps2" for at in self._columns.without_unit}
        lines, is_named = list(heading), False
        for k, line in enumerate(heading):
            cells = cells_of(line.lstrip("\ufeff"), self._delimiter)
            if not names or len(cells) < len(self._header) or not cells[self._accel.at[0]]:
                continue
            lines[k] = self._replaced(line, dict.fromkeys(names, "m/s^2") if is_named else names)
            is_named = True
        return lines

    def _replaced(self, line: str, texts: Mapping[int, str]) -> str:
        """A line with other texts in these cells, and all else as it stands."""
        spans = cell_spans(line, self._delimiter)
        for at in sorted(texts, reverse=True):
            start, end = spans[at]
            line = line[:start] + texts[at] + line[end:]
        return line

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


def cell_spans(line: str, delimiter: str) -> list[tuple[int, int]]:
    """Where the cells of a line stand, with their quotes and without blanks around them."""
    spans, at = list[tuple[int, int]](), 0
    while True:
        end = _quote_end(line, at) if line[at : at + 1] == '"' else at
        end = line.find(delimiter, end)
        end = len(line) if end < 0 else end
        cell = line[at:end]
        spans.append((at + len(cell) - len(cell.lstrip()), end - len(cell) + len(cell.rstrip())))
        if end == len(line):
            return spans
        at = end + 1


def _quote_end(line: str, at: int) -> int:
    """The place behind the quote that ends what the one at ``at`` begins; the end of the line where none does."""
    while (at := line.find('"', at + 1)) >= 0:
        if line[at + 1 : at + 2] != '"':
            return at + 1
        at += 1
    return len(line)
