"""Batches from CSV lines (FORMAT.md): a header that names quantity and unit, then rows; an empty cell: not measured."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from kf_calib.errors import InputError
from kf_calib.samples import Batch, Floats, Stream, Times
from kf_calib.sources.line_account import ACCEL_UNITS, TIME_DECIMALS, Account, LineError, stamp_ns

_ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
_USUAL_GIMBALS = ("outer", "middle", "inner")
_TEMPERATURE = "temperature_c"
_EXAMPLE = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"


@dataclass(frozen=True)
class _Columns:
    """Where a quantity stands in a row, and the factors that bring it to our units."""

    at: tuple[int, ...]
    factors: tuple[float, ...]


class CsvLines:
    """Reads the rows under one header, block by block.

    ``columns`` renames foreign columns. Poses are gimbal angles (``has_angles``), or the quaternion qx qy qz qw.
    Raises InputError where the header does not say what is needed.
    """

    def __init__(self, header: str, columns: Mapping[str, str], account: Account) -> None:
        self.metadata: dict[str, str] = {}
        self._account = account
        self._delimiter = max(",;\t", key=header.count)
        self._names = [columns.get(name, name.lower()) for name in _cells(header, self._delimiter)]
        repeated = next((name for name in self._names if name and self._names.count(name) > 1), None)
        if repeated:
            raise InputError(f"two columns are named {repeated!r}: rename or remove one of them.")
        self._time, self._decimals = self._time_column()
        self._accel = self._accel_columns()
        gimbals = self._gimbal_columns()
        self.has_angles = bool(gimbals.at)
        self._pose = gimbals if self.has_angles else self._quaternion_columns()
        self.pose_width = len(self._pose.at)
        self._temperature = self._found([_TEMPERATURE])
        used = {self._time, *self._accel.at, *self._pose.at, *self._temperature.at}
        self._account.leave_out(name for i, name in enumerate(self._names) if i not in used)

    @property
    def advice(self) -> str:
        """How columns have to be named."""
        return f"a header such as {_EXAMPLE} is wanted"

    def read(self, lines: Sequence[str], first_line: int) -> Batch:
        """The batch of consecutive lines, the first of them of that number."""
        rows, numbers = list[list[str]](), list[int]()
        for number, line in enumerate(lines, start=first_line):
            if not line or line.isspace():
                continue
            plain = '"' not in line and " " not in line
            row = line.split(self._delimiter) if plain else _cells(line, self._delimiter)
            if len(row) == len(self._names):
                rows.append(row)
                numbers.append(number)
            else:
                self._account.refuse(number, f"it has {len(row)} cells, the header has {len(self._names)}")
        try:
            return self._batch(rows)
        except (ValueError, ArithmeticError):
            return self._batch(self._usable(rows, numbers))

    def _batch(self, rows: list[list[str]]) -> Batch:
        """The batch of rows that are all well formed. Raises ValueError or ArithmeticError where one is not."""
        if not rows:
            return Batch(Stream.empty(3), Stream.empty(self.pose_width))
        columns = list(zip(*rows, strict=True))
        stamps = _stamps(columns[self._time], self._decimals)
        accel, pose, temperature = (
            _stream(stamps, columns, wanted) for wanted in (self._accel, self._pose, self._temperature)
        )
        if not self.has_angles and not pose.values.any(axis=1).all():
            raise LineError("the quaternion is zero")
        return Batch(accel, pose, temperature if self._temperature.at else Stream.empty(1))

    def _usable(self, rows: list[list[str]], numbers: list[int]) -> list[list[str]]:
        """The rows without those that cannot be used, found by halving."""
        try:
            self._batch(rows)
            return rows
        except (ValueError, ArithmeticError) as error:
            if len(rows) == 1:
                reason = str(error) if isinstance(error, LineError) else "a cell is not a number"
                self._account.refuse(numbers[0], reason)
                return []
        half = len(rows) // 2
        return self._usable(rows[:half], numbers[:half]) + self._usable(rows[half:], numbers[half:])

    def _time_column(self) -> tuple[int, int]:
        for name, decimals in TIME_DECIMALS.items():
            if name in self._names:
                return self._names.index(name), decimals
        raise InputError(f"no column gives the time: name it time_s or time_ns; {self.advice}, not {self._seen}.")

    def _accel_columns(self) -> _Columns:
        choices = [[(f"a{axis}_{unit}", factor) for unit, factor in ACCEL_UNITS.items()] for axis in "xyz"]
        found = [next(((name, factor) for name, factor in units if name in self._names), None) for units in choices]
        named = [entry for entry in found if entry]
        if len(named) < 3:
            raise InputError(
                "no columns give the three readings with their unit: name them ax_mps2, ay_mps2, az_mps2 "
                f"(or ax_g, ax_mg ...), not {self._seen}."
            )
        return self._found([name for name, _ in named], [factor for _, factor in named])

    def _gimbal_columns(self) -> _Columns:
        """Angles by the usual names, else every column in deg or rad in the order of the header."""
        matches = [re.fullmatch(r"(.+)_(deg|rad)", name) for name in self._names]
        angles = {match[1]: match for match in matches if match}
        chosen = [angles[name] for name in _USUAL_GIMBALS if name in angles] or list(angles.values())
        return self._found([match[0] for match in chosen], [_ANGLE_UNITS[match[2]] for match in chosen])

    def _quaternion_columns(self) -> _Columns:
        names = ["qx", "qy", "qz", "qw"]
        if not set(names) <= set(self._names):
            raise InputError(
                "no columns give the platform's angles with their unit: name them outer_deg, inner_deg ... or "
                f"outer_rad ..., outer gimbal first (or the attitude qx, qy, qz, qw), not {self._seen}."
            )
        return self._found(names)

    def _found(self, names: Sequence[str], factors: Sequence[float] | None = None) -> _Columns:
        factors = factors or [1.0] * len(names)
        pairs = [(self._names.index(n), factor) for n, factor in zip(names, factors, strict=True) if n in self._names]
        return _Columns(tuple(at for at, _ in pairs), tuple(factor for _, factor in pairs))

    @property
    def _seen(self) -> str:
        shown = ",".join(self._names[:12])
        return repr(shown if len(shown) <= 120 else shown[:120] + "...")


def _cells(line: str, delimiter: str) -> list[str]:
    """The cells of one line without blanks and quotes around them; a quote left open ends with the line."""
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:  # a cell beyond csv's own limit
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def _stamps(cells: Iterable[str], decimals: int) -> Times:
    return np.array([stamp_ns(Decimal(cell), decimals) for cell in cells], np.int64)


def _stream(stamps: Times, columns: Sequence[tuple[str, ...]], wanted: _Columns) -> Stream:
    """The stamped values of the ``wanted`` columns where they are measured: all of them or none, and finite."""
    cells = [columns[at] for at in wanted.at]
    if not all(all(column) for column in cells):
        measured = _measured(cells)
        stamps, cells = stamps[measured], [tuple(compress(column, measured)) for column in cells]
    values = np.empty((len(stamps), len(cells)))
    for i, column in enumerate(cells):
        values[:, i] = list(map(float, column))
    if not np.isfinite(values).all():
        raise LineError("a number is not finite")
    return Stream(stamps, _scaled(values, wanted.factors))


def _measured(cells: Sequence[tuple[str, ...]]) -> NDArray[np.bool_]:
    """Which rows (n,) have all the cells. Raises LineError where a row has some and not others."""
    filled = np.array([[bool(cell) for cell in column] for column in cells])
    complete = np.all(filled, axis=0)
    if np.any(filled[:, ~complete]):
        raise LineError("some components of a vector are missing")
    return complete


def _scaled(values: Floats, factors: Sequence[float]) -> Floats:
    return values if set(factors) == {1.0} else values * np.array(factors)
