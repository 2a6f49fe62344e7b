"""What names of columns mean: quantity, channel and unit, in English, German and Russian.

Units of readings and angles where the names of columns tell none are stated, or told by the size of the numbers.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import CHANNELS, PLAIN, RESTATE, UNITS, RawInput
from kf_calib.errors import BenchError, InputError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2, WORDS

ACCEL = {"m/s2": 1.0, **{unit: WORDS["m/s^2"][unit] for unit in ("g", "mg", "ug")}, "count": 1.0}
"""Units of readings in m/s^2; counts as they are."""
ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": WORDS["rad"]["deg"]}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
TEMPERATURE = ("c", "k", "f")
_UNITS = {
    "m/s2": "m/s2 m/s^2 m/s² m/s/s mps2 ms-2 ms^-2 m.s^-2 m*s^-2 m/s**2 m·s⁻² m·s-2 ms⁻² м/с2 м/с^2 м/с²",
    "g": "g gn g0 g_n", "mg": "mg мg", "ug": "ug µg μg мкg",
    "count": "count counts lsb digit digits raw adc",
    "rad": "rad radian radians рад", "mrad": "mrad мрад", "deg": "deg degree degrees grad град град. ° º",
    "s": "s sec second seconds sekunden с сек", "ms": "ms мс", "us": "us µs μs мкс", "ns": "ns", "min": "min мин",
    "h": "h hours ч", "c": "°c ºc c degc deg_c celsius ℃ °с", "k": "k kelvin", "f": "°f f degf fahrenheit",
}  # fmt: skip


def _plain(text: str) -> str:
    """Return a text without accents, the two dots of ä and ё among them."""
    decomposed = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


def _words(text: str) -> frozenset[str]:
    return frozenset(_plain(text).split())


_OF_WORD = {word: unit for unit, words in _UNITS.items() for word in words.split()}
_SPREAD = _words(
    "sd std stdev stddev sigma s rms dev deviation standardabweichung streuung stabw stdabw noise rauschen "
    "ско отклонение сигма разброс шум"
)
_READING = _words(
    "a ac acc accl accel alpha acceleration accelerometer accelerometers beschleunigung beschl f force specific "
    "reading readings imu linear mean avg average mittel mittelwert m sensor channel ch kanal messwert out output "
    "signal value wert raw ускорение ускорения акселерометр среднее средние показание показания датчик канал "
    "значение сигнал"
)
_OTHER = _words(
    "gyro gyr gy gyroscope omega angular velocity rate dps mag magn magnet magnetometer magnetic compass covariance "
    "cov true truth reference groundtruth jerk гироскоп магнитометр"
)
"""Words of quantities that stand beside the readings and are none of ours."""
_OF_READINGS = _words(
    "a ac acc accl accel acceleration accelerometer beschleunigung specific force ускорение акселерометр"
)
"""Words that readings have, and nothing else."""
_ANGLE = _words(
    "outer middle inner aussen mitte mittlerer innen innere innerer aeussere ausserer angle winkel gimbal roll pitch "
    "yaw azimuth elevation tilt achse axis q phi theta psi rotation rot table rahmen "
    "угол рамка рамки ось наружный наружная внешний внешняя внутренний внутренняя крен тангаж курс азимут"
)
_TIME = _words("time zeit date datum stamp timestamp uhrzeit datetime elapsed zeitstempel время дата")
_LENGTH = _words("dwell duration dauer length lange длительность")
_TEMPERATURE = _words("temp temperature temperatur t температура темп")
_COUNT = _words("count counts n samples num number anzahl messungen stichprobe readings werte число количество")
_FACE = _words("face side seite position pose orientation lage richtung direction flache положение грань")
_RANKS = (
    _words("outer aussen aeussere ausserer наружный наружная внешний внешняя"),
    _words("middle mitte mittlerer средний средняя"),
    _words("inner innen innere innerer внутренний внутренняя"),
)
_CHANNELS = frozenset("xyz123ху")
_AXES = str.maketrans("123ху", "xyzxy")  # the last two are Cyrillic letters
_RATE = re.compile(r"(?:deg|degrees?|rad|radians?|°)\s*(?:/|p|per)\s*s|(?:deg|rad)[\s.*·]*s\s*\^?[-−⁻]|dps")
_ATTITUDE = re.compile(r"(.*?)(?:quaternion|quat|orientation|attitude|rotation|q)[\W_]*(?:q[\W_]*)?([0-3wxyz])\W*")
_INDEX = re.compile(r"(.*)\[([012])\]\s*")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_LONGEST = 300  # characters of a name: it is looked at in many ways
_FACES = re.compile(r"['’]?([+\-−–]?)\s*([xyz123])\s*([+\-−–]?|up|down|oben|unten)", re.IGNORECASE)


class Meaning(NamedTuple):
    """ours: ax ay az (readings), sx sy sz or sd (standard deviations), angle, qx qy qz qw, face, time, count,
    temperature; empty if the name means nothing. unit: as the name states it; empty if it does not."""

    ours: str
    unit: str
    rank: int = 0
    """Place of a gimbal whose name tells it: 1 outer, 2 middle, 3 inner; 0 for others."""


def is_unit(text: str) -> bool:
    """Whether a cell is nothing but a unit, or a dash."""
    return text.strip("[]() ").lower() in _OF_WORD or text.strip() in ("-", "1")


NO_HEADER = "has no header: name the columns in a first line, such as time_s,ax_g,ay_g,az_g; it begins with"


def are_numbers(header: Iterable[str]) -> bool:
    """Whether what should be names of columns are numbers: there is no header."""
    return all(re.fullmatch(r"[+\-−]?[\d.,]+(?:[eE][+\-]?\d+)?", name.strip()) for name in header)


def meaning_of(name: str) -> Meaning:
    """What the name of a column says; nothing, where it is longer than any name."""
    name = name if len(name) <= _LONGEST else ""
    told = _meaning_of(name)
    return told if told.ours or not _CAMEL.search(name) else _meaning_of(_CAMEL.sub(" ", name))


def meanings_of(header: Sequence[str]) -> list[Meaning]:
    """What the names of all columns say together.

    Of several columns that are taken for one reading, those count whose names are those of readings alone. Four columns
    of an attitude, by w x y z or 0 to 3 with the real part first, are a quaternion and no gimbals; indices in brackets
    count from 0.
    """
    stems = {match[1] for name in header if (match := _INDEX.fullmatch(name)) and match[2] == "0"}
    named = [
        f"{match[1]} {'xyz'[int(match[2])]}" if (match := _INDEX.fullmatch(name)) and match[1] in stems else name
        for name in header
    ]
    meanings = [meaning_of(name) for name in named]
    for at, part in _quaternion_in(header).items():
        meanings[at] = Meaning(part, "")
    for ours in ("ax", "ay", "az"):
        rivals = [at for at, own in enumerate(meanings) if own.ours == ours]
        likely = [at for at in rivals if {*_tokens(_CAMEL.sub(" ", named[at]).lower())} & _OF_READINGS]
        for at in {*rivals} - {*(likely or rivals)}:
            meanings[at] = Meaning("", "")
    return meanings


def _quaternion_in(header: Sequence[str]) -> dict[int, str]:
    """Return which columns are the parts of a quaternion; none where no four belong together."""
    groups = dict[tuple[str, bool], dict[str, int]]()
    for at, name in enumerate(header):
        if len(name) <= _LONGEST and (match := _ATTITUDE.fullmatch(name.strip().lower())):
            groups.setdefault((match[1], match[2].isdigit()), {}).setdefault(match[2], at)
    for (_, by_number), places in groups.items():
        if len(places) == 4:
            return {at: f"q{'wxyz'[int(part)] if by_number else part}" for part, at in places.items()}
    return {}


def _meaning_of(name: str) -> Meaning:
    lowered = name.strip().lower()
    if lowered in ("qx", "qy", "qz", "qw", "-"):
        return Meaning("" if lowered == "-" else lowered, "")
    if _RATE.search(lowered):
        return Meaning("", "")
    text, unit = _unit_of(lowered)
    tokens = _tokens(text)
    channel = next((each for each in tokens if each in _CHANNELS), "").translate(_AXES)
    words = set(tokens) - _CHANNELS
    if words & _OTHER:
        return Meaning("", "")
    if words & _LENGTH:
        return Meaning("", unit)
    if (words & _TIME and (not unit or unit in TIME)) or (unit in TIME and not channel):
        return Meaning("time", unit)
    if words & (_TEMPERATURE - {"t"}) or ("t" in words and unit in TEMPERATURE) or unit == "c":
        return Meaning("temperature", unit if unit in TEMPERATURE else "")
    if unit in ANGLE or (words & _ANGLE and unit not in ACCEL):
        rank = next((k + 1 for k, known in enumerate(_RANKS) if words & known), 0)
        return Meaning("angle", unit if unit in ANGLE else "", rank)
    # a letter s amid a name is no deviation: a_RS_S_x is that of the sensor
    spread = words & (_SPREAD if tokens[:1] == ["s"] or words == {"s"} else _SPREAD - {"s"})
    if spread or {"standard", "deviation"} <= words:
        return Meaning(f"s{channel}" if channel else "sd", unit if unit in ACCEL else "")
    if channel and (words & _READING or not words or unit in ACCEL):
        return Meaning(f"a{channel}", unit if unit in ACCEL else "")
    if words & _FACE:
        return Meaning("face", "")
    if words & _COUNT or lowered in _COUNT:
        return Meaning("count", "")
    return Meaning("", unit)


def face_of(text: str) -> tuple[int, int] | None:
    """Axis (0, 1, 2) and sign of a named face such as +x, -z, ``y up`` or ``z down``; None if it names none."""
    match = _FACES.fullmatch(text.strip())
    if not match:
        return None
    before, axis, after = match.groups()
    if (before and after in tuple("+-−–")) or (axis.isdigit() and not (before or after)):
        return None  # a number alone is one of a list
    reversed_by = [mark in "-−–" if len(mark) == 1 else mark.lower() in ("down", "unten")
                   for mark in (before, after) if mark]  # fmt: skip
    return "xyz123".index(axis.lower()) % 3, -1 if sum(reversed_by) % 2 else 1


def _unit_of(name: str) -> tuple[str, str]:
    """Return a name without its unit, and the unit: in brackets, or after a slash, a comma, ``in`` or an underscore."""
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]", name)
    if match and (unit := match[2].replace(" ", "") if match[2] not in _OF_WORD else match[2]) in _OF_WORD:
        return match[1], _OF_WORD[unit]
    for pattern in (r"(.+)\s+in\s+(\S+)", r"(.+?)\s*,\s*(\S+)", r"(.+)[_ ](\S+)", r"(.+?)\s*/\s*(\S+)"):
        match = re.fullmatch(pattern, name)
        if match and match[2] in _OF_WORD and _is_unit_of(match[2], match[1]):
            return match[1], _OF_WORD[match[2]]
    return name, ""


def _is_unit_of(letter: str, name: str) -> bool:
    """Whether the end of a name is a unit: C, K and F are units of temperatures only, since channels have letters."""
    return letter not in TEMPERATURE or bool(_TEMPERATURE & set(_tokens(name)))


def _tokens(text: str) -> list[str]:
    """Return the words of a name, without accents; a channel that ends a known word becomes a word of its own."""
    tokens = list[str]()
    for word in re.findall(r"[a-zа-я]+|\d+", _plain(text)):
        stem, last = word[:-1], word[-1]
        known = stem in _SPREAD | _READING | _OTHER | {"grav"}
        tokens += [stem, last] if last in "xyz" and known else [word]
    return tokens


_BY_SIZE = (("g", 0.5, 2.0), ("m/s2", 5.0, 20.0), ("mg", 500.0, 2000.0))
"""Units in which the size of gravity lies between two numbers."""
_COUNTS = {
    "1 mm/s^2": 1e-3, "1 cm/s^2": 1e-2,
    **{f"1/{2**k} g": STANDARD_GRAVITY_MPS2 / 2**k for k in range(6, 21)},
}  # fmt: skip
"""Sizes of counts that devices have, m/s^2."""
_ABOUT = 0.07  # of the size of gravity, by which scale factor and bias of a sensor change it
_NEAR = (0.2, 5.0)
"""The norm in g of a sensor that is not shaken hard."""
_IN_WORDS = {"m/s2": "m/s^2", "count": "counts"}


@dataclass(frozen=True)
class Units:
    """Units where the header names none; None: guessed from the numbers.

    accel_scale: size of one count, in ``accel`` (m/s^2 if that is None). g: m/s^2 that 1 g stands for, or ``local``.
    input: what the device of a calibration sends, which holds where none of this is stated. is_restated: whether
    ``accel`` goes before the names of columns.
    """

    accel: str | None = None
    accel_scale: float = 1.0
    angle: str | None = None
    g: str | float = STANDARD_GRAVITY_MPS2
    input: RawInput | None = None
    is_restated: bool = False

    @classmethod
    def of(
        cls, keys: Mapping[str, str], angle: str | None = None, g: str | float = STANDARD_GRAVITY_MPS2,
        input: RawInput | None = None,
    ) -> Units:  # fmt: skip
        """Units as bench keys state them; raises BenchError."""
        stated = RawInput.from_metadata(keys)
        if len(set(stated.sizes)) > 1:
            raise BenchError("accel_scale has a size for each channel: in lines and tables, state one for all.")
        unit = stated.unit if "accel_unit" in keys else None
        default = None if {"accel_unit", "accel_scale"} & set(keys) else input
        return cls(unit, stated.sizes[0], angle, g, default, keys.get(RESTATE) == "true")

    def told_by(self, names: Sequence[str], named: Sequence[str]) -> Sequence[str]:
        """The units of readings (``named``) by the names of their columns, empty where these tell none, or an option
        restates them. Raises InputError where an option states another one."""
        if self.accel and self.is_restated:
            return [""] * len(named)
        for name, unit in zip(names, named, strict=True):
            if self.accel and unit not in ("", "count", self.accel):
                raise InputError(
                    f"column {name!r} is in {unit} by its name, and --accel-unit is {self.accel}: leave out "
                    "--accel-unit, rename the column by --column, or where its name is wrong, add --restate-input."
                )
        return named

    def as_default(self, named: Sequence[str], norm: float) -> bool:
        """Whether readings of this size are what the device of the calibration sends; named: units by their names."""
        if self.input is None or self.input.is_plain:
            return False
        if self.input.sizes == PLAIN.sizes and not {"", "count"} & set(named):
            return False
        level = norm * float(self.input.factors.mean()) / STANDARD_GRAVITY_MPS2
        return set(named) <= {"", "count"} or math.isnan(norm) or _NEAR[0] < level < _NEAR[1]

    def g_mps2(self, local_mps2: float) -> float:
        """What 1 g stands for at a place of this gravity. Raises InputError where that cannot be."""
        if self.g == "local":
            return local_mps2
        try:
            size = float(self.g)
        except ValueError:
            size = 0.0
        if not 9.0 < size < 10.0:
            raise InputError(f"--g-unit is {self.g!r}: give m/s^2 from 9 to 10, such as 9.80665, or local.")
        return size


def choices_in(header: Sequence[str], stated: Mapping[str, str]) -> dict[int, str]:
    """The texts that rows have in the columns by which they are chosen, by the places of these: of what is stated of
    foreign columns, those of ``=VALUE``."""
    return {at: stated[name][1:] for at, name in enumerate(header) if stated.get(name, "").startswith("=")}


def likely_count(norm: float) -> tuple[float, str]:
    """The size of one count, m/s^2, if gravity has the size ``norm`` in counts, and which usual one it is; "" and
    gravity over the norm where it is none."""
    if not norm > 0.0:
        return math.nan, ""
    nearest = min(_COUNTS, key=lambda name: abs(math.log(norm * _COUNTS[name] / STANDARD_GRAVITY_MPS2)))
    is_near = abs(norm * _COUNTS[nearest] / STANDARD_GRAVITY_MPS2 - 1.0) < _ABOUT
    return (_COUNTS[nearest], nearest) if is_near else (STANDARD_GRAVITY_MPS2 / norm, "")


class ReadingUnits(NamedTuple):
    """Units of the three readings.

    units: of each. raw: the sizes of the numbers. words: how the unit is said. by_size: whether the numbers told it.
    is_known: whether anything did.
    """

    units: tuple[str, ...]
    raw: RawInput
    words: str
    by_size: bool
    is_known: bool


def reading_units(named: Sequence[str], norm: float, stated: Units, local_mps2: float) -> ReadingUnits:
    """The units of three readings.

    named: units by the names of their columns, empty where these tell none. norm: size of the readings at rest as they
    are written, from which a unit is told that neither a name nor ``stated`` tells.
    """
    if stated.as_default(named, norm):
        assert stated.input is not None
        default = replace(stated.input, channels=CHANNELS)
        return ReadingUnits((default.unit,) * 3, default, f"{default.unit_words}, as of the calibration", False, True)
    size = norm * stated.accel_scale
    by_size = next((unit for unit, low, high in _BY_SIZE if low < size < high), "count")
    units = [unit if unit not in ("", "count") else stated.accel or ("m/s2" if unit else by_size) for unit in named]
    is_guessed = "" in named and not stated.accel
    words = " and ".join(dict.fromkeys(_IN_WORDS.get(unit, unit) for unit in units))
    if stated.accel_scale != 1.0 or "count" in named:
        words = f"counts of {stated.accel_scale:g} {words}"
    words += " by their size (--accel-unit)" * is_guessed
    if any(unit.endswith("g") for unit in units):
        words += f", 1 g = {stated.g_mps2(local_mps2):.7g} m/s^2 (--g-unit)"
    is_known = bool(stated.accel) or stated.accel_scale != 1.0 or "count" not in (*units, *named)
    raw = _raw(units, stated, mps2_per(units, stated, local_mps2))
    return ReadingUnits(tuple(units), raw, words, is_guessed, is_known)


def _raw(units: Sequence[str], stated: Units, mps2: Floats) -> RawInput:
    """Return the sizes of the numbers: in the unit that they are written in, where that is one for all."""
    if len(set(units)) == 1 and UNITS.get(units[0]) == mps2[0]:
        return RawInput(sizes=(stated.accel_scale, stated.accel_scale, stated.accel_scale), unit=units[0])
    return RawInput.of_factors((stated.accel_scale * mps2).tolist())


def mps2_per(units: Sequence[str], stated: Units, local_mps2: float) -> Floats:
    """The size of each of these units, m/s^2."""
    return np.array(
        [
            ACCEL[unit] * (stated.g_mps2(local_mps2) / STANDARD_GRAVITY_MPS2 if unit.endswith("g") else 1.0)
            for unit in units
        ]
    )
