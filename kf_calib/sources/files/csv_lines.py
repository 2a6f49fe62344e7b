"""Batches from CSV lines (docs/format.md): a header that names quantity and unit, then rows; empty: not measured."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from operator import mul

from kf_calib.errors import InputError
from kf_calib.sources.files.line_parts import (
    ACCEL_UNITS,
    ANGLE_UNITS,
    TIME_DECIMALS,
    Account,
    LineError,
    LineReader,
    LineRows,
    number_of,
    stamp_ns,
)

_USUAL_GIMBALS = ("outer", "middle", "inner")
_TEMPERATURE = "temperature_c"
_EXAMPLE = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"


@dataclass(frozen=True)
class _Columns:
    """Where a quantity stands in a row, and the factors that bring it to our units."""

    at: tuple[int, ...]
    factors: tuple[float, ...]

    def values(self, row: Sequence[str]) -> list[float] | None:
        """The quantity, None where it is not measured. Raises ValueError where it cannot be used."""
        cells = [row[at] for at in self.at]
        if not all(cells):
            if any(cells):
                raise LineError("some components of a vector are missing")
            return None
        values = list(map(number_of, cells))
        if not math.isfinite(sum(values)):
            raise LineError("a number is not finite")
        return list(map(mul, values, self.factors))


class CsvLines(LineReader):
    """Reads the rows under one header, block by block.

    ``columns`` renames foreign columns. Poses are gimbal angles (``has_angles``), or the quaternion qx qy qz qw;
    angles: whether there must be any.
    Raises InputError where the header does not say what is needed.
    """

    _faults = ((ValueError, "a cell is not a number"), (ArithmeticError, "a cell is not a number"))

    def __init__(self, header: str, columns: Mapping[str, str], account: Account, angles: bool = True) -> None:
        super().__init__(account)
        self._delimiter = max(",;\t", key=header.count)
        self._names = [columns.get(name, name.lower()) for name in _cells(header, self._delimiter)]
        repeated = next((name for name in self._names if name and self._names.count(name) > 1), None)
        if repeated:
            raise InputError(f"two columns are named {repeated!r}: rename or remove one of them.")
        self._time, self._decimals = self._time_column()
        self._accel = self._accel_columns()
        gimbals = self._gimbal_columns()
        self.has_angles = bool(gimbals.at)
        self._pose = gimbals if self.has_angles or not angles else self._quaternion_columns()
        self.pose_width = len(self._pose.at)
        self._temperature = self._found([_TEMPERATURE])
        used = {self._time, *self._accel.at, *self._pose.at, *self._temperature.at}
        self._account.leave_out(name for i, name in enumerate(self._names) if i not in used)

    @property
    def advice(self) -> str:
        """How columns have to be named."""
        return f"a header such as {_EXAMPLE} is wanted"

    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        is_quoted = '"' in line
        row = next(csv.reader([line], delimiter=self._delimiter)) if is_quoted else line.split(self._delimiter)
        for at, factor, value in zip(self._accel.at, self._accel.factors, readings_mps2, strict=True):
            row[at] = repr(value / factor)
        if not is_quoted:
            return self._delimiter.join(row)
        out = io.StringIO()
        csv.writer(out, delimiter=self._delimiter, lineterminator="").writerow(row)
        return out.getvalue()

    def _read_line(self, line: str, accel: LineRows, pose: LineRows, temperature: LineRows) -> None:
        is_plain = '"' not in line and " " not in line
        row = line.split(self._delimiter) if is_plain else _cells(line, self._delimiter)
        if len(row) != len(self._names):
            raise LineError(f"it has {len(row)} cells, the header has {len(self._names)}")
        time_ns = stamp_ns(Decimal(row[self._time]), self._decimals)
        # everything on the line is understood before any of it is used
        readings, angles, degrees = self._accel.values(row), self._pose.values(row), self._temperature.values(row)
        if angles and not self.has_angles and not any(angles):
            raise LineError("the quaternion is zero")
        accel.add(time_ns, readings)
        pose.add(time_ns, angles)
        temperature.add(time_ns, degrees)

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
        return self._found([match[0] for match in chosen], [ANGLE_UNITS[match[2]] for match in chosen])

    def _quaternion_columns(self) -> _Columns:
        names = ["qx", "qy", "qz", "qw"]
        if not set(names) <= set(self._names):
            raise InputError(
                "no columns give the platform's angles with their unit: name them outer_deg, inner_deg ... or "
                f"outer_rad ..., outer gimbal first (or the attitude qx, qy, qz, qw), not {self._seen}; or use "
                "none (--no-angles)."
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
