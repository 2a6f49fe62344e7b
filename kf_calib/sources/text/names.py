"""What names of columns mean: quantity, channel and unit, in English, German and Russian.

A name tells by its words; what it leaves open, the others beside it tell: a number that counts from 0 is a channel, of
two sets of readings one is of the accelerometer, and angles beside a gyroscope are what the device itself estimates.
"""

from __future__ import annotations

import re
import unicodedata
from typing import NamedTuple

from kf_calib.support.units import WORDS

ACCEL = {"m/s2": 1.0, **{unit: WORDS["m/s^2"][unit] for unit in ("g", "mg", "ug")}, "count": 1.0}
"""Units of readings in m/s^2; counts as they are."""
ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": WORDS["rad"]["deg"]}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
TEMPERATURE = ("c", "k", "f")
_UNITS = {
    "m/s2": "m/s2 m/s^2 m/s² m/s/s mps2 ms-2 ms^-2 m/s**2 m·s⁻² m·s-2 ms⁻² м/с2 м/с^2 м/с²",
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
    "a acc accl accel acceleration accelerometer accelerometers beschleunigung beschl f force specific reading "
    "readings imu linear mean avg average mittel mittelwert m sensor channel ch kanal messwert out output signal "
    "value wert raw ускорение ускорения акселерометр среднее средние показание показания датчик канал значение сигнал"
)
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
_RATE = re.compile(r"(?:deg|degrees?|rad|radians?|°)\s*(?:/|p|per)\s*s|dps")
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


def meaning_of(name: str) -> Meaning:
    """What the name of a column says; nothing, where it is longer than any name."""
    name = name if len(name) <= _LONGEST else ""
    told = _meaning_of(name)
    return told if told.ours or not _CAMEL.search(name) else _meaning_of(_CAMEL.sub(" ", name))


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
    if words & _LENGTH:
        return Meaning("", unit)
    if (words & _TIME and (not unit or unit in TIME)) or (unit in TIME and not channel):
        return Meaning("time", unit)
    if words & (_TEMPERATURE - {"t"}) or ("t" in words and unit in TEMPERATURE) or unit == "c":
        return Meaning("temperature", unit if unit in TEMPERATURE else "")
    if unit in ANGLE or (words & _ANGLE and unit not in ACCEL):
        rank = next((k + 1 for k, known in enumerate(_RANKS) if words & known), 0)
        return Meaning("angle", unit if unit in ANGLE else "", rank)
    if words & _SPREAD or {"standard", "deviation"} <= words:
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
    if match and match[2] in _OF_WORD:
        return match[1], _OF_WORD[match[2]]
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
        known = stem in _SPREAD | _READING | {"grav"}
        tokens += [stem, last] if last in "xyz" and known else [word]
    return tokens
