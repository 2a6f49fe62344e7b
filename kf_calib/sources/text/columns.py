"""Which columns of a text are what, how its stamps and numbers are written, and in which units.

Names of docs/format.md are known to the letter, and go before all others. What no name tells is told by the rows, where
there are any: the unit of the readings by their size, that of a time by its steps, the sign before decimals. A table of
means is read as a log of samples is; it has all rows at hand, so that what stands in them tells more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.counts import SIGNED, parse_counts
from kf_calib.bench.raw_input import OPTIONS, PLAIN
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text import names
from kf_calib.sources.text.cells import DECIMAL_POINT, CsvRow, LineError, Numbers, QuantityColumns, Stamps, are_stamps
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.units import Units, reading_units, size_of_count, usual_norm
from kf_calib.support.text import cut

WANTED = "a header such as time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c is wanted"
"""How columns have to be named."""
SLOWEST_S = 1.0
"""Rows that are closer are samples, not dwells."""
HOW = "--column THEIRS=OURS says what a column is"
KNOWN = "ax_g (ay_mps2, az_mg), sx_g or sd_g, outer_deg (middle_rad, inner_deg), qx, face, time_s, count, temperature_c"
_OPTIONAL = ("time", "count", "temperature", "sd", *names.SPREADS)
_MARKS_OF_TABLES = ("count", "face", "sd", *names.SPREADS)
_FEWEST_SAMPLES = 50
NOTHING = frozenset(("", *names.VOCABULARY["nothing"].split()))
"""What people write where there is no value."""
_TIME_ALONE = ("t", "x_value")
_OF_STEPS = ((0.0, 1.0, "s"), (1e3, 1e6, "us"), (1e6, 1e9, "ns"))
"""Steps that tell the unit of stamps: between them and in another unit, rows would be no samples."""
_ALIKE = 1.3  # of the norms of readings at rest, largest to smallest
_FEWEST = 2.0
"""Readings behind a mean."""
_MOST_CELLS = 0.6  # of a column of readings are numbers: a bad one is told later


class Columns:
    """The columns of a text by its header and, where the header does not tell, its rows.

    header: the names as they stand in the text; names: as they are to be understood. rows: the first, of a table of
    means all (``is_table``). said: what was taken for what, where that is not plain from the names. guessed: names of
    columns that were recognised by what stands in them. by_size: units that the size of the numbers told. raw: what the
    readings are in. written_mps2: the unit in which specific force takes the place of readings, m/s^2: that of their
    names; without_unit: columns of counts whose names tell none, which then are in m/s^2. chosen: a column, and the
    cell in it of the rows that count; None where all do.
    """

    def __init__(
        self, heading: TextHeading, stated: Mapping[str, str], units: Units | None = None, *, is_table: bool = False
    ) -> None:
        """stated: our name for each foreign one; ``-`` leaves a column out. Raises InputError where units choose no
        row."""
        self.heading, self.header, self.units, self.is_table = heading, heading.header, units or Units(), is_table
        self.names = ["" if stated.get(name) == "-" else stated.get(name, name) for name in self.header]
        self.said, self.guessed, self.by_size = list[str](), list[str](), dict[int, str]()
        self.raw, self.written_mps2, self.without_unit = PLAIN, [1.0] * 3, list[int]()
        self.chosen: tuple[int, str] | None = None
        self.rows: list[CsvRow] = [row for row in heading.rows if len(row) == len(self.names)]
        if self.units.where:
            self._choose_rows(self.units.where)
        self.meanings = names.meanings_of(self.header, stated)
        self.numbers = self.numbers_in(self.rows) or DECIMAL_POINT
        for k in self.places("count"):
            counts = self.values([k])[:, 0]
            if len(counts) > 1 and ((np.diff(counts) == 1.0).mean() > _MOST_CELLS or counts.max() < _FEWEST):
                self.meanings[k] = names.Meaning()  # the number of the row
        if names.is_nameless(self.header) and not stated:
            self._recognise_numbers()
        if is_table:
            self._recognise_contents({k for k, name in enumerate(self.header) if name in stated})
        elif not self.has("time"):
            alone = [k for k, name in enumerate(self.names) if name.strip().lower() in _TIME_ALONE]
            for k in alone[:1] or list(filter(self._are_stamps, self.unknown)):
                self._guess(k, "time")

    def _choose_rows(self, where: str) -> None:
        """Keep the rows with a text in a column, as ``I=0``; raises InputError where none has it."""
        name, value = (part.strip() for part in where.rpartition("=")[::2])
        if not (name and value):
            raise InputError(f"--where is {where!r}: write --where COLUMN=VALUE, as --where unit=0.")
        if name not in self.header:
            raise InputError(f"has no column {cut(name, 60)!r} (--where), it has {self._all}.")
        self.chosen = at, value = list(self.header).index(name), value
        labels = {row[at].strip() for row in self.rows}
        if value not in labels:
            seen, among = ", ".join(sorted(labels)[:8]), "" if self.is_table else " among the first"
            raise InputError(f"no row{among} has {value!r} in column {name!r} (--where), they have {seen}.")
        self.rows = [row for row in self.rows if self.is_chosen(row)]

    def places(self, *wanted: str) -> list[int]:
        """Indices of the columns of these kinds, in the order asked for."""
        return [k for ours in wanted for k, own in enumerate(self.meanings) if own.ours == ours]

    def place(self, ours: str) -> int | None:
        """The column of a quantity that is there once; names of the format go before others. Raises InputError where
        two are left."""
        places = self.places(ours)
        places = [at for at in places if names.is_exact(self.names[at])] or places
        if len(places) > 1:
            if len({self.names[at].lower() for at in places}) == 1:
                raise InputError(f"two columns are named {self.names[places[0]]!r}: rename or remove one of them.")
            kinds = names.READINGS if ours in names.READINGS and self.has(*names.READINGS) else (ours,)
            example = " ".join(f"--column {f'{self.header[self.places(kind)[0]]}={kind}'!r}" for kind in kinds)
            raise InputError(
                f"columns {self.named(places)} are all taken for {ours}: say which it is, for example by {example}."
            )
        return places[0] if places else None

    def has(self, *wanted: str) -> bool:
        """Whether there is a column of each of these kinds."""
        return all(self.places(ours) for ours in wanted)

    def named(self, places: Sequence[int]) -> str:
        """The names of columns, quoted."""
        return ", ".join(repr(cut(self.header[at], 40)) for at in places)

    def is_chosen(self, row: CsvRow) -> bool:
        """Whether a row counts."""
        return self.chosen is None or row[self.chosen[0]].strip() == self.chosen[1]

    @property
    def unknown(self) -> list[int]:
        """Indices of the columns whose names say nothing."""
        return [k for k, own in enumerate(self.meanings) if not own.ours and not own.other]

    @property
    def unused(self) -> list[int]:
        """Indices of the columns that mean nothing here."""
        return [k for k, own in enumerate(self.meanings) if not own.ours and self.header[k]]

    @property
    def _all(self) -> str:
        return cut(self.named(range(len(self.header))), 300)

    @property
    def _left_over(self) -> str:
        """The name of a column that means nothing yet, if possible one of numbers, for an example."""
        return next((self.header[k] for k in sorted(self.unused, key=self._are_numbers, reverse=True)), "THEIRS")

    def numbers_in(self, rows: Sequence[CsvRow]) -> Numbers | None:
        """How the numbers in rows are written; None where these do not tell."""
        used = [at for at, own in enumerate(self.meanings) if own.ours] or range(len(self.names))
        cells = (row[at] for row in rows if len(row) == len(self.names) for at in used)
        return Numbers.told_by(cells, commas_count=self.heading.delimiter != ",")

    def values(self, places: Sequence[int]) -> Floats:
        """The numbers (n, k) in columns, NaN where there is none."""
        values = [self.numbers.values([row[at] for at in places]) for row in self.rows]
        return np.array(values, float).reshape(-1, len(places))

    def _finite(self, place: int) -> Floats:
        """Return the numbers (n,) in a column, without what is none."""
        values = self.values([place])[:, 0]
        return values[np.isfinite(values)]

    # -- what kind of text it is --

    @property
    def may_be_samples(self) -> bool:
        """Whether rows are many, and there is nothing of what only a table of dwells has: numbers of readings,
        deviations, faces."""
        return len(self.rows) > _FEWEST_SAMPLES and not any(own.ours in _MARKS_OF_TABLES for own in self.meanings)

    @property
    def orientation(self) -> str:
        """How orientations are told: ``attitude``, ``angles`` or, of a table, ``face``; empty if they are not.

        Angles go before an attitude where they are named as those of gimbals or in a unit."""
        if self.is_table and self.has("face"):
            return "face"
        are_usual = any(own.ours == "angle" and (own.rank or own.unit) for own in self.meanings)
        return "attitude" if self.has(*names.QUATERNION) and not are_usual else "angles" if self.has("angle") else ""

    # -- quantities --

    def time(self) -> Stamps:
        """How the time is written. Raises InputError where no column tells it, or not in which unit."""
        if self.units.rate_hz is not None:
            return self._at_rate(self.units.rate_hz, " (--rate)")
        filled = [at for at in self.places("time") if any(row[at].lower() not in NOTHING for row in self.rows)]
        places = filled if self.rows else self.places("time")
        exact = [at for at in places if names.is_exact(self.names[at])]
        ways = [way for at in exact or places if (way := self._stamps_in(at, places))]
        if parts := self._parts_of_time(ways):
            ways.append(parts)
        if not (ways or self.is_table) and self.heading.rate_hz is not None:  # rows of a table are not readings
            return self._at_rate(self.heading.rate_hz, ", as is stated above them")
        if not places:
            raise InputError(
                "no column gives the time: name it time_s or time_ns, or give the rate of the rows, for example "
                f"--rate 100; {WANTED}, not {self._all}."
            )
        if not ways:
            raise self._without_time(places[0])
        stamps = min(ways, key=self._unevenness) if len(ways) > 1 else ways[0]
        if self.is_table or not exact:
            zone = " (UTC, since no time zone is named)" * (self.is_table and not (stamps.units_ns or stamps.has_zone))
            units = [name for ns in stamps.units_ns for name, s in names.TIME.items() if ns == s * 1e9]
            unit = f" in {' and '.join(units)}" * bool(units)
            self.said.append(f"time from {self.named(stamps.at)}{unit}{zone}")
        return stamps

    def _at_rate(self, rate_hz: float, how: str) -> Stamps:
        """Return the time by the rate of the rows; how: in words, it is known."""
        self.said.append(f"time from the numbers of the rows, {rate_hz:g} of them a second{how}")
        return Stamps((), (), rate_hz=rate_hz)

    def _stamps_in(self, place: int, places: Sequence[int]) -> Stamps | None:
        """How stamps in a column are written, of which the next of ``places`` may have the time of day; None where this
        or their unit is not told."""
        first = next((row[place] for row in self.rows if row[place]), "0")
        if not math.isnan(self.numbers.value(first)) or (self.meanings[place].unit and not are_stamps([first])):
            unit = self.meanings[place].unit or self._unit_of_time(self._finite(place))
            return Stamps((place,), (round(names.TIME[unit] * 1e9),)) if unit else None
        both = places[:2] if place == places[0] else [place]
        rows = [[row[at] for at in both] for row in self.rows if all(row[at] for at in both)]
        for count in (len(both), 1):
            with suppress(ValueError):
                return Stamps.of_dates(both[:count], [" ".join(cells[:count]) for cells in rows])
        return None

    def _parts_of_time(self, ways: Sequence[Stamps]) -> Stamps | None:
        """The sum of columns of which each counts on what one of the next coarser unit has begun, as nanoseconds beside
        whole seconds or beside stamps of a calendar that have no more; None where there are none such."""
        numbers = [(way.units_ns[0], way.at[0], self._finite(way.at[0])) for way in reversed(ways) if way.units_ns]
        parts = {unit: (at, values) for unit, at, values in numbers if (values == np.rint(values)).all()}
        finest = min(parts, default=0)
        parts |= {unit: (at, values) for unit, at, values in numbers if unit < finest}
        units = sorted(parts, reverse=True)
        sizes = [float(parts[unit][1].max(initial=0.0)) * unit for unit in units]
        dated = next((way for way in ways if not way.units_ns), None)
        if len(units) > 1 and all(size <= unit for size, unit in zip(sizes[1:], units, strict=False)):
            return Stamps(tuple(parts[unit][0] for unit in units), tuple(units))
        if dated and units and sizes[0] <= 1e9 and not (self.stamps_ns(dated) % 1e9).any():
            return replace(dated, at=(*dated.at, parts[units[0]][0]), units_ns=(units[0],))
        return None

    def _unevenness(self, stamps: Stamps) -> float:
        """Return how much the steps of stamps differ from the usual one, and how often they do not go up."""
        steps = np.diff(self.stamps_ns(stamps))
        usual = float(np.median(steps)) if len(steps) else 0.0
        if usual <= 0.0:
            return math.inf
        return float(np.median(np.abs(steps - usual))) / usual + float((steps <= 0.0).mean()) * len(stamps.at)

    def stamps_ns(self, stamps: Stamps) -> Floats:
        """The stamps (n,) of the rows that have any."""
        found = list[int]()
        for number, row in enumerate(self.rows):
            with suppress(LineError):
                found.append(stamps.ns(row, self.header, self.numbers, number))
        return np.array(found, float)

    def _unit_of_time(self, values: Floats) -> str:
        """Return the unit of stamps (n,) whose name tells none, by their size or their steps; empty where nothing does.

        It is s of means, and where several stamps have the same whole number."""
        steps = np.abs(np.diff(values))
        step = float(np.median(steps)) if len(steps) else 0.0
        if len(steps) and step == 0.0 and steps.max() == 1.0:
            return "s"
        by_size = names.unit_of_epoch(float(np.abs(values).max(initial=0.0))) or "s" * self.is_table
        return by_size or next((unit for low, high, unit in _OF_STEPS if low < step < high), "")

    def _without_time(self, place: int) -> InputError:
        """That a column gives no time that can be read, or not in which unit."""
        name, first = self.header[place], next((row[place] for row in self.rows if row[place]), "")
        if math.isnan(self.numbers.value(first)):
            return InputError(
                f"no column gives the time: column {self.named([place])} is {cut(first, 40)!r}, write seconds, or "
                "stamps such as 2026-05-04T13:45:00.010+02:00."
            )
        return InputError(
            f"no column gives the time with its unit: say which {name!r} has, for example --column "
            f"'{name}=time_ms', or give the rate of the rows by --rate; {WANTED}, not {self._all}."
        )

    def accel(self) -> QuantityColumns:
        """The three readings as they are written; ``raw`` tells then what in.

        Raises InputError where their columns or their units are not told."""
        places, units = self.reading_places, self.units
        by_name = [self.meanings[at].unit for at in places]
        named, values = units.told_by([self.header[at] for at in places], by_name), self.values(places)
        raw, words, by_size = reading_units(named, values, units)
        if by_size and not np.isfinite(values).all(axis=1).any():
            raise InputError(
                f"no columns give the three readings with their unit: name them ax_mps2, ay_mps2, az_mps2 (or ax_g, "
                f"ax_mg ...), not {self._all}, or state it by --accel-unit, and the size of counts by --accel-scale."
            )
        self.by_size |= {at: by_size for at, unit in zip(places, named, strict=True) if by_size and not unit}
        if raw is None:
            signed = usual_norm(parse_counts(units.counts).signed(values))
            keys = size_of_count(signed)
            raise CountsError(
                f"the readings in {self.named(places)} have a size of {signed:.3g}, so they are counts: give the "
                "size of one by --accel-scale, in m/s^2 or what --accel-unit says, which is by gravity about "
                f"{' '.join(f'{OPTIONS[key]} {value}' for key, value in keys.items())}.", keys
            )  # fmt: skip
        is_stated = units.accel is not None or units.accel_scale != 1.0
        if self.is_table or is_stated or not all(names.is_exact(self.names[at]) for at in places):
            self.said.insert(0, f"{'mean ' * self.is_table}readings from {self.named(places)} in {words}")
        self.raw = raw
        is_made = units.accel_scale != 1.0 or named != by_name or "count" in named  # the names tell less than is known
        if is_made or self.raw.sizes != PLAIN.sizes or self.raw.counts != SIGNED:
            self.written_mps2 = [names.ACCEL.get(unit, 1.0) for unit in by_name]
            self.without_unit = [at for at, unit in zip(places, by_name, strict=True) if unit in ("", "count")]
        else:
            self.written_mps2 = self.raw.factors.tolist()
        return QuantityColumns(tuple(places))

    @property
    def reading_places(self) -> list[int]:
        """The columns of the three readings. Raises InputError where one is missing."""
        places = [at for ours in names.READINGS if (at := self.place(ours)) is not None]
        if len(places) == len(names.READINGS):
            return places
        missing = [ours for ours in names.READINGS if not self.has(ours)]
        example = f"--column '{self._left_over}={missing[0]}_g'"
        raise InputError(
            f"no column was recognised as the {'mean ' * self.is_table}reading of accelerometer "
            f"{' and '.join(ours[1] for ours in missing)} among {self._all}: name "
            f"it, for example {example} (known: {KNOWN})."
        )

    def pose(self, *, needed: bool) -> QuantityColumns:
        """The attitude, or the angles by the usual names, else every column of an angle in the order of the header;
        none where there is none. Raises InputError where they or their unit are not told and they are needed."""
        if self.orientation == "attitude":
            return QuantityColumns(tuple(at for ours in names.QUATERNION if (at := self.place(ours)) is not None))
        places, stated, how = self.angles, self.units.angle, ""
        ranks, units = [self.meanings[at].rank for at in places], [self.meanings[at].unit for at in places]
        if any(ranks) and len(set(ranks)) < len(ranks):
            raise InputError(f"{self.named(places)} name a gimbal twice: leave one out by --column THEIRS=-.")
        for at, unit in zip(places, units, strict=True):
            if stated and unit not in ("", stated):
                raise InputError(
                    f"column {self.named([at])} is in {unit} by its name, and --angle-unit is {stated}: leave out "
                    "--angle-unit, or rename the column by --column."
                )
        if "" in units and not stated:  # rows to come of a log may tell
            values, how = self.values(places), " by their size (--angle-unit)"
            of_table = ("deg" if (values == np.rint(values)).all() else "rad") if self.is_table else ""
            stated = "deg" if (np.abs(values) > 2.0 * math.pi).any() else of_table
            self.by_size |= {at: stated for at, unit in zip(places, units, strict=True) if not unit and stated}
        if not places or ("" in units and not stated):
            if needed:
                raise self.without_angles()
            return QuantityColumns()
        units = [unit or str(stated) for unit in units]
        if self.is_table or not all(names.is_exact(self.names[at]) for at in places):
            words = " and ".join(dict.fromkeys(units))
            self.said.append(f"gimbal angles, outer to inner, from {self.named(places)} in {words}{how}")
        return QuantityColumns(tuple(places), tuple(names.ANGLE[unit] for unit in units))

    @property
    def angles(self) -> list[int]:
        """The columns of gimbal angles, outer to inner: those whose names tell which they are, else all in the order of
        the header."""
        places = self.places("angle")
        ranked = sorted((at for at in places if self.meanings[at].rank), key=lambda at: self.meanings[at].rank)
        return ranked or places

    def without_angles(self) -> InputError:
        """That no angles are there, or none whose unit is known."""
        theirs = next((self.header[at] for at in self.places("angle")), self._left_over)
        kinds = "gimbal angles, attitude or face" if self.is_table else "gimbal angles or attitude"
        face = ", or the face that is up, with cells such as +x or -z" * self.is_table
        return InputError(
            f"no column was recognised as {kinds} among {self._all}, with their unit: name them outer_deg, inner_deg "
            f"... or outer_rad ..., outer gimbal first, for example by --column '{theirs}=outer_deg' (or the attitude "
            f"qx, qy, qz, qw{face}), or do without orientations (--no-angles)."
        )

    def temperature(self) -> tuple[QuantityColumns, str]:
        """The temperature, if there is one, and its unit: ``c``, ``k`` or ``f``."""
        at = self.place("temperature")
        if at is None:
            return QuantityColumns(), "c"
        if self.is_table or not names.is_exact(self.names[at]):
            self.said.append(f"temperature from {self.named([at])} in {(self.meanings[at].unit or 'c').upper()}")
        return QuantityColumns((at,), absent=NOTHING), self.meanings[at].unit or "c"

    # -- what names do not tell --

    def _recognise_numbers(self) -> None:
        """Find time and readings in columns without names."""
        places = [k for k in range(len(self.header)) if self._are_numbers(k)]
        meanings = names.meanings_by_numbers(self.values(places)) if places else ()
        for place, meaning in zip(places, meanings, strict=True):
            if meaning.ours:
                self._guess(place, meaning.ours)
        self.said.append("columns without names are told by their numbers")

    def _recognise_contents(self, stated: set[int]) -> None:
        """Find faces, stamps and readings by what stands in columns of a table whose names say nothing; columns that a
        template has and nobody filled are as if they were not there."""
        for k in set(range(len(self.header))) - stated:
            kind, cells = self.meanings[k].ours, [row[k] for row in self.rows]
            are_faces = [names.face_of(cell) is not None for cell in cells]
            if (kind in _OPTIONAL and not any(cells)) or (kind == "face" and not any(are_faces)):
                self.meanings[k], kind = names.Meaning(), ""
            if kind in ("", "angle") and not self.has("face") and all(are_faces):
                self._guess(k, "face")
            elif kind == "" and not self.has("time") and are_stamps(cells):
                self._guess(k, "time")
        left = [k for k in self.unknown if k not in stated]
        numeric = [] if self.places(*names.READINGS) else [k for k in left if self._are_numbers(k)]
        norms = lengths(self.values(numeric)) if len(numeric) == len(names.READINGS) else np.zeros(0)
        norms = norms[np.isfinite(norms)]
        if norms.size and 0 < norms.max() < _ALIKE * norms.min():
            for k, ours in zip(numeric, names.READINGS, strict=True):
                self._guess(k, ours)

    def _are_stamps(self, place: int) -> bool:
        """Whether a column holds stamps of a calendar or, without a name, seconds or stamps since 1970 that go up."""
        if not (self.rows and self._are_numbers(place)):
            return are_stamps([row[place] for row in self.rows])
        values = self._finite(place)
        steps, since_1970 = np.diff(values), names.unit_of_epoch(float(values.max(initial=0.0)))
        return self.header[place] in ("", names.NAMELESS.format(place + 1)) and bool(
            (steps > 0.0).all() and (since_1970 or (steps % 1.0).any())
        )

    def _guess(self, place: int, ours: str) -> None:
        self.meanings[place] = self.meanings[place]._replace(ours=ours)
        self.guessed.append(self.header[place])

    def _are_numbers(self, place: int) -> bool:
        """Whether most of the cells of a column are numbers."""
        return bool(self.rows) and float(np.mean(np.isfinite(self.values([place])))) >= _MOST_CELLS


def refuse_unknown_names(stated: Mapping[str, str], header: Sequence[str]) -> None:
    """Raise InputError where a column is stated that is not there, or as something that nobody knows."""
    for theirs, ours in stated.items():
        if theirs not in header:
            shown = cut(", ".join(map(repr, header)), 300)
            raise InputError(f"has no column {cut(theirs, 60)!r} (--column), it has {shown}.")
        if ours != "-" and not names.meaning_of(ours).ours:
            raise InputError(f"--column {theirs}={ours}: {cut(ours, 60)!r} is not known: use {KNOWN}, or - for none.")
