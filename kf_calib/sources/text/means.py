"""A table of means: a row a dwell, with its mean readings and its angles, attitude or face.

What is in one before it is evaluated: what each column was taken for and why, and the orientations."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, lengths
from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.counts import refuse_unread
from kf_calib.bench.keys import UNSTATED, BenchKeys, checked_keys
from kf_calib.bench.raw_input import RawInput, merged_metadata
from kf_calib.bench.streams import Orientations, Table, bench_without_angles
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text.cells import LineError, QuantityColumns
from kf_calib.sources.text.columns import HOW, NOTHING, SLOWEST_S, Columns, refuse_unknown_names
from kf_calib.sources.text.grid import grid_of
from kf_calib.sources.text.names import QUATERNION, READINGS, SPREADS, face_of
from kf_calib.sources.text.reader import named
from kf_calib.sources.text.units import Units, celsius, reading_units
from kf_calib.support.text import SHOWN, counted, cut
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_USUAL_PAUSE_S = 60.0
_UNKNOWN = (0.0, 0.0, 0.0, 1.0)
"""The attitude that stands for those that are not known."""
_MOST_OWN = 6  # rows of a table of own axes
_UP_DOWN = re.compile(r"([+\-−])\s*1\s*g", re.IGNORECASE)


def open_table(
    table: Any,
    overrides: BenchKeys = UNSTATED,
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
    given = {"accel_unit": accel_unit, "accel_scale": accel_scale}
    table = Path(table) if isinstance(table, str | PathLike) else table
    with named(_name_of(table)):
        keys = checked_keys({**overrides, **{key: value for key, value in given.items() if value is not None}})
        order = merged_metadata({}, keys, "", input).get("channels")
        units = replace(Units.of(keys, angle_unit, g_unit, input), where=where, dataset=dataset)
        return TableOfMeans(
            table, columns, keys if order is None else {**keys, "channels": order}, units, angles
        ).table()


class TableOfMeans:
    """One opening of a table; ``said`` collects what was taken for what. angles: whether orientations count; None: they
    do where a column tells them. orientation: how, as of the columns; empty where they do not count."""

    def __init__(
        self, table: Any, stated: Mapping[str, str], overrides: BenchKeys, units: Units, angles: bool | None
    ) -> None:
        heading, remarks = grid_of(table, units.dataset)
        self.name, self.path = _name_of(table), table if isinstance(table, Path) else None
        refuse_unknown_names(stated, heading.header)
        self.columns = columns = Columns(heading, stated, units, is_table=True)
        pairs = zip(heading.numbers, heading.rows, strict=True)
        self.rows = [line + 1 for line, row in pairs if columns.is_chosen(row)]
        self.overrides, self.units, self.said = overrides.copy(), units, columns.said
        self.are_lacking = angles is None and not columns.orientation
        self.angles = angles is not False and not self.are_lacking
        self.orientation = columns.orientation if self.angles else ""
        self.warnings = [f"{self.name}: {remark}." for remark in remarks]

    def table(self) -> Table:
        """The table; what is read first is what is most often missing."""
        columns, name = self.columns, self.name
        elapsed_s, start_ns = self.times
        self.refuse_samples()
        self._refuse_own_axes()
        raw = columns.values(columns.reading_places)
        refuse_unread(raw[np.isfinite(raw).all(axis=1)], self.units.counts, name)
        readings = columns.accel()
        if self.angles and not self.orientation:
            raise columns.without_angles()
        if not columns.has("time"):
            self._warn(
                "no column gives the time: the rows are taken to follow each other by a minute, so sizes of drifts are "
                "by row rather than by time."
            )
        pose, bench = self._poses(), self._bench()
        means = self._values(readings, "a reading")
        sigmas, counts = self._spreads()
        bench = replace(bench, input=replace(columns.raw, channels=bench.input.channels))
        means = bench.input.ordered(columns.raw.signed(means) * columns.raw.factors)
        sigmas = None if sigmas is None else np.abs(bench.input.ordered(sigmas))
        rows = Orientations(means, pose, elapsed_s, sigmas, counts, self._temperatures())
        if unused := columns.unused:
            self.said.append(f"not used: {columns.named(unused)}")
        by = f" ({', '.join(map(repr, columns.guessed))} by what stands there)" if columns.guessed else ""
        told = f"{name}: {'; '.join(self.said)}{by}. {HOW}."
        return Table(name, bench, rows, [*self.warnings, told], start_ns, self.path)

    def _warn(self, sentence: str) -> None:
        self.warnings.append(f"{self.name}: {sentence}")

    def _refusal(self, row: int, at: int, wanted: str, *, is_optional: bool = False) -> InputError:
        """Return the error that names a cell (row counted from 0), its value, and what would be read. is_optional:
        whether the table would do without the column."""
        cell, header = self.columns.rows[row][at], self.columns.header[at]
        said = f"is {cut(cell, 60)!r}" if cell else "is empty"
        or_else = f", or leave the column out by --column {header + '=-'!r}" * is_optional
        return InputError(f"row {self.rows[row]}, column {header!r} {said}: {wanted}{or_else}.")

    def _values(self, quantity: QuantityColumns, wanted: str, *, is_optional: bool = False) -> Floats:
        """Return the numbers (n, k) of a quantity, NaN where its cells say that there are none; raises InputError for
        the first cell that holds none. is_optional: as of ``_refusal``."""
        values, example = self.columns.values(quantity.at), f"9{self.columns.numbers.decimal}80665"
        for row, k in np.argwhere(~np.isfinite(values)).tolist():
            cell = self.columns.rows[row][quantity.at[k]]
            if cell.lower() in quantity.absent:
                values[row, k] = math.nan
                continue
            or_else = ", or remove the row" * (not cell and not is_optional)
            wanted = f"write {wanted} such as {example}{or_else}"
            raise self._refusal(row, quantity.at[k], wanted, is_optional=is_optional)
        return values * (quantity.factors or 1.0)

    @cached_property
    def times(self) -> tuple[Floats, int | None]:
        """Return the times of the rows since the first, s, and the stamp of the first; without a column of time they
        are a minute apart."""
        columns, stamps = self.columns, list[int]()
        if not columns.has("time"):
            return _USUAL_PAUSE_S * np.arange(len(self.rows), dtype=np.float64), None
        time = columns.time()
        for k, row in enumerate(columns.rows):
            try:
                stamps.append(time.ns(row, columns.header, columns.numbers, k))
            except LineError:
                example = "2026-05-04T13:45:00+02:00 or 04.05.2026 13:45:00, or seconds, all in one way"
                raise self._refusal(k, time.at[0], f"write a time such as {example}", is_optional=True) from None
            if k and stamps[k] <= stamps[k - 1]:
                wanted = "the row before is not earlier: sort the rows by time"
                raise self._refusal(k, time.at[0], wanted, is_optional=True)
        return (np.array(stamps) - stamps[0]) / 1e9, stamps[0]

    def refuse_samples(self) -> None:
        """Raise InputError for a time series."""
        if not self.columns.may_be_samples:
            return
        step_s = float(np.median(np.diff(self.times[0])))
        if step_s < SLOWEST_S:
            raise InputError(
                f"its {len(self.rows)} rows are samples, {step_s:.3g} s apart, and no table with a row a dwell: "
                "evaluate them as a log of samples in a CSV file (docs/own_csv.md)."
            )

    # -- readings of each axis along gravity and against it alone --

    def _refuse_own_axes(self) -> None:
        """Raise InputError, with what they tell, for readings of each axis along gravity and against it alone."""
        extremes = self._own_axes()
        if not np.isfinite(extremes).all():
            return
        half = (extremes[:, 0] - extremes[:, 1]) / 2.0
        raw, *_ = reading_units(["", "", ""], np.diag(half), self.units)
        unit = STANDARD_GRAVITY_MPS2 / raw.factors[0] if raw else half.mean()
        scales = ", ".join(f"K{k + 1} = {size / unit:.4f}" for k, size in enumerate(half))
        biases = ", ".join(f"b{k + 1} = {middle:g}" for k, middle in enumerate(extremes.mean(axis=1)))
        of_mean = "" if raw else " of their mean, as no unit is known"
        raise InputError(
            f"has of each axis only what it reads up and down: six numbers for six unknowns, {scales}"
            f"{of_mean}, and {biases} as written, with no degree of freedom to judge them or to tell angles: write all "
            "three readings in each row."
        )

    def _own_axes(self) -> Floats:
        """Return what each axis reads up and down (3, 2), where a table holds no more than that: a row for each face
        with the reading of its own axis alone, or a row for each axis with those at +1 g and -1 g. NaN in others."""
        columns, extremes = self.columns, np.full((3, 2), np.nan)
        signs = [(match[1] != "+", k) for k, name in enumerate(columns.header) if (match := _UP_DOWN.fullmatch(name))]
        readings, up_down = columns.places(*READINGS), [k for _, k in sorted(signs)]
        for row in range(len(self.rows) if len(self.rows) <= _MOST_OWN else 0):
            cells = columns.rows[row]
            axis, sign = next((told for cell in cells if (told := face_of(cell))), (0, 0))
            if sign and len(up_down) == 2:
                extremes[axis] = columns.values(up_down)[row]
            elif sign and len(readings) == 3 and {cells[k] for k in readings if k != readings[axis]} <= NOTHING:
                extremes[axis, int(sign < 0)] = columns.values(readings)[row, axis]
        return extremes

    # -- orientations --

    def _poses(self) -> Floats:
        """Return angles in rad (n, k), or quaternions (n, 4) of attitudes or faces; where orientations do not count,
        one that stands for those that are not known."""
        columns = self.columns
        if not self.angles:
            if unused := columns.angles or columns.places("face", *QUATERNION):
                self._warn(f"{columns.named(unused)}: not used, without angles.")
            return np.tile(_UNKNOWN, (len(self.rows), 1))
        if self.units.angle and columns.orientation != "angles":
            raise InputError("has no gimbal angles, so leave out --angle-unit.")
        if columns.orientation == "angles":
            return self._values(columns.pose(needed=True), "an angle")
        if (place := columns.place("face")) is not None:
            faces = [face_of(row[place]) for row in columns.rows]
            if None in faces:
                wanted = "write the axis that points up, one of +x, -x, +y, -y, +z, -z"
                raise self._refusal(faces.index(None), place, wanted)
            self.said.append(f"axis that points up from {columns.named([place])}")
            up = self.overrides.get("up", "y").strip().lower()
            attitudes = {face: _attitude(*face, up) for face in set(faces) if face}
            return np.array([attitudes[face] for face in faces if face])
        quaternion = columns.pose(needed=True)
        pose = self._values(quaternion, "a number")
        norms = lengths(pose)
        for row in np.flatnonzero(np.abs(norms - 1.0) > 0.01):
            raise InputError(
                f"row {self.rows[row]}, column 'qx, qy, qz, qw' is {', '.join(f'{part:g}' for part in pose[row])!r}: "
                f"its length is {norms[row]:.3g}: write a unit quaternion from platform to bench."
            )
        self.said.append(f"attitude from {columns.named(quaternion.at)}")
        return pose / norms[:, None]

    def _bench(self) -> Bench:
        if not self.angles:
            bench, said = bench_without_angles(self.name, self.overrides, are_lacking=self.are_lacking)
            self.warnings += said
            return bench
        has_angles, count = self.columns.orientation == "angles", len(self.columns.angles)
        if has_angles and (axes := self.overrides.get("axes")) and (known := len(parse_axes(axes))) != count:
            raise InputError(
                f"has {counted(count, 'column')} of angles ({self.columns.named(self.columns.angles)}) where "
                f"--axes names {known} gimbals: {HOW}."
            )
        return Bench.from_metadata(self.overrides, has_angles)

    # -- deviations, counts and temperatures --

    def _spreads(self) -> tuple[Floats | None, Ints]:
        """Return standard deviations (n, 3) and counts (n,); None and ones where either is not given."""
        columns, count = self.columns, self.columns.place("count")
        places = columns.places(*SPREADS)
        places = places if len(places) == 3 else columns.places("sd")[:1] * 3
        if not places or count is None:
            if places or count is not None:
                lacking = "standard deviations", "numbers of readings"
                self._warn(
                    f"has no {lacking[bool(places)]}, so its {lacking[not places]} are not used: the noise of a mean "
                    "needs both."
                )
            return None, np.ones(len(self.rows), np.int64)
        self.said.append(f"standard deviations from {columns.named(list(dict.fromkeys(places)))}, "
                         f"of as many readings as {columns.named([count])} says")  # fmt: skip
        values = self._values(QuantityColumns(tuple(places)), "a standard deviation", is_optional=True)
        for row, k in np.argwhere(values < 0.0).tolist():
            raise self._refusal(row, places[k], "a standard deviation is not negative")
        units, factors = [columns.meanings[place].unit for place in places], columns.raw.factors
        if units[0] and units[0] != "count":
            factors = self.units.mps2_per([unit or units[0] for unit in units])
        counts = self._values(QuantityColumns((count,)), "a number of readings", is_optional=True)[:, 0]
        for row in np.flatnonzero((counts < 2) | (counts != np.rint(counts)) | (counts > 1e9)).tolist():
            wanted = "write how many readings were averaged, a whole number of at least 2"
            raise self._refusal(row, count, wanted)
        return values * factors, counts.astype(np.int64)

    def _temperatures(self) -> Floats:
        """Return the temperatures (n,) of the rows, degC; between those where it was measured, as that of a recording
        is."""
        quantity, unit = self.columns.temperature()
        if not quantity.at:
            return np.full(len(self.rows), np.nan)
        values = celsius(self._values(quantity, "a temperature", is_optional=True)[:, 0], unit)
        lacking = np.isnan(values)
        if lacking.all() or not lacking.any():
            return values
        empty = ", ".join(str(self.rows[row]) for row in np.flatnonzero(lacking)[:SHOWN])
        more = " ..." * (int(lacking.sum()) > SHOWN)
        self._warn(f"has no temperature in rows {empty}{more}: it is interpolated in time there.")
        elapsed_s, _ = self.times
        return np.interp(elapsed_s, elapsed_s[~lacking], values[~lacking])


class Survey(TableOfMeans):
    """What is in a table. What is not stated of the bench does not matter here: cells are read alike with any gravity
    and any axes. angles: whether orientations count, if there are any.

    evaluated: None where it cannot be, and ``trouble`` says why. Raises InputError where not even the columns can be
    understood, or the rows are samples.
    """

    evaluated: Table | None = None
    trouble = ""

    def __init__(
        self, path: Path, overrides: BenchKeys = UNSTATED, columns: Mapping[str, str] = MappingProxyType({}),
        units: Units | None = None, *, angles: bool = True,
    ) -> None:  # fmt: skip
        keys, self._stated = overrides.copy(), columns
        if not {"gravity_mps2", "latitude_deg"} & keys.keys():
            keys["gravity_mps2"] = STANDARD_GRAVITY_MPS2
        with named(str(path)):
            super().__init__(path, columns, keys, units or Units(), None if angles else False)
            self.refuse_samples()
            self.are_lacking = False  # whoever asks is told by the columns
            if (places := self.columns.angles) and not overrides.get("axes"):
                self.overrides["axes"] = " ".join("yzx"[k % 3] for k in range(len(places)))
            try:
                self.evaluated = self.table()
            except CountsError:
                raise
            except InputError as error:
                self.trouble = f"{path}: {error}"

    @cached_property
    def described_columns(self) -> list[dict[str, str]]:
        """The columns in their order.

        header, first: name and first cell as they stand in the table. meaning: of ``names.Meaning``, gimbal angles with
        their number, outer to inner; empty if it is not used. unit: of its numbers. told_by: ``name``, ``content``,
        ``size`` (the unit, by its numbers), ``content and size`` or ``--column``.
        """
        columns, described = self.columns, list[dict[str, str]]()
        for k, (header, meaning) in enumerate(zip(columns.header, columns.meanings, strict=True)):
            by_size, is_used = columns.by_size.get(k, ""), bool(meaning.ours)
            told_by = " and ".join(["content"] * (header in columns.guessed) + ["size"] * bool(by_size)) or "name"
            number = f" {columns.angles.index(k) + 1}" if k in columns.angles else ""
            described.append({
                "header": header, "first": next((row[k] for row in columns.rows if row[k]), ""),
                "meaning": meaning.ours + number, "unit": (by_size or meaning.unit) * is_used,
                "told_by": ("--column" if header in self._stated else told_by) * is_used,
            })  # fmt: skip
        return described

    @cached_property
    def described_rows(self) -> list[dict[str, Any]]:
        """The orientations; none where the table cannot be evaluated.

        number: of the dwell; row: in the table. at_s: its middle since the first. face: as it was written down. pose:
        gimbal angles in rad, or attitude; empty without angles. up (3,): the unit vector along the mean readings.
        readings: how many were averaged; None where it is not known.
        """
        described, place = list[dict[str, Any]](), self.columns.place("face") if self.orientation else None
        for k, row in enumerate(self.evaluated.orientations if self.evaluated else ()):
            norm = float(np.linalg.norm(row.mean_mps2))
            described.append({
                "number": k + 1, "row": self.rows[k], "at_s": row.elapsed_s,
                "face": None if place is None else self.columns.rows[k][place],
                "pose": list(map(float, row.pose)) if self.orientation else [],
                "up": (row.mean_mps2 / max(norm, 1e-300)).tolist(), "norm_mps2": norm,
                "readings": None if row.sigma_mps2 is None else row.count, "temperature_c": row.temperature_c,
            })  # fmt: skip
        return described


def _name_of(table: Any) -> str:
    """Return what messages call a table."""
    return str(table) if isinstance(table, Path) else "the table"


def _attitude(axis: int, sign: int, up: str) -> Floats:
    """Return the quaternion x y z w from platform to bench that points an axis of the platform up.

    Of all such attitudes, that which is reached by the shortest turn; a turn about the vertical changes no reading.
    """
    upward, target = sign * np.eye(3)[axis], np.eye(3)["xyz".index(up[-1])] * (-1.0 if up[0] == "-" else 1.0)
    turned = np.append(np.cross(upward, target), 1.0 + float(upward @ target))
    if not turned.any():
        turned = np.append(np.roll(np.abs(upward), 1), 0.0)  # half a turn about any axis across
    return turned / np.linalg.norm(turned)
