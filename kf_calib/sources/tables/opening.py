"""From the cells of a table to a source."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.tables.columns import HOW, KNOWN, QUATERNION, READINGS, SPREADS, Columns
from kf_calib.sources.tables.grid import EXCEL_SUFFIXES, MCAP, OLD_SUFFIXES, TEXT_SUFFIXES, ZIP, grid_of
from kf_calib.sources.tables.numbers import Numbers, stamps_of
from kf_calib.sources.tables.orientation import Orientation
from kf_calib.sources.tables.table import Table
from kf_calib.sources.tables.words import ACCEL, ANGLE, TIME, face_of
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_USUAL_PAUSE_S = 60.0
_UNIT_BY_SIZE = (("g", 0.5, 2.0), ("m/s2", 5.0, 20.0), ("mg", 500.0, 2000.0))
_SAMPLES, _FAST_S = 50, 1.0
_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def is_table(path: str | PathLike[str]) -> bool:
    """Whether a file is a table by its beginning and its name: CSV or a spreadsheet, and no recording."""
    own = Path(path)
    if not own.is_file():
        return False
    with own.open("rb") as file:
        start = file.read(8)
    suffixes = (*TEXT_SUFFIXES, *EXCEL_SUFFIXES, *OLD_SUFFIXES)
    return start.startswith(ZIP) or (own.suffix.lower() in suffixes and not start.startswith(MCAP))


def open_table(
    table: Any,
    overrides: Mapping[str, str] = MappingProxyType({}),
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
    accel_unit: str | None = None,
    accel_scale: float = 1.0,
    angle_unit: str | None = None,
    g_unit: str | float = STANDARD_GRAVITY_MPS2,
) -> Table:
    """A table of orientations as a source: a row a dwell, with its mean readings and its angles, attitude or face.

    - table: path of a CSV or Excel file, a structured array, a DataFrame, or a mapping of columns.
    - overrides: keys of the bench, see docs/format.md.
    - columns: what columns are, theirs to ours, where it cannot be guessed.
    - accel_unit, angle_unit: units where the header names none; guessed from the numbers if None.
    - accel_scale: size of one count, in ``accel_unit`` (m/s^2 if that is None).
    - g_unit: m/s^2 that 1 g in the table stands for, or ``local`` for the gravity of the bench.

    Raises InputError where a cell, or what the columns are, cannot be understood.
    """
    grid = grid_of(table)
    numbers = Numbers.of(grid)
    found = Columns.of(grid, columns, numbers)
    return _Opening(found, overrides, accel_unit, accel_scale, angle_unit, g_unit).table()


class _Opening:
    """One opening of a table; ``said`` collects what was taken for what."""

    def __init__(
        self,
        columns: Columns,
        overrides: Mapping[str, str],
        accel_unit: str | None,
        accel_scale: float,
        angle_unit: str | None,
        g_unit: str | float,
    ) -> None:
        self.columns, self.grid, self.said = columns, columns.grid, list[str]()
        self.accel_unit, self.accel_scale, self.angle_unit = accel_unit, accel_scale, angle_unit
        self.overrides, self.g_unit = overrides, g_unit
        self.warnings = [f"{self.grid.name}: {remark}." for remark in self.grid.remarks]

    def table(self) -> Table:
        """The table; what is read first is what is most often missing."""
        elapsed_s, start_ns = self._times()
        self._refuse_samples(elapsed_s)
        self._refuse_missing()
        pose = self._poses()
        bench = self._bench()
        means = self._readings(bench)
        sigmas, counts = self._spreads(bench)
        warmth = self._temperatures()
        rows = [
            Orientation(mean, own, at_s, None if sigmas is None else sigmas[k], count, float(warmth[k]))
            for k, (mean, own, at_s, count) in enumerate(zip(means, pose, elapsed_s, counts, strict=True))
        ]
        if unused := self.columns.unused:
            self.said.append(f"not used: {self.columns.named(unused)}")
        by = f" ({self._quoted(self.columns.guessed)} by what stands there)" if self.columns.guessed else ""
        told = f"{self.grid.name}: {'; '.join(self.said)}{by}. {HOW}."
        return Table(self.grid.name, bench, rows, [*self.warnings, told], start_ns)

    def _quoted(self, names: list[str]) -> str:
        return ", ".join(map(repr, names))

    def _times(self) -> tuple[Floats, int | None]:
        """Return the times of the rows since the first, s, and the stamp of the first where it has a date."""
        places, count = self.columns.places("time"), len(self.grid.rows)
        if not places:
            self.warnings.append(
                f"{self.grid.name}: no column gives the time: the rows are taken to follow each other by a minute, so "
                "sizes of drifts are by row rather than by time."
            )
            return _USUAL_PAUSE_S * np.arange(count, dtype=np.float64), None
        unit = self.columns.meanings[places[0]].unit
        if len(places) == 1 and (unit in TIME or all(isinstance(cell, float) for cell in self.grid.column(places[0]))):
            elapsed_s, start_ns = TIME[unit or "s"] * self.columns.values(places[0], "a time"), None
        else:
            elapsed_s, start_ns = self._stamps(places)
        self.said.append(f"time from {self.columns.named(places)}")
        self._refuse_disorder(elapsed_s, places[0])
        return elapsed_s - elapsed_s[0], start_ns

    def _stamps(self, places: list[int]) -> tuple[Floats, int | None]:
        """Return times from stamps, of which date and time may stand in two columns, or from numbers of seconds."""
        if len(places) == 1 and all(_is_number(self.columns, cell) for cell in self.grid.column(places[0])):
            return self.columns.values(places[0], "a time"), None
        cells = self.grid.column(places[0])
        if len(places) > 1:
            parts = zip(*(self.grid.column(place) for place in places), strict=True)
            cells = [" ".join(_date_or_time(cell) for cell in own if cell is not None) for own in parts]
        stamps = stamps_of(self.grid, self.grid.header[places[0]], list(cells))
        zero = stamps[0]
        elapsed_s = np.array([(stamp - zero).total_seconds() for stamp in stamps])
        start = zero.astimezone(UTC) if zero.tzinfo else None
        start_ns = None if start is None else round((start - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()) * 10**9
        return elapsed_s, start_ns

    def _refuse_disorder(self, elapsed_s: Floats, place: int) -> None:
        back = np.flatnonzero(np.diff(elapsed_s) <= 0)
        if back.size:
            row = int(back[0]) + 1
            cell = self.grid.rows[row][place]
            name = self.grid.header[place]
            raise self.grid.refuse(
                row, name, cell, f"the row before is not earlier: sort the rows by time, or leave the time out by "
                f"--column {name + '=-'!r}"
            )  # fmt: skip

    def _refuse_samples(self, elapsed_s: Floats) -> None:
        """Raise InputError for a time series, which has to be recorded first."""
        known = self.columns.has("count") or self.columns.has("face") or self.columns.places("sd", *SPREADS)
        if known or len(elapsed_s) <= _SAMPLES:
            return
        if (step_s := float(np.median(np.diff(elapsed_s)))) < _FAST_S:
            raise InputError(
                f"{self.grid.name}: its {len(elapsed_s)} rows are samples, {step_s:.3g} s apart, and no table with "
                "a row a dwell: make a recording of them, kf-calib record run.mcap "
                f"{self.grid.name} (docs/own_csv.md), and evaluate that."
            )

    def _refuse_missing(self) -> None:
        columns, header = self.columns, ", ".join(map(repr, self.grid.header))
        missing = [ours for ours in READINGS if not columns.has(ours)]
        if missing:
            raise InputError(
                f"{self.grid.name}: no column was recognised as the mean reading of accelerometer "
                f"{' and '.join(ours[1] for ours in missing)} among {header[:300]}: name it, for example --column "
                f"'{_left_over(columns)}={missing[0]}_g' (known: {KNOWN})."
            )
        if not (columns.angles or columns.has("face") or columns.has(*QUATERNION)):
            raise InputError(
                f"{self.grid.name}: no column was recognised as gimbal angles, attitude or face among {header[:300]}: "
                f"name it, for example --column '{_left_over(columns)}=face' with cells such as +x or -z, or "
                f"=outer_deg (known: {KNOWN})."
            )

    def _poses(self) -> Floats:
        """Return angles in rad (n, k), or quaternions (n, 4) of attitudes or faces."""
        columns = self.columns
        if columns.has("face"):
            return self._faces()
        if columns.has(*QUATERNION):
            places = columns.places(*QUATERNION)
            pose = np.column_stack([columns.values(place) for place in places])
            norms = np.linalg.norm(pose, axis=1)
            for row in np.flatnonzero(np.abs(norms - 1.0) > 0.01):
                raise self.grid.refuse(
                    int(row), "qx, qy, qz, qw", ", ".join(f"{part:g}" for part in pose[row]),
                    f"its length is {norms[row]:.3g}: write a unit quaternion from platform to bench"
                )  # fmt: skip
            self.said.append(f"attitude from {columns.named(places)}")
            return pose / norms[:, None]
        return self._angles()

    def _faces(self) -> Floats:
        (place,) = self.columns.places("face")
        up = self.overrides.get("up", "y").strip().lower().removeprefix("+")
        out = list[Floats]()
        for row, cell in enumerate(self.grid.column(place)):
            face = face_of(str(cell or ""))
            if face is None:
                raise self.grid.refuse(
                    row, self.grid.header[place], cell, "write the axis that points up, one of +x, -x, +y, -y, +z, -z"
                )
            out.append(_attitude(*face, up))
        self.said.append(f"axis that points up from {self.columns.named([place])}")
        return np.array(out)

    def _angles(self) -> Floats:
        columns, places = self.columns, self.columns.angles
        values = np.column_stack([columns.values(place, "an angle") for place in places])
        units = {columns.meanings[place].unit for place in places} - {""}
        if len(units) > 1:
            raise InputError(
                f"{self.grid.name}: angles are in {' and '.join(sorted(units))} ({columns.named(places)}): write all "
                "in one unit."
            )
        guess = "deg" if np.abs(values).max() > 2.0 * np.pi or np.array_equal(values, np.rint(values)) else "rad"
        unit = next(iter(units), None) or self.angle_unit or guess
        how = "" if units or self.angle_unit else " by their size (--angle-unit)"
        self.said.append(f"gimbal angles, outer to inner, from {columns.named(places)} in {unit}{how}")
        return ANGLE[unit] * values

    def _bench(self) -> Bench:
        has_angles = not (self.columns.has("face") or self.columns.has(*QUATERNION))
        if has_angles and (axes := self.overrides.get("axes")):
            known, count = len(parse_axes(axes)), len(self.columns.angles)
            if known != count:
                raise InputError(
                    f"{self.grid.name}: has {count} column{'s' * (count != 1)} of angles "
                    f"({self.columns.named(self.columns.angles)}) where --axes names {known} gimbals: {HOW}."
                )
        try:
            return Bench.from_metadata(self.overrides, has_angles)
        except BenchError as error:
            raise BenchError(f"{self.grid.name}: {error}") from error

    def _readings(self, bench: Bench) -> Floats:
        places = self.columns.places(*READINGS)
        values = np.column_stack([self.columns.values(place, "a reading") for place in places])
        factors, unit = self._accel_factors(places, values, bench)
        self.said.insert(0, f"mean readings from {self.columns.named(places)} in {unit}")
        return values * factors

    def _accel_factors(self, places: list[int], values: Floats, bench: Bench) -> tuple[Floats, str]:
        """Return the factors (3,) from columns of readings to m/s^2, and the unit in words."""
        named = [self.columns.meanings[place].unit for place in places]
        stated = self.accel_unit
        for place, unit in zip(places, named, strict=True):
            if stated and unit not in ("", "count", stated):
                raise InputError(
                    f"{self.grid.name}: column {self.grid.header[place]!r} is in {unit} by its name, and --accel-unit "
                    f"is {stated}: leave out --accel-unit, or rename the column by --column."
                )
        size = float(np.median(np.linalg.norm(values, axis=1))) * self.accel_scale
        by_size = next((unit for unit, low, high in _UNIT_BY_SIZE if low < size < high), "m/s2")
        units = [unit if unit not in ("", "count") else stated or ("m/s2" if unit else by_size) for unit in named]
        factors = np.array([ACCEL[unit] * (self._g(bench) / STANDARD_GRAVITY_MPS2 if unit.endswith("g") else 1.0)
                            for unit in units])  # fmt: skip
        guessed = any(unit == "" for unit in named) and not stated
        words = " and ".join(dict.fromkeys(unit.replace("m/s2", "m/s^2") for unit in units))
        if self.accel_scale != 1.0 or "count" in named:
            words = f"counts of {self.accel_scale:g} {words}"
        words += " by their size (--accel-unit)" * guessed
        if any(unit.endswith("g") for unit in units):
            words += f", 1 g = {self._g(bench):.7g} m/s^2 (--g-unit)"
        return factors * self.accel_scale, words

    def _g(self, bench: Bench) -> float:
        """Return what 1 g stands for, m/s^2."""
        if self.g_unit == "local":
            return bench.gravity_mps2
        try:
            size = float(self.g_unit)
        except ValueError:
            size = 0.0
        if not 9.0 < size < 10.0:
            raise InputError(f"--g-unit is {self.g_unit!r}: give m/s^2 from 9 to 10, such as 9.80665, or local.")
        return size

    def _spreads(self, bench: Bench) -> tuple[Floats | None, list[int]]:
        """Return standard deviations (n, 3) and counts; None and ones where either is not given."""
        columns, rows = self.columns, len(self.grid.rows)
        places = columns.places(*SPREADS)
        places = places if len(places) == 3 else columns.places("sd") * 3
        if not (places and columns.has("count")):
            lacking = "standard deviations" if not places else "numbers of readings"
            if places or columns.has("count"):
                self.warnings.append(
                    f"{self.grid.name}: has no {lacking}, so its "
                    f"{'numbers of readings' if not places else 'standard deviations'} are not used: the noise of a "
                    "mean needs both."
                )
            return None, [1] * rows
        self.said.append(f"standard deviations from {columns.named(list(dict.fromkeys(places)))}, "
                         f"of as many readings as {columns.named(columns.places('count'))} says")  # fmt: skip
        values = np.column_stack([columns.values(place, "a standard deviation") for place in places])
        for row, k in np.argwhere(values < 0.0):
            place = places[int(k)]
            raise self.grid.refuse(int(row), self.grid.header[place], self.grid.rows[row][place],
                                   "a standard deviation is not negative")  # fmt: skip
        own = [columns.meanings[place].unit for place in places]
        readings = columns.places(*READINGS)
        means = np.column_stack([columns.values(place) for place in readings])
        factors, _ = self._accel_factors(readings, means, bench)
        if own[0] and own[0] != "count":
            factors = np.array([ACCEL[unit] * (self._g(bench) / STANDARD_GRAVITY_MPS2 if unit.endswith("g") else 1.0)
                                for unit in own])  # fmt: skip
        return values * factors, self._counts()

    def _counts(self) -> list[int]:
        (place,) = self.columns.places("count")
        values = self.columns.values(place, "a number of readings")
        for row in np.flatnonzero((values < 2) | (values != np.rint(values)) | (values > 1e9)):
            raise self.grid.refuse(int(row), self.grid.header[place], self.grid.rows[row][place],
                                   "write how many readings were averaged, a whole number of at least 2")  # fmt: skip
        return [int(value) for value in values]

    def _temperatures(self) -> Floats:
        places = self.columns.places("temperature")
        if not places:
            return np.full(len(self.grid.rows), np.nan)
        unit = self.columns.meanings[places[0]].unit
        values = self.columns.values(places[0], "a temperature")
        self.said.append(f"temperature from {self.columns.named(places)} in {(unit or 'c').upper()}")
        return {"k": values - 273.15, "f": (values - 32.0) / 1.8}.get(unit, values)


def _attitude(axis: int, sign: int, up: str) -> Floats:
    """Return the quaternion x y z w from platform to bench that points an axis of the platform up.

    Of all such attitudes, that which is reached by the shortest turn; a turn about the vertical changes no reading.
    """
    own = sign * np.eye(3)[axis]
    target = (-1.0 if up.startswith("-") else 1.0) * np.array(_UP[up.removeprefix("-")])
    turned = np.append(np.cross(own, target), 1.0 + float(own @ target))
    if not turned.any():
        turned = np.append(np.roll(np.abs(own), 1), 0.0)  # half a turn about any axis across
    return turned / np.linalg.norm(turned)


def _is_number(columns: Columns, cell: object) -> bool:
    try:
        columns.numbers.value(cell)  # type: ignore[arg-type]  # a cell of the grid
    except ValueError:
        return False
    return True


def _date_or_time(cell: object) -> str:
    """Return the cell of one of two columns for date and time, which a spreadsheet gives as a stamp at midnight."""
    return cell.strftime("%Y-%m-%d") if isinstance(cell, datetime) else str(cell)


def _left_over(columns: Columns) -> str:
    """Return the name of a column that means nothing yet, for an example."""
    return next((columns.grid.header[k] for k in columns.unused), "THEIRS")
