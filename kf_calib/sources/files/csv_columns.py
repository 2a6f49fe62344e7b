"""Which columns of a log of samples are what, how its stamps and numbers are written, and in which units.

Names of docs/format.md are known to the letter, and go before all others; other names are understood as in tables of
orientations. What no name tells is told by the first rows, where there are any: the unit of the readings by their
size, that of a time by its steps, the sign before decimals.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from functools import cached_property
from operator import mul

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.raw_input import PLAIN, UNITS, RawInput
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.files.line_parts import CsvHeading, LineError, number_of, stamp_ns
from kf_calib.sources.tables.columns import QUATERNION, READINGS, SPREADS
from kf_calib.sources.tables.numbers import DECIMAL_POINT, Numbers, month_comes_first, stamp_of
from kf_calib.sources.tables.words import (
    ANGLE,
    NO_HEADER,
    TIME,
    Meaning,
    Units,
    are_numbers,
    choices_in,
    likely_count,
    meanings_of,
    reading_units,
)
from kf_calib.support.text import cut
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

EXAMPLE = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"
_EXACT = re.compile(
    r"time_(ns|us|ms|s)|a[xyz]_(mps2|g|mg|ug)|q[xyzw]|(outer|middle|inner)_(deg|rad)|temperature_c", re.IGNORECASE
)
_LIKELY = re.compile(r"a|x|y|z|raw", re.IGNORECASE)
_TIME_ALONE = ("t", "sec", "secs", "millis", "micros")
_OF_EPOCH = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""From which size on a stamp without a unit is one since 1970 in this unit."""
_FASTEST_TABLE_S = 1.0
_MANY, _ALIKE_RAD, _MOST = 500, 0.1, 0.9
_FEWEST_ROWS, _MOST_UNITS, _APART = 20, 8, 5.0  # rows and labels of several sensors, and sigmas between these
_MARKS_OF_TABLES = ("count", "face", "sd", *SPREADS)

CsvRow = Sequence[str]


@dataclass(frozen=True)
class QuantityColumns:
    """Where a quantity stands in a row, and the factors that bring it to our units."""

    at: tuple[int, ...] = ()
    factors: tuple[float, ...] = ()

    def values(self, row: CsvRow, header: Sequence[str], numbers: Numbers) -> list[float] | None:
        """The quantity, None where it is not measured. Raises LineError where it cannot be used."""
        cells = [row[at] for at in self.at]
        if not all(cells):
            if any(cells):
                raise LineError("some components of a vector are missing")
            return None
        values = [_number(cell, numbers) for cell in cells]
        if not math.isfinite(sum(values)):  # which numbers beyond 1e308 together are not, either
            for at, cell, value in zip(self.at, cells, values, strict=True):
                if not math.isfinite(value):
                    raise LineError(f"column {cut(header[at], 40)!r} is {cut(cell, 40)!r}, which is no number")
        return list(map(mul, values, self.factors))


def has_texts(row: CsvRow, chosen: Mapping[int, str]) -> bool:
    """Whether a row has these texts in its columns."""
    return all(at < len(row) and row[at].strip() == text for at, text in chosen.items())


def _number(cell: str, numbers: Numbers) -> float:
    """Return the number in a cell, NaN where there is none."""
    try:
        return number_of(cell if numbers.decimal == "." else numbers.with_point(cell))
    except LineError:
        raise
    except ValueError:
        try:
            return numbers.value(cell)
        except (ValueError, OverflowError):
            return math.nan


def _told(cell: str, numbers: Numbers) -> float:
    """Return what a cell of the first rows tells, NaN where its line will be refused."""
    try:
        return _number(cell, numbers)
    except LineError:
        return math.nan


