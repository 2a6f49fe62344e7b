"""From the cells of a table to a source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.counts import refuse_unread
from kf_calib.bench.raw_input import PLAIN, RawInput, merged_metadata
from kf_calib.bench.streams import Orientations, Table, bench_without_angles
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.tables.columns import HOW, KNOWN, READINGS, SPREADS, Columns, RowTimes, own_axes
from kf_calib.sources.tables.grid import grid_of
from kf_calib.sources.tables.numbers import Numbers
from kf_calib.sources.text.names import ANGLE, QUATERNION, face_of
from kf_calib.sources.text.units import Units, mps2_per, reading_units
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_SAMPLES, _FAST_S = 50, 1.0
_NOTHING = ("-", "–", "—", "n/a", "na", "nan", "#n/a", "null", "none", "?")
"""What people write where there is no temperature."""
_SHOWN = 6  # rows in a message
_UNKNOWN = (0.0, 0.0, 0.0, 1.0)
"""The attitude that stands for those that are not known."""
_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def open_table(
    table: Any,
    overrides: Mapping[str, str] = MappingProxyType({}),
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
    accel_unit: str | None = None,
    accel_scale: float | None = None,
    angle_unit: str | None = None,
    g_unit: str | float = STANDARD_GRAVITY_MPS2,
    angles: bool | None = True,
    input: RawInput | None = None,
    where: str = "",
    dataset: str = "",
) -> Table:
    """A table of orientations as a source: a row a dwell, with its mean readings and its angles, attitude or face.

    - table: path of a CSV or Excel file, a structured array, a DataFrame, or a mapping of columns.
    - overrides: keys of the bench, see docs/format.md.
    - columns: what columns are, theirs to ours, where it cannot be guessed.
    - accel_unit, angle_unit: units where the header names none; guessed from the numbers if None.
    - accel_scale: size of one count, in ``accel_unit`` (m/s^2 if that is None).
    - g_unit: m/s^2 that 1 g in the table stands for, or ``local`` for the gravity of the bench.
    - input: what the device sends, where neither the header nor the other arguments say it.
    - where: column and text in it of the rows that count, as ``unit=7``; all if it is empty.
    - dataset: of a file that holds several; the largest with readings if it is empty.
    - angles: False to do without angles, attitudes and faces; those that the table has are not used. None to do so
      where no column tells them.

    Raises InputError where a cell, or what the columns are, cannot be understood.
    """
    grid = grid_of(table, dataset).chosen(where)
    numbers = Numbers.of(grid)
    meanings = Columns.of(grid, columns, numbers)
    given = {"accel_unit": accel_unit, "accel_scale": accel_scale}
    keys = {**overrides, **{key: str(value) for key, value in given.items() if value is not None}}
    try:
        order = merged_metadata({}, keys, "", input).get("channels")
        units = Units.of(keys, angle_unit, g_unit, input)
    except BenchError as error:
        raise BenchError(f"{grid.name}: {error}") from None
    return Opening(meanings, keys if order is None else keys | {"channels": order}, units, angles=angles).table()


class Opening:
    """One opening of a table; ``said`` collects what was taken for what, ``by_size`` units of columns that the size of
    their numbers told; raw: what the readings are in; has_unit: whether that is known. angles: whether orientations
    count."""

    def __init__(
        self, columns: Columns, overrides: Mapping[str, str], units: Units, *, angles: bool | None = True
    ) -> None:
        self.columns, self.grid, self.said = columns, columns.grid, list[str]()
        self.overrides, self.units, self.by_size = overrides, units, dict[int, str]()
        self.are_lacking = angles is None and not columns.orientation
        self.has_unit, self.angles, self.raw = True, angles is not False and not self.are_lacking, PLAIN
        self.warnings = [f"{self.grid.name}: {remark}." for remark in self.grid.remarks]

    def table(self) -> Table:
        """The table; what is read first is what is most often missing."""
        elapsed_s = self.times.elapsed_s
        self.refuse_samples()
        self._refuse_own_axes()
        self._refuse_missing()
        self._say_times()
        pose = self._poses()
        bench = self._bench()
        means = self._readings(bench)
        sigmas, counts = self._spreads(bench)
        bench = replace(bench, input=replace(self.raw, channels=bench.input.channels))
        means = bench.input.ordered(means)
        sigmas = None if sigmas is None else np.abs(bench.input.ordered(sigmas))
        warmth = self._temperatures()
        rows = Orientations(means, pose, elapsed_s, sigmas, np.array(counts, np.int64), warmth)
        if unused := self.columns.unused:
            self.said.append(f"not used: {self.columns.named(unused)}")
        by = f" ({self._quoted(self.columns.guessed)} by what stands there)" if self.columns.guessed else ""
        told = f"{self.grid.name}: {'; '.join(self.said)}{by}. {HOW}."
        return Table(self.grid.name, bench, rows, [*self.warnings, told], self.times.start_ns, self.grid.path)

    def _quoted(self, names: list[str]) -> str:
        return ", ".join(map(repr, names))

    @cached_property
    def times(self) -> RowTimes:
        """When the rows were measured."""
        return RowTimes.of(self.columns)

    @property
    def are_samples(self) -> bool:
        """Whether the rows are a time series."""
        if self.columns.has("count") or self.columns.has("face") or self.columns.places("sd", *SPREADS):
            return False
        return len(self.grid.rows) > _SAMPLES and self._step_s < _FAST_S

    @property
    def _step_s(self) -> float:
        return float(np.median(np.diff(self.times.elapsed_s)))

    def refuse_samples(self) -> None:
        """Raise InputError for a time series."""
        if self.are_samples:
            raise InputError(
                f"{self.grid.name}: its {len(self.grid.rows)} rows are samples, {self._step_s:.3g} s apart, and no "
                "table with a row a dwell: evaluate them as a log of samples in a CSV file (docs/own_csv.md)."
            )

    def _refuse_own_axes(self) -> None:
        """Raise InputError, with what they tell, for readings of each axis along gravity and against it alone."""
        extremes = own_axes(self.columns)
        if extremes is None:
            return
        half = (extremes[:, 0] - extremes[:, 1]) / 2.0
        told = reading_units(["", "", ""], np.diag(half), self.units, STANDARD_GRAVITY_MPS2)
        unit = half.mean() if not told.is_known else STANDARD_GRAVITY_MPS2 / told.raw.factors[0]
        scales = ", ".join(f"K{k + 1} = {size / unit:.4f}" for k, size in enumerate(half))
        biases = ", ".join(f"b{k + 1} = {middle:g}" for k, middle in enumerate(extremes.mean(axis=1)))
        of_mean = "" if told.is_known else " of their mean, as no unit is known"
        raise InputError(
            f"{self.grid.name}: has of each axis only what it reads up and down: six numbers for six unknowns, {scales}"
            f"{of_mean}, and {biases} as written, with no degree of freedom to judge them or to tell angles: write all "
            "three readings in each row."
        )

    def _say_times(self) -> None:
        if self.times.said:
            self.said.append(self.times.said)
            return
        self.warnings.append(
            f"{self.grid.name}: no column gives the time: the rows are taken to follow each other by a minute, so "
            "sizes of drifts are by row rather than by time."
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
        if self.angles and not columns.orientation:
            raise InputError(
                f"{self.grid.name}: no column was recognised as gimbal angles, attitude or face among {header[:300]}: "
                f"name it, for example --column '{_left_over(columns)}=face' with cells such as +x or -z, or "
                f"=outer_deg (known: {KNOWN}), or do without orientations (--no-angles)."
            )

    def _poses(self) -> Floats:
        """Return angles in rad (n, k), or quaternions (n, 4) of attitudes or faces; where orientations do not count,
        one that stands for those that are not known."""
        columns = self.columns
        if not self.angles:
            if unused := columns.angles or columns.places("face", *QUATERNION):
                self.warnings.append(f"{self.grid.name}: {columns.named(unused)}: not used, without angles.")
            return np.tile(_UNKNOWN, (len(self.grid.rows), 1))
        if self.units.angle and not columns.angles:
            raise InputError(f"{self.grid.name}: has no gimbal angles, so leave out --angle-unit.")
        if columns.has("face"):
            return self._faces()
        if columns.has(*QUATERNION):
            places = columns.places(*QUATERNION)
            pose = np.column_stack([columns.values(place) for place in places])
            norms = lengths(pose)
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
        quaternions = list[Floats]()
        for row, cell in enumerate(self.grid.column(place)):
            face = face_of(str(cell or ""))
            if face is None:
                raise self.grid.refuse(
                    row, self.grid.header[place], cell, "write the axis that points up, one of +x, -x, +y, -y, +z, -z"
                )
            quaternions.append(_attitude(*face, up))
        self.said.append(f"axis that points up from {self.columns.named([place])}")
        return np.array(quaternions)

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
        self._refuse_other_angle(places)
        unit = next(iter(units), None) or self.units.angle or guess
        how = "" if units or self.units.angle else " by their size (--angle-unit)"
        self.said.append(f"gimbal angles, outer to inner, from {columns.named(places)} in {unit}{how}")
        self.by_size |= {place: unit for place in places} if how else {}
        return ANGLE[unit] * values

    def _bench(self) -> Bench:
        if not self.angles:
            bench, said = bench_without_angles(self.grid.name, self.overrides, are_lacking=self.are_lacking)
            self.warnings += said
            return bench
        has_angles = self.columns.orientation == "angles"
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
        refuse_unread(values, self.raw.counts, self.grid.name)
        return self.raw.signed(values) * factors

    def _accel_factors(self, places: list[int], values: Floats, bench: Bench) -> tuple[Floats, str]:
        """Return the factors (3,) from columns of readings to m/s^2, and the unit in words."""
        by_name = [self.columns.meanings[place].unit for place in places]
        try:
            named = self.units.told_by([self.grid.header[place] for place in places], by_name)
        except InputError as error:
            raise InputError(f"{self.grid.name}: {error}") from None
        told = reading_units(named, values, self.units, bench.gravity_mps2)
        self.has_unit = told.is_known
        self.raw = told.raw
        if told.by_size:
            self.by_size |= {place: told.units[k] for k, place in enumerate(places) if not named[k]}
        return told.raw.factors, told.words

    def _refuse_other_angle(self, places: list[int]) -> None:
        """Raise InputError if an option states another unit of angles than the name of a column."""
        for place in places:
            unit = self.columns.meanings[place].unit
            if self.units.angle and unit not in ("", self.units.angle):
                raise InputError(
                    f"{self.grid.name}: column {self.grid.header[place]!r} is in {unit} by its name, and --angle-unit "
                    f"is {self.units.angle}: leave out --angle-unit, or rename the column by --column."
                )

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
        values = np.column_stack([columns.values(place, "a standard deviation", optional=True) for place in places])
        for row, k in np.argwhere(values < 0.0):
            place = places[int(k)]
            raise self.grid.refuse(int(row), self.grid.header[place], self.grid.rows[row][place],
                                   "a standard deviation is not negative")  # fmt: skip
        units = [columns.meanings[place].unit for place in places]
        readings = columns.places(*READINGS)
        means = np.column_stack([columns.values(place) for place in readings])
        factors, _ = self._accel_factors(readings, means, bench)
        if units[0] and units[0] != "count":
            factors = mps2_per([unit or units[0] for unit in units], self.units, bench.gravity_mps2)
        return values * factors, self._counts()

    def _counts(self) -> list[int]:
        (place,) = self.columns.places("count")
        values = self.columns.values(place, "a number of readings", optional=True)
        for row in np.flatnonzero((values < 2) | (values != np.rint(values)) | (values > 1e9)):
            raise self.grid.refuse(int(row), self.grid.header[place], self.grid.rows[row][place],
                                   "write how many readings were averaged, a whole number of at least 2")  # fmt: skip
        return [int(value) for value in values]

    def _temperatures(self) -> Floats:
        """Return the temperatures of the rows; between those where it was measured, as that of a recording is."""
        places, rows = self.columns.places("temperature"), len(self.grid.rows)
        if not places:
            return np.full(rows, np.nan)
        cells = self.grid.column(places[0])
        known = np.array([cell is not None and str(cell).lower() not in _NOTHING for cell in cells])
        if not known.any():
            return np.full(rows, np.nan)
        unit = self.columns.meanings[places[0]].unit
        self.said.append(f"temperature from {self.columns.named(places)} in {(unit or 'c').upper()}")
        values = self.columns.values(places[0], "a temperature", optional=True, only=known)
        values = {"k": values - 273.15, "f": (values - 32.0) / 1.8}.get(unit, values)
        if not known.all():
            empty = ", ".join(str(self.grid.numbers[row]) for row in np.flatnonzero(~known)[:_SHOWN])
            more = " ..." * (rows - int(known.sum()) > _SHOWN)
            self.warnings.append(
                f"{self.grid.name}: has no temperature in rows {empty}{more}: it is interpolated in time there."
            )
        elapsed_s = self.times.elapsed_s
        return np.interp(elapsed_s, elapsed_s[known], values[known])


def _attitude(axis: int, sign: int, up: str) -> Floats:
    """Return the quaternion x y z w from platform to bench that points an axis of the platform up.

    Of all such attitudes, that which is reached by the shortest turn; a turn about the vertical changes no reading.
    """
    upward = sign * np.eye(3)[axis]
    target = (-1.0 if up.startswith("-") else 1.0) * np.array(_UP[up.removeprefix("-")])
    turned = np.append(np.cross(upward, target), 1.0 + float(upward @ target))
    if not turned.any():
        turned = np.append(np.roll(np.abs(upward), 1), 0.0)  # half a turn about any axis across
    return turned / np.linalg.norm(turned)


def _left_over(columns: Columns) -> str:
    """Return the name of a column that means nothing yet, for an example."""
    return next((columns.grid.header[k] for k in columns.unused), "THEIRS")
