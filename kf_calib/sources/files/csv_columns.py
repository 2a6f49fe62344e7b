"""Which columns of a log of samples are what, how its stamps and numbers are written, and in which units.

Names of docs/format.md are known to the letter, and go before all others; other names are understood as in tables of
orientations. What no name tells is told by the first rows, where there are any: the unit of the readings by their
size, that of a time by its steps, the sign before decimals.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from functools import cached_property
from operator import mul

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.counts import SIGNED, parse_counts
from kf_calib.bench.raw_input import OPTIONS, PLAIN, RawInput
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.files.line_parts import LineError, number_of, stamp_ns
from kf_calib.sources.tables.columns import READINGS, SPREADS
from kf_calib.sources.tables.numbers import DECIMAL_POINT, Numbers, month_comes_first, stamp_of
from kf_calib.sources.text.contents import is_nameless, meanings_by_numbers
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.labels import Labels
from kf_calib.sources.text.names import ACCEL, ANGLE, QUATERNION, TIME, Meaning, is_exact, meanings_of, unit_of_epoch
from kf_calib.sources.text.units import Units, choice_of, reading_units, size_of_count, usual_norm
from kf_calib.support.text import cut
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

EXAMPLE = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"
_TIME_ALONE = ("t", "sec", "secs", "millis", "micros")
_OF_STEPS = ((0.0, 1.0, "s"), (1e3, 1e6, "us"), (1e6, 1e9, "ns"))
"""Steps that tell the unit of stamps: between them and in another unit, rows would be no samples."""
_MANY, _ALIKE_RAD, _MOST = 500, 0.1, 0.5
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
    it is written. rate_hz: of the rows, which have no time then.
    """

    at: tuple[int, ...]
    decimals: int = 9
    factor: int = 1
    is_date: bool = False
    month_first: bool = False
    rate_hz: float | None = None

    def ns(self, row: CsvRow, header: Sequence[str], numbers: Numbers, number: int = 0) -> int:
        """The stamp of a row in nanoseconds; number: of the row, from 0. Raises LineError where it has none."""
        if self.rate_hz is not None:
            return round(number * 1e9 / self.rate_hz)
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

    header: names as they stand in the file; names: as they are to be understood. delimiter: between cells.
    lines_of_names: numbers, from 0, of the lines of names and units. said: what was taken for what, where that is not
    plain from the names. raw: what the readings are in. written_mps2: the unit in which specific force takes the place
    of readings, m/s^2: that of their names; without_unit: columns of counts whose names tell none, which then are in
    m/s^2. labels: where each value has its name before it. chosen: a column, and the
    cell in it of the rows that count; None where all do.
    """

    header: Sequence[str]
    names: Sequence[str]
    delimiter: str
    rows: Sequence[CsvRow]
    units: Units
    local_mps2: float
    lines_of_names: tuple[int, ...] = ()
    said: list[str] = field(default_factory=list[str])
    raw: RawInput = PLAIN
    written_mps2: tuple[float, float, float] = (1.0, 1.0, 1.0)
    without_unit: tuple[int, ...] = ()
    labels: Labels | None = None
    chosen: tuple[int, str] | None = None
    _meanings: list[Meaning] = field(default_factory=list[Meaning])

    @classmethod
    def of(
        cls,
        heading: TextHeading,
        stated: Mapping[str, str],
        units: Units | None = None,
        local_mps2: float = STANDARD_GRAVITY_MPS2,
    ) -> CsvColumns:
        """stated: our name for each foreign one; ``-`` leaves a column out. local_mps2: gravity of the place, where a g
        is that. Raises InputError for names used twice."""
        header = heading.header
        names = ["" if stated.get(name) == "-" else stated.get(name, name) for name in header]
        lower = [name.lower() for name in names]
        times = Counter(lower)
        if repeated := next((name for name in lower if name and times[name] > 1), None):
            raise InputError(f"two columns are named {repeated!r}: rename or remove one of them.")
        full = [row for row in heading.rows if len(row) == len(names)]
        columns = cls(header, names, heading.delimiter, full, units or Units(), local_mps2, heading.lines_of_names)
        columns.labels = heading.labels
        if columns.units.where:
            columns._choose(columns.units.where)
        columns._meanings = meanings_of(header, stated)
        if is_nameless(header) and not stated:
            columns._meanings = meanings_by_numbers(columns._values(range(len(header))))
            columns.said.append("columns without names are told by their numbers")
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
        used = [at for at, own in enumerate(self._meanings) if own.ours] or range(len(self.names))
        cells = (row[at] for row in rows if len(row) == len(self.names) for at in used)
        return Numbers.told_by(cells, commas_count=self.delimiter != ",")

    @property
    def step_s(self) -> float:
        """The usual step from row to row, s; NaN where no time can be told."""
        try:
            time = self.time()
            stamps, numbers = list[int](), self.numbers or DECIMAL_POINT
            for number, row in enumerate(self.rows):
                try:
                    stamps.append(time.ns(row, self.header, numbers, number))
                except LineError:
                    continue
        except InputError:
            return math.nan
        steps = np.abs(np.diff(np.array(stamps, float)))
        return float(np.median(steps)) / 1e9 if len(steps) else math.nan

    @property
    def are_alike(self) -> bool:
        """Whether the readings of most rows are as those before, as of a sensor that lies still between turns; a
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
        if self.units.rate_hz is not None:
            self.said.append(f"time from the numbers of the rows, {self.units.rate_hz:g} of them a second (--rate)")
            return Stamps((), rate_hz=self.units.rate_hz)
        places = self._places("time") or [
            at for at, name in enumerate(self.names) if name.strip().lower() in _TIME_ALONE
        ]
        if not places:
            raise InputError(
                "no column gives the time: name it time_s or time_ns, or give the rate of the rows, for example "
                f"--rate 100; {self.wanted}, not {self._seen}."
            )
        exact = [at for at in places if is_exact(self.names[at])]
        united = [at for at in places if self._meanings[at].unit]
        place = self._most_even(exact or united or places)
        unit = self._meanings[place].unit or {"millis": "ms", "micros": "us"}.get(self.names[place].strip().lower(), "")
        values = self._values([place], [row for row in self.rows if row[place]])[:, 0]
        if not unit and len(values) and math.isnan(values[0]):
            return self._dates(places[:2] if place == places[0] else [place])
        unit = unit or self._unit_of_time(place, values)
        decimals = {"ns": 0, "us": 3, "ms": 6}.get(unit, 9)
        if not exact:
            self.said.append(f"time from {self._quoted([place])} in {unit}")
        return Stamps((place,), decimals, round(TIME[unit]) if decimals == 9 else 1)

    def _most_even(self, places: list[int]) -> int:
        """Return that of several columns of stamps which goes up most evenly; the first where none has numbers."""

        def unevenness(steps: Floats) -> float:
            steps = steps[np.isfinite(steps)]
            usual = float(np.median(steps)) if len(steps) else 0.0
            return float(np.median(np.abs(steps - usual))) / usual if usual > 0.0 else math.inf

        steps = np.diff(self._values(places), axis=0) if len(places) > 1 else np.zeros((0, 1))
        return places[int(np.argmin([unevenness(own) for own in steps.T]))]

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
        values = self._values(places)
        norm = usual_norm(values)
        if "" in named and not (self.units.accel or self.units.as_default(named, norm)) and math.isnan(norm):
            raise InputError(
                f"no columns give the three readings with their unit: {advice}, or state it by --accel-unit, and the "
                "size of counts by --accel-scale."
            )
        told = reading_units(named, values, self.units, self.local_mps2)
        if not told.is_known:
            signed = usual_norm(parse_counts(self.units.counts).signed(values))
            keys = size_of_count(signed)
            example = " ".join(f"{OPTIONS[key]} {value}" for key, value in keys.items())
            raise CountsError(
                f"the readings in {self._quoted(places)} have a size of {signed:.3g}, so they are counts: give the "
                "size of one by --accel-scale, in m/s^2 or what --accel-unit says, which is by gravity about "
                f"{example}.", keys
            )  # fmt: skip
        is_stated = self.units.accel is not None or self.units.accel_scale != 1.0
        if is_stated or not all(is_exact(self.names[at]) for at in places):
            self.said.insert(0, f"readings from {self._quoted(places)} in {told.words}")
        self.raw, scale = told.raw, self.units.accel_scale
        is_rewritten = scale != 1.0 or named != by_name or "count" in named or self.raw.sizes != PLAIN.sizes
        is_rewritten |= self.raw.counts != SIGNED
        written = [ACCEL.get(unit, 1.0) for unit in by_name] if is_rewritten else self.raw.factors.tolist()
        self.written_mps2 = (written[0], written[1], written[2])
        bare = [at for at, unit in zip(places, by_name, strict=True) if unit in ("", "count")]
        self.without_unit = tuple(bare) if is_rewritten else ()
        return QuantityColumns(tuple(places), (1.0, 1.0, 1.0))

    @property
    def has_usual_gimbals(self) -> bool:
        """Whether a column is named as a gimbal or in a unit of angles, so that it goes before an attitude."""
        return any(own.ours == "angle" and (own.rank or own.unit) for own in self._meanings)

    @property
    def has_orientations(self) -> bool:
        """Whether columns may be gimbal angles, in whatever unit, or an attitude."""
        return bool(self._places("angle")) or all(self._places(part) for part in QUATERNION)

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
        elif not all(is_exact(self.names[at]) for at in places):
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
        if not is_exact(self.names[at]):
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

    def unknown(self, used: Container[int]) -> list[str]:
        """The names of columns that nothing here knows: not those of a gyroscope, say, which are of no use here."""
        return [name for at, (name, own) in enumerate(zip(self.names, self._meanings, strict=True))
                if name and at not in used and not own.other]  # fmt: skip

    def _places(self, ours: str) -> list[int]:
        """Return the columns whose names say that quantity."""
        return [at for at, own in enumerate(self._meanings) if own.ours == ours]

    def refuse_several_units(self, used: Container[int]) -> None:
        """Raise CountsError where a column that means nothing to us tells several sensors apart, whose rows take turns.

        used: columns that have a meaning. Labels are few, each has a tenth of the rows, they change in three of ten
        rows, and readings under different ones differ by more than their scatter lets them.
        """
        places = [at for ours in READINGS for at in self._places(ours)]
        if len(places) != 3 or len(self.rows) < _FEWEST_ROWS:
            return
        for at, name in enumerate(self.names):
            is_told = at in used or not name or (self.chosen is not None and at == self.chosen[0])
            labels = [] if is_told else [row[at].strip() for row in self.rows]
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
            example = f"{cut(name, 40)}={first}"
            raise CountsError(
                f"the rows are of several sensors, told apart by the column {cut(self.header[at], 40)!r} ({shown}): "
                f"choose one, for example by --where {example!r}, or leave the column out if it means something else "
                f"(--column {cut(self.header[at], 40) + '=-'!r}).",
                {"where": example},
            )

    def _choose(self, where: str) -> None:
        """Keep the rows whose cell in a column is the one stated, as ``I=0``; raises InputError where there is none."""
        name, value = choice_of(where)
        if name not in self.header:
            raise InputError(
                f"has no column {cut(name, 60)!r} (--where), it has {cut(', '.join(map(repr, self.header)), 300)}."
            )
        at = list(self.header).index(name)
        labels = [row[at].strip() for row in self.rows]
        if value not in labels:
            seen = ", ".join(sorted(set(labels))[:8])
            raise InputError(f"no row among the first has {value!r} in column {name!r} (--where), they have {seen}.")
        self.chosen = (at, value)
        self.rows = [row for row, label in zip(self.rows, labels, strict=True) if label == value]

    def _values(self, places: Sequence[int], rows: Sequence[CsvRow] | None = None) -> Floats:
        """Return the numbers (n, k) in columns of rows (None: of the first), NaN where there is none."""
        numbers = self.numbers or DECIMAL_POINT
        values = [[_told(row[at], numbers) for at in places] for row in (self.rows if rows is None else rows)]
        return np.array(values, float).reshape(-1, len(places))

    def _one(self, ours: str) -> int | None:
        """Return the column of a quantity that is there once; names of the format go before others. Raises InputError
        where two are left."""
        places = self._places(ours)
        places = [at for at in places if is_exact(self.names[at])] or places
        if len(places) > 1:
            raise InputError(
                f"columns {self._quoted(places)} are all taken for {ours}: say which it is, for example by "
                f"--column {f'{self.header[places[0]]}={ours}'!r}."
            )
        return places[0] if places else None

    def _unit_of_time(self, place: int, values: Floats) -> str:
        """Return the unit of stamps (n,) whose name tells none, by their size or their steps."""
        known = values[np.isfinite(values)]
        size = float(np.abs(known).max(initial=0.0))
        if unit := unit_of_epoch(size):
            return unit
        step = float(np.median(np.abs(np.diff(known)))) if len(known) > 1 else 0.0
        if unit := next((unit for low, high, unit in _OF_STEPS if low < step < high), ""):
            return unit
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