@dataclass(frozen=True)
class Stamps:
    """How a row's time is written: a number of a unit, or the stamp of a calendar, in one column or in two.

    decimals: of a unit in nanoseconds; factor: how many of it one is. is_date: whether it is a stamp; month_first: how
    it is written.
    """

    at: tuple[int, ...]
    decimals: int = 9
    factor: int = 1
    is_date: bool = False
    month_first: bool = False

    def ns(self, row: CsvRow, header: Sequence[str], numbers: Numbers) -> int:
        """The stamp of a row in nanoseconds. Raises LineError where it has none."""
        cell = row[self.at[0]] if len(self.at) == 1 else " ".join(row[at] for at in self.at)
        try:
            if self.is_date:
                stamp = stamp_of(cell, self.month_first)
                since = (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
                return stamp_ns((since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000, 0)
            return stamp_ns(self.factor * Decimal(numbers.with_point(cell)), self.decimals)
        except LineError:
            raise
        except (ValueError, ArithmeticError):
            raise LineError(f"column {cut(header[self.at[0]], 40)!r} is {cut(cell, 40)!r}, which is no time") from None


@dataclass
class CsvColumns:
    """The columns of a log by its header and, where the header does not tell, its first rows.

    header: names as they stand in the file; names: as they are to be understood. delimiter: between cells. said: what
    was taken for what, where that is not plain from the names. raw: what the readings are in. written_mps2: the unit in
    which specific force takes the place of readings, m/s^2: that of their names; without_unit: columns of counts whose
    names tell none, which then are in m/s^2. chosen: texts that the rows have in columns by which they are chosen.
    """

    header: Sequence[str]
    names: Sequence[str]
    delimiter: str
    rows: Sequence[CsvRow]
    units: Units
    local_mps2: float
    said: list[str] = field(default_factory=list[str])
    raw: RawInput = PLAIN
    written_mps2: tuple[float, float, float] = (1.0, 1.0, 1.0)
    without_unit: tuple[int, ...] = ()
    chosen: Mapping[int, str] = field(default_factory=dict[int, str])
    _meanings: list[Meaning] = field(default_factory=list[Meaning])

    @classmethod
    def of(
        cls,
        heading: CsvHeading,
        stated: Mapping[str, str],
        units: Units | None = None,
        local_mps2: float = STANDARD_GRAVITY_MPS2,
    ) -> CsvColumns:
        """stated: our name for each foreign one; ``-`` leaves a column out, ``=VALUE`` chooses rows. local_mps2:
        gravity of the place, where a g is that. Raises InputError for names used twice."""
        header = heading.header
        chosen = choices_in(header, stated)
        ours = [stated.get(name, name) for name in header]
        names = ["" if stated.get(header[at]) == "-" or at in chosen else text for at, text in enumerate(ours)]
        lower = [name.lower() for name in names]
        times = Counter(lower)
        if repeated := next((name for name in lower if name and times[name] > 1), None):
            raise InputError(f"two columns are named {repeated!r}: rename or remove one of them.")
        if are_numbers(header):
            raise InputError(f"{NO_HEADER}: {cut(','.join(header), 60)!r}.")
        full = [row for row in heading.rows if len(row) == len(names) and has_texts(row, chosen)]
        columns = cls(header, names, heading.delimiter, full, units or Units(), local_mps2, chosen=chosen)
        columns._meanings = meanings_of(names)
        return columns

    @property
    def marks_of_a_table(self) -> bool:
        """Whether there is what only a table of dwells has: numbers of readings, deviations, faces."""
        return any(own.ours in _MARKS_OF_TABLES for own in self._meanings)

    @cached_property
    def numbers(self) -> Numbers | None:
        """How the numbers are written; None where no row tells yet."""
        return self.numbers_in(self.rows)

    def numbers_in(self, rows: Sequence[CsvRow]) -> Numbers | None:
        """How the numbers in rows are written; None where these do not tell."""
        used = [at for at, own in enumerate(self._meanings) if own.ours]
        cells = (row[at] for row in rows if len(row) == len(self.names) for at in used)
        return Numbers.told_by(cells, commas_count=self.delimiter != ",")

    @property
    def step_s(self) -> float:
        """The usual step from row to row, s; NaN where no time can be told."""
        try:
            time = self.time()
            stamps, numbers = list[int](), self.numbers or DECIMAL_POINT
            for row in self.rows:
                try:
                    stamps.append(time.ns(row, self.header, numbers))
                except LineError:
                    continue
        except InputError:
            return math.nan
        steps = np.abs(np.diff(np.array(stamps, float)))
        return float(np.median(steps)) / 1e9 if len(steps) else math.nan

    @property
    def are_alike(self) -> bool:
        """Whether the readings of nearly all rows are as those before, as of a sensor that lies still between turns; a
        row a dwell would change from one to the next."""
        places = [at for ours in READINGS for at in self._places(ours)]
        if len(places) != 3 or len(self.rows) < _MANY:
            return False
        values = self._values(places)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = values / lengths(values)[:, None]
            return bool((lengths(np.diff(unit, axis=0)) < _ALIKE_RAD).mean() > _MOST)

    def time(self) -> Stamps:
        """How the time is written. Raises InputError where no column tells it, or not in which unit."""
        places = self._places("time") or [
            at for at, name in enumerate(self.names) if name.strip().lower() in _TIME_ALONE
        ]
        if not places:
            raise InputError(f"no column gives the time: name it time_s or time_ns; {self.wanted}, not {self._seen}.")
        exact = [at for at in places if _EXACT.fullmatch(self.names[at])]
        united = [at for at in places if self._meanings[at].unit]
        place = max(exact or united or places, key=self._evenness)  # of equal ones the first
        unit = self._meanings[place].unit or {"millis": "ms", "micros": "us"}.get(self.names[place].strip().lower(), "")
        values = self._values([place], [row for row in self.rows if row[place]])[:, 0]
        if not unit and len(values) and math.isnan(values[0]):
            return self._dates(places[:2] if place == places[0] else [place])
        unit = unit or self._unit_of_time(place, values)
        decimals = {"ns": 0, "us": 3, "ms": 6}.get(unit, 9)
        if not exact:
            self.said.append(f"time from {self._quoted([place])} in {unit}")
        return Stamps((place,), decimals, round(TIME[unit]) if decimals == 9 else 1)

    def accel(self) -> QuantityColumns:
        """The three readings as they are written; ``raw`` tells then what in.

        Raises InputError where their columns or their units are not told."""
        chosen = [self._one(ours) for ours in READINGS]
        places = [at for at in chosen if at is not None]
        advice = f"name them ax_mps2, ay_mps2, az_mps2 (or ax_g, ax_mg ...), not {self._seen}"
        if len(places) < 3:
            raise InputError(f"no columns give the three readings with their unit: {advice}.")
        by_name = [self._meanings[at].unit for at in places]
        named = self.units.told_by([self.header[at] for at in places], by_name)
        norm = self._usual_norm(places)
        if "" in named and not (self.units.accel or self.units.as_default(named, norm)) and math.isnan(norm):
            raise InputError(
                f"no columns give the three readings with their unit: {advice}, or state it by --accel-unit, and the "
                "size of counts by --accel-scale."
            )
        told = reading_units(named, norm, self.units, self.local_mps2)
        if not told.is_known:
            scale, usual = likely_count(norm)
            said = f" It may be {usual}: --accel-scale {scale:.6g}." if usual else ""
            raise CountsError(
                f"the readings in {self._quoted(places)} have a size of {norm:.3g}, so they are counts: give the size "
                f"of one by --accel-scale, in m/s^2 or what --accel-unit says.{said}", scale
            )  # fmt: skip
        is_stated = self.units.accel is not None or self.units.accel_scale != 1.0
        if is_stated or not all(_EXACT.fullmatch(self.names[at]) for at in places):
            self.said.insert(0, f"readings from {self._quoted(places)} in {told.words}")
        self.raw, scale = told.raw, self.units.accel_scale
        is_rewritten = scale != 1.0 or named != by_name or "count" in named or self.raw.sizes != PLAIN.sizes
        written = [UNITS.get(unit, 1.0) for unit in by_name] if is_rewritten else self.raw.factors.tolist()
        self.written_mps2 = (written[0], written[1], written[2])
        bare = [at for at, unit in zip(places, by_name, strict=True) if unit not in UNITS]
        self.without_unit = tuple(bare) if is_rewritten else ()
        return QuantityColumns(tuple(places), (1.0, 1.0, 1.0))

    @property
    def has_usual_gimbals(self) -> bool:
        """Whether a column is named as a gimbal or in a unit of angles, so that it goes before an attitude."""
        return any(own.ours == "angle" and (own.rank or own.unit) for own in self._meanings)

    def gimbals(self, *, needed: bool) -> QuantityColumns:
        """The angles by the usual names, else every column of an angle in the order of the header; none where there is
        none. Raises InputError where their unit is not told and they are needed."""
        places = self._places("angle")
        ranked = sorted((at for at in places if self._meanings[at].rank), key=lambda at: self._meanings[at].rank)
        places = ranked or places
        if len({self._meanings[at].rank for at in ranked}) < len(ranked):
            raise InputError(f"{self._quoted(ranked)} name a gimbal twice: leave one out by --column THEIRS=-.")
        units = [self._meanings[at].unit for at in places]
        if "" in units:
            unit = self.units.angle or ("deg" if (np.abs(self._values(places)) > 2.0 * math.pi).any() else "")
            if not unit and not needed:
                return QuantityColumns()
            if not unit:
                raise self.without_angles()
            units = [own or unit for own in units]
            self.said.append(f"gimbal angles, outer to inner, from {self._quoted(places)} in {unit}")
        elif self.units.angle and set(units) - {self.units.angle}:
            raise InputError(
                f"{self._quoted(places)} are in {' and '.join(sorted(set(units)))} by their names, and --angle-unit is "
                f"{self.units.angle}: leave out --angle-unit."
            )
        elif not all(_EXACT.fullmatch(self.names[at]) for at in places):
            self.said.append(f"gimbal angles, outer to inner, from {self._quoted(places)}")
        return QuantityColumns(tuple(places), tuple(ANGLE[unit] for unit in units))

    def quaternion(self) -> QuantityColumns:
        """The attitude; nothing where its four columns are not there."""
        places = [self._one(ours) for ours in QUATERNION]
        known = tuple(at for at in places if at is not None)
        return QuantityColumns(known, (1.0,) * 4) if len(known) == 4 else QuantityColumns()

    def temperature(self) -> tuple[QuantityColumns, str]:
        """The temperature, if there is one, and its unit: ``c``, ``k`` or ``f``."""
        at = self._one("temperature")
        if at is None:
            return QuantityColumns(), "c"
        if not _EXACT.fullmatch(self.names[at]):
            self.said.append(f"temperature from {self._quoted([at])} in {(self._meanings[at].unit or 'c').upper()}")
        return QuantityColumns((at,), (1.0,)), self._meanings[at].unit or "c"

    @property
    def wanted(self) -> str:
        """How columns have to be named."""
        return f"a header such as {EXAMPLE} is wanted"

    def without_angles(self) -> InputError:
        """That no angles are there, or none whose unit is known."""
        places = self._places("angle")
        name = self.header[places[0]] if places else ""
        example = f", for example by --column '{name}=outer_deg'" if places else ""
        return InputError(
            f"no columns give the platform's angles with their unit: name them outer_deg, inner_deg ... or "
            f"outer_rad ..., outer gimbal first{example} (or the attitude qx, qy, qz, qw), not {self._seen}; or use "
            "none (--no-angles)."
        )

    def _evenness(self, place: int) -> float:
        """Return the share of steps of a time that go up by about the usual one; 0 where they are no numbers."""
        stamps = self._values([place])[:, 0]
        steps = np.diff(stamps[np.isfinite(stamps)])
        usual = float(np.median(steps)) if len(steps) else 0.0
        return round(float(np.mean((steps > 0.5 * usual) & (steps < 2.0 * usual))), 3) if usual > 0.0 else 0.0

    def _places(self, ours: str) -> list[int]:
        """Return the columns whose names say that quantity."""
        return [at for at, own in enumerate(self._meanings) if own.ours == ours]

    def refuse_several_units(self, used: Container[int]) -> None:
        """Raise InputError where a column that means nothing to us tells several sensors apart, whose rows take turns.

        used: columns that have a meaning. Labels are few, each has a tenth of the rows, they change in three of ten
        rows, and readings under different ones differ by more than their scatter lets them.
        """
        places = [at for ours in READINGS for at in self._places(ours)]
        if len(places) != 3 or len(self.rows) < _FEWEST_ROWS:
            return
        for at, name in enumerate(self.names):
            labels = [] if at in used or not name else [row[at].strip() for row in self.rows]
            shares = Counter(labels)
            turns = [k for k in range(len(labels) - 1) if labels[k] != labels[k + 1]]
            if not 2 <= len(shares) <= _MOST_UNITS or min(shares.values()) < 0.1 * len(labels):
                continue
            if len(turns) < 0.3 * len(labels) or not all(label and len(label) <= 16 for label in shares):
                continue
            values, first = self._values(places), min(shares)
            signs = np.array([1.0 if labels[k] == first else -1.0 for k in turns])
            steps = (values[np.array(turns) + 1] - values[turns]) * signs[:, None]
            middle = np.nanmedian(steps, axis=0)  # between poses the readings leap
            spread = 1.86 * np.nanmedian(np.abs(steps - middle), axis=0) / math.sqrt(len(turns))
            if not (np.abs(middle) > _APART * np.maximum(spread, 1e-300)).any():
                continue
            shown = ", ".join(sorted(shares)[:4])
            raise InputError(
                f"the rows are of several sensors, told apart by the column {cut(self.header[at], 40)!r} ({shown}): "
                f"choose one, as by --where {cut(self.header[at], 40) + '=' + first!r}, or leave the column out if it "
                f"means something else (--column {cut(self.header[at], 40) + '=-'!r})."
            )

    def _values(self, places: Sequence[int], rows: Sequence[CsvRow] | None = None) -> Floats:
        """Return the numbers (n, k) in columns of rows (None: of the first), NaN where there is none."""
        numbers = self.numbers or DECIMAL_POINT
        values = [[_told(row[at], numbers) for at in places] for row in (self.rows if rows is None else rows)]
        return np.array(values, float).reshape(-1, len(places))

    def _one(self, ours: str) -> int | None:
        """Return the column of a quantity that is there once; names of the format go before others, then such as begin
        like one of readings. Raises InputError where two are left."""
        places = self._places(ours)
        for likely in (_EXACT.fullmatch, _LIKELY.match):
            places = [at for at in places if likely(self.names[at].strip())] or places
        if len(places) > 1:
            other = self.header[places[1]]
            raise InputError(
                f"columns {self._quoted(places)} are all taken for {ours}: leave out what it is not by "
                f"--column {other + '=-'!r}."
            )
        return places[0] if places else None

    def _usual_norm(self, places: Sequence[int]) -> float:
        """Return the median size of the readings in the first rows, NaN where there are none."""
        norms = lengths(self._values(places))
        norms = norms[np.isfinite(norms)]
        return float(np.median(norms)) if len(norms) else math.nan

    def _unit_of_time(self, place: int, values: Floats) -> str:
        """Return the unit of stamps (n,) whose name tells none, by their size or their steps."""
        known = values[np.isfinite(values)]
        size = float(np.abs(known).max(initial=0.0))
        if unit := next((unit for least, unit in _OF_EPOCH if size >= least), ""):
            return unit
        if len(known) > 1 and 0.0 < float(np.median(np.abs(np.diff(known)))) < _FASTEST_TABLE_S:
            return "s"
        name = self.header[place]
        raise InputError(
            f"no column gives the time with its unit: say which {name!r} has, for example --column '{name}=time_ms'; "
            f"{self.wanted}, not {self._seen}."
        )

    def _dates(self, places: Sequence[int]) -> Stamps:
        """How stamps of a calendar are written; of two columns the second may give the time of day."""
        cells = [[row[at] for row in self.rows if all(row[at] for at in places)] for at in places]
        joined = [" ".join(own) for own in zip(*cells, strict=True)]
        month_first = month_comes_first(joined)
        for chosen, texts in ((places, joined), (places[:1], cells[0])):
            if texts and _is_date(texts[0], month_first):
                self.said.append(f"time from {self._quoted(chosen)}")
                return Stamps(tuple(chosen), is_date=True, month_first=month_first)
        raise InputError(
            f"no column gives the time: {self._quoted(places[:1])} is {cut(cells[0][0] if cells[0] else '', 40)!r}, "
            "write seconds, or stamps such as 2026-05-04T13:45:00.010+02:00."
        )

    def _quoted(self, places: Sequence[int]) -> str:
        return ", ".join(repr(cut(self.header[at], 40)) for at in places)

    @property
    def _seen(self) -> str:
        shown = ",".join(self.header[:12])
        return repr(shown if len(shown) <= 120 else shown[:120] + "...")


def _is_date(text: str, month_first: bool) -> bool:
    try:
        stamp_of(text, month_first)
    except ValueError:
        return False
    return True
