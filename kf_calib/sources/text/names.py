"""What names of columns mean: quantity, channel and unit, in English, German and Russian.

A name tells by its words; what it leaves open, the others beside it tell: a number that counts from 0 is a channel, of
two sets of readings one is of the accelerometer, and angles beside a gyroscope are what the device itself estimates.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.raw_input import UNITS
from kf_calib.support.units import WORDS

ACCEL = {**UNITS, "mm/s2": 1e-3, "cm/s2": 1e-2, "ft/s2": 0.3048, "in/s2": 0.0254, "count": 1.0}
"""Units of readings in m/s^2; counts as they are."""
ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": WORDS["rad"]["deg"]}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
TEMPERATURE = ("c", "k", "f")
READINGS, SPREADS = ("ax", "ay", "az"), ("sx", "sy", "sz")
QUATERNION = ("qx", "qy", "qz", "qw")
_SHORTEST_TIME = 2
"""Letters of a unit that is the name of a time; a shorter one may be a letter for something else."""


def _plain(text: str) -> str:
    """Return a text without accents, the two dots of ä and ё among them."""
    decomposed = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


VOCABULARY = tomllib.loads(Path(__file__).with_name("words.toml").read_text("utf-8"))
"""The words that tell what is in a text."""
_UNIT_OF_WORD = {word: unit for unit, words in VOCABULARY["units"].items() for word in words.split()}
_KINDS = {kind: frozenset(_plain(words).split()) for kind, words in VOCABULARY["kinds"].items()}
_READING = _KINDS["reading"] | _KINDS["force"]
_PREFIXES = _READING | _KINDS["spread"] | {"s", "grav"}
_CHANNELS = frozenset("xyz123ху")
_AXES = str.maketrans("123ху", "xyzxy")  # the last two are Cyrillic letters
_RATE = re.compile(r"(?:deg|degrees?|rad|radians?|°)(?:\s*(?:/|p|per)\s*s|[\s·]*s\s*\^?-1)|dps")
_EXACT = re.compile(
    r"time_(ns|us|ms|s)|a[xyz]_(mps2|g|mg|ug)|q[xyzw]|(outer|middle|inner)_(deg|rad)|temperature_c", re.IGNORECASE
)
_OF_EPOCH = ((1e18, "ns"), (1e15, "us"), (1e12, "ms"))
"""From which size on, and up to five times it, a stamp without a unit is one since 1970 in this unit: 2001 to 2128."""
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_LONGEST = 300  # characters of a name: it is looked at in many ways
_FACES = re.compile(r"['’]?([+\-−–]?)\s*([xyz123])\s*([+\-−–]?|up|down|oben|unten)", re.IGNORECASE)


class Meaning(NamedTuple):
    """What a column holds.

    ours: ax ay az (readings), sx sy sz or sd (standard deviations), angle, qx qy qz qw, face, time, count, temperature;
    empty if the name means nothing. unit: as the name states it; empty if it does not. rank: place of a gimbal whose
    name tells it: 1 outer, 2 middle, 3 inner; 0 for others. other: what it is that is of no use here: ``rate`` and
    ``field`` of a gyroscope and a magnetometer, ``attitude`` that the device itself estimates, ``true`` for what
    readings should be, or ``covariance``.
    """

    ours: str = ""
    unit: str = ""
    rank: int = 0
    other: str = ""


def is_unit(text: str) -> bool:
    """Whether a cell is nothing but a unit, or a dash."""
    return bool(_unit_named(text)) or text.strip() in ("-", "1")


def is_exact(name: str) -> bool:
    """Whether a name is one of docs/format.md, to the letter: it goes before all others."""
    return _EXACT.fullmatch(name.strip()) is not None


def meaning_of(name: str) -> Meaning:
    """What the name of a column says; nothing, where it is longer than any name."""
    name = name if len(name) <= _LONGEST else ""
    channel = name.rpartition(":")[2]  # behind the name of its device
    ways = map(_meaning_of, dict.fromkeys([channel, _CAMEL.sub(" ", channel), name, _CAMEL.sub(" ", name)]))
    first = next((told for told in ways if told.ours or told.other), None)
    return first or Meaning("", _unit_of(name.strip().lower())[1])


def _meaning_of(name: str) -> Meaning:
    lowered = name.strip().lower()
    if lowered in QUATERNION or lowered == "-":
        return Meaning(lowered.strip("-"))
    text, unit = _unit_of(lowered)
    tokens = _tokens(text)
    channels = sorted(filter(_CHANNELS.__contains__, tokens), key=str.isdigit)  # acc2_x is the x of a second one
    channel = "".join(channels[:1]).translate(_AXES)
    words = set(tokens) - _CHANNELS
    kinds = {kind for kind, known in _KINDS.items() if words & known}
    of_accel = unit if unit in ACCEL else ""
    if "covariance" in kinds:
        return Meaning(other="covariance")
    is_rate = "gyroscope" in kinds or ("w" in words and channel and not kinds & {"face", "quaternion"})
    if is_rate or _RATE.search(lowered):
        return Meaning(other="rate")
    if "magnetometer" in kinds or ("mg" in words and "force" not in kinds):
        return Meaning(other="field")
    if "face" in kinds and (channel or "w" in words):
        return Meaning(other="attitude")
    if "length" in kinds:
        return Meaning("", unit)
    if ("time" in kinds and (not unit or unit in TIME)) or (
        unit in TIME and not (channel and (words or lowered[-1].isalpha()))  # X [s] is the horizontal axis of a plot
    ):
        return Meaning("time", unit)
    if words & (_KINDS["temperature"] - {"t"}) or ("t" in words and unit in (*TEMPERATURE, "deg")) or unit == "c":
        return Meaning("temperature", unit if unit in TEMPERATURE else "")
    is_angle = words - _KINDS["axis"] & _KINDS["angle"] or words <= _KINDS["angle"]
    if unit in ANGLE or ("angle" in kinds and unit not in ACCEL and is_angle):
        rank = next((k for k, gimbal in enumerate(("outer", "middle", "inner"), 1) if gimbal in kinds), 0)
        return Meaning("angle", unit if unit in ANGLE else "", rank)
    if "spread" in kinds or ("s" in words and words <= _READING | {"s"}):
        return Meaning(f"s{channel}" if channel else "sd", of_accel)
    if channel and (words & _READING or not words or of_accel):
        return Meaning("", unit, other="true") if "truth" in kinds else Meaning(f"a{channel}", of_accel)
    if "face" in kinds:
        return Meaning("face")
    return Meaning("count") if "count" in kinds else Meaning("", unit)


def meanings_of(names: Sequence[str], stated: Mapping[str, str]) -> list[Meaning]:
    """What the names of the columns of one file say together; stated: ours of theirs, which go before all others."""
    meanings = [meaning_of(name) for name in names]
    _tell_families(names, meanings)
    words = [{*_tokens(_CAMEL.sub(" ", name[:_LONGEST]).lower()), *_tokens(name[:_LONGEST].lower())} for name in names]
    if any(own.other in ("rate", "field") for own in meanings):
        for k, meaning in enumerate(meanings):  # the device has estimated them from these very readings
            is_angle = (
                meaning.ours == "angle" and not meaning.rank and bool(words[k] & (_KINDS["estimated"] | set("xyz")))
            )
            if is_angle or (meaning.ours in QUATERNION and not is_exact(names[k])):
                meanings[k] = Meaning(other="attitude")
    # of several columns taken for a reading, those count whose names say most that they are the accelerometer's
    strengths = [
        (is_exact(name), not own & _KINDS["lesser"], bool(own & _KINDS["force"]))
        for own, name in zip(words, names, strict=True)
    ]
    for ours in READINGS:
        places = [k for k, own in enumerate(meanings) if own.ours == ours]
        best = max((strengths[k] for k in places), default=None)
        for k in places:
            meanings[k] = meanings[k] if strengths[k] == best else Meaning("", meanings[k].unit)
    said = {k: meaning_of(stated[name]) for k, name in enumerate(names) if name in stated}
    kinds = {own.ours for own in said.values()} - {"", "angle", "time"}
    meanings = [Meaning("", own.unit) if own.ours in kinds else own for own in meanings]
    for k, told in said.items():
        meanings[k] = told if told.unit or not told.ours else told._replace(unit=meanings[k].unit)
    return meanings


def _tell_families(names: Sequence[str], meanings: list[Meaning]) -> None:
    """Tell names that differ in their last word alone: the four parts of a quaternion, and channels that count from 0
    on."""
    families = dict[tuple[str, ...], dict[str, int]]()
    for k, name in enumerate(names):
        *stem, last = _tokens(_unit_of(_CAMEL.sub(" ", name[:_LONGEST]).strip().lower())[0]) or [""]
        families.setdefault(tuple(stem), {}).setdefault(last, k)
    for stem, places in families.items():
        parts = next((each for each in ("xyzw", "1230") if set(places) >= set(each)), "")
        if parts and set(stem) & _KINDS["quaternion"]:
            for part, ours in zip(parts, QUATERNION, strict=True):
                meanings[places[part]] = Meaning(ours)
        elif set(filter(str.isdigit, places)) == {"0", "1", "2"}:
            for channel, last in zip("xyz", "012", strict=True):
                own = meanings[places[last]]
                told = _meaning_of(" ".join((*stem, channel)))
                meanings[places[last]] = told._replace(unit=own.unit or told.unit) if not own.other else own


def unit_of_epoch(size: float) -> str:
    """The unit of a stamp of that size that counts since 1970; empty where none of this size does, as none since a
    device was started."""
    return next((unit for least, unit in _OF_EPOCH if least <= size < 5.0 * least), "")


def face_of(text: str) -> tuple[int, int] | None:
    """Axis (0, 1, 2) and sign of a named face such as +x, -z, ``y up`` or ``z down``; None if it names none."""
    match = _FACES.fullmatch(text.strip())
    if not match:
        return None
    before, axis, after = match.groups()
    marks = [mark.lower() for mark in (before, after) if mark]
    if (before and after in tuple("+-−–")) or (axis.isdigit() and not marks):
        return None  # a number alone is one of a list
    return "xyz123".index(axis.lower()) % 3, (-1) ** sum(mark in ("-", "−", "–", "down", "unten") for mark in marks)


def _unit_named(text: str) -> str:
    """Return the unit that a text is; empty where it is none."""
    plain = unicodedata.normalize("NFKC", text.replace("º", "°")).lower().replace("\u2212", "-")
    return _UNIT_OF_WORD.get(re.sub(r"[\s^*·⋅._()\[\]]", "", plain), "")


def _unit_of(name: str) -> tuple[str, str]:
    """Return a name without its unit, and the unit: in brackets, or after a slash, a comma, ``in`` or an underscore.

    C, K and F are units of temperatures only, since channels have letters.
    """
    match = re.fullmatch(r"(.*?)\s*[\[(]((?:[^\[\]()]|\([^()]*\))*)[\])]", name)
    if match and (unit := _unit_named(match[2])):
        return match[1], unit
    if match and match[2].isdigit():  # the number of a channel, which a unit may stand before
        text, unit = _unit_of(match[1])
        return f"{text}[{match[2]}]", unit
    for pattern in (r"(.+)\s+in\s+(\S+)", r"(.+?)\s*,\s*(\S+)", r"(.+)[_ .](\S+)", r"(.+?)[_ ](\S+)",
                    r"(.+?)\s*/\s*(\S+)"):  # fmt: skip
        match = re.fullmatch(pattern, name)
        unit = match and _unit_named(match[2])
        if match and unit and (match[2] not in TEMPERATURE or _KINDS["temperature"] & set(_tokens(match[1]))):
            return match[1], unit
    unit = _unit_named(name) if len(name) >= _SHORTEST_TIME and name != "min" else ""
    return name, unit if unit in TIME else ""


def _tokens(text: str) -> list[str]:
    """Return the words of a name, without accents; a channel that ends a known word becomes a word of its own."""
    tokens = list[str]()
    for word in re.findall(r"[a-z]+|[а-я]+|\d+", _plain(text)):
        stem, last = word[:-1], word[-1]
        known = (last in "xyz" and stem in _PREFIXES) or (last in "wxyz" and stem in _KINDS["quaternion"] - {"q"})
        tokens += [stem, last] if known else [word]
    return tokens


NAMELESS = "column {}"
"""The name of a column of a text without a heading, counted from 1."""
_MOSTLY = 0.9  # of the steps of a time go up, and of sizes are counted
_LIKE, _CLOSE = 2.0, 0.01


def nameless(count: int) -> list[str]:
    """The names of so many columns that have none."""
    return [NAMELESS.format(k + 1) for k in range(count)]


def is_nameless(header: Sequence[str]) -> bool:
    """Whether columns have no names but their numbers."""
    return bool(header) and list(header) == nameless(len(header))


def meanings_by_numbers(values: Floats) -> list[Meaning]:
    """What columns (n, k) are, NaN where a cell is no number: a first column that goes up is the time, the three beside
    each other whose size changes least are the readings, of those that change. No meaning where there are no such
    three."""
    meanings = [Meaning()] * values.shape[1]
    rises = len(values) > 1 and np.mean(np.diff(values[:, 0]) > 0.0) > _MOSTLY and values.shape[1] > 3
    changes = np.array([len(np.unique(column)) > 1 for column in values.T])
    never = not any(changes[k : k + 3].all() for k in range(int(rises), values.shape[1] - 2))
    spreads = dict[int, float]()
    for k in range(int(rises), values.shape[1] - 2):
        sizes = lengths(values[:, k : k + 3])
        sizes = sizes[np.isfinite(sizes)]
        if len(sizes) and np.median(sizes) > 0.0 and (never or changes[k : k + 3].all()):
            spreads[k] = float(np.quantile(np.abs(sizes - np.median(sizes)), _MOSTLY) / np.median(sizes))
    if not spreads:
        return meanings
    alike = _LIKE * min(spreads.values()) + _CLOSE  # in one pose, columns of nothing may stand beside those that tell
    first = next(k for k, spread in spreads.items() if spread <= alike)
    meanings[first : first + 3] = [Meaning(f"a{axis}") for axis in "xyz"]
    if rises:
        meanings[0] = Meaning("time")
    return meanings
