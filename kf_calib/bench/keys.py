"""The keys that describe a bench, with their types, and the check of their values.

In recordings and streams values are text; in TOML files, options and Python they have their types.

Ranges of gimbal angles in text: limits that must not be left, and zones that must not be entered.

    limits_of("z=-90:90 outer=-170:170", ["y", "z", "x"])     # {1: (-90.0, 90.0), 0: (-170.0, 170.0)}
    zones_of("z=10:40,x=-5:5; y=150:180", ["y", "z", "x"])    # [{1: (10.0, 40.0), 2: (-5.0, 5.0)}, {0: (150.0, 180.0)}]

A gimbal is named by its number (1 is the outer one), its place (outer, middle, inner) or its axis (x, y, z).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from typing import Annotated, Any, Literal, NamedTuple, TypedDict, cast

from kf_calib.bench import paper_parameters
from kf_calib.bench.raw_input import CONVERTED, RESTATE, UNITS, text_of
from kf_calib.errors import BenchError, how_to_write
from kf_calib.support.options import Option
from kf_calib.support.text import COMMANDS, LONGEST, cut, number_from, parse_date

FORMAT_VERSION = "1"
UP = ("y", "z", "x", "-y", "-z", "-x")
"""The axes that can point up when all angles are zero."""
NUMBERS = (
    "gravity_mps2",
    "latitude_deg",
    "height_m",
    "azimuth_deg",
    "angle_sigma_deg",
    "scatter_sigma_mps2",
    "square_sigma_deg",
    "rate_degps",
    "acceleration_degps2",
)
FREE_TEXT = ("block_serial", "bench", "operator", "note")
NOTES = (*FREE_TEXT, "date")


# fmt: off
class StatedBench(TypedDict, total=False):
    """What is stated of a bench beside its recording: it goes before what the recording has."""

    axes: Annotated[str, Option("--axes", 'Gimbal axes, outer to inner, for example "y z x".', "AXES")]
    joints: Annotated[str, Option(
        "--joints", 'Names of the gimbals among the joints of a bag, outer to inner, as "outer middle inner".',
        "NAMES")]
    up: Annotated[str, Option(
        "--up", "Axis that points up when all angles are zero: y (the default; accelerometer 2 reads +g), z as in ROS, "
        "x, -x, -y or -z.", "AXIS")]
    channels: Annotated[str, Option(
        "--channels", "Which channel accelerometer 1, 2, 3 is, with a minus where its sign is reversed: 1,-2,3; a "
        "calibration remembers it.", "N,N,N")]
    gravity_mps2: Annotated[float, Option("--gravity", "Local gravity, m/s^2.", "M/S^2")]
    latitude_deg: Annotated[float, Option(
        "--latitude", "Latitude, deg; gives normal gravity where --gravity is not stated.", "DEG")]
    height_m: Annotated[float, Option("--height", "Height, m, for normal gravity; 0 where it is not stated.", "M")]
    angle_sigma_deg: Annotated[float, Option(
        "--angle-sigma", "How well an orientation repeats, 1 sigma, deg (0: exactly); estimated where it is not "
        "stated.", "DEG", least=0)]
    scatter_sigma_mps2: Annotated[float, Option(
        "--scatter-sigma", "Scatter of each sensor from dwell to dwell, 1 sigma, m/s^2; estimated where it is not "
        "stated.", "M/S^2", least=0)]
    square_sigma_deg: Annotated[float, Option(
        "--square-sigma", "How square the axes of the accelerometers are, 1 sigma, deg, where --no-angles cannot tell; "
        "1 if not stated.", "DEG", least=0, is_open=True)]
    reference: Annotated[str, Option(
        "--reference", "base: angles are relative to the bench (usual); inertial: stabilised platform.", "WORD")]
    azimuth_deg: Annotated[float, Option(
        "--azimuth", "Azimuth of the bench's x axis from North toward East, deg.", "DEG")]
    date: Annotated[str, Option(
        "--date", "When the run began, ISO 8601 (UTC), where its stamps are no dates or wrong ones.", "DATE")]
    nominal: Annotated[str | Mapping[str, float], Option(
        "--nominal", "Nominal parameters that differ, for example '{\"theta1\": 0}'.", "JSON")]


class StatedInput(TypedDict, total=False):
    """What is stated of the numbers that a device sends."""

    accel_unit: Annotated[Literal["m/s2", "g", "mg", "ug"], Option(
        "--accel-unit", "Unit of the readings; a calibration remembers it.",
        default="m/s2; in text, as the header or the numbers tell")]
    accel_scale: Annotated[float | str, Option(
        "--accel-scale", "Size of one count, in the unit of the readings; a calibration remembers it.",
        default="1", least=0, is_open=True)]
    counts: Annotated[str, Option(
        "--counts", "How raw numbers are to be read: unsigned16 (or so many bits), wrap=4.096 (what negative ones are "
        "too large by), offset=512 (the number at no force); a calibration remembers it.", "HOW", "signed")]
    restate_input: Annotated[bool, Option(
        "--restate-input", "What is stated of channels, unit and count was wrong: the options go before it.")]


class BenchKeys(StatedBench, StatedInput, total=False):
    """All that can be stated of a bench."""

    format_version: str
    converted: str
    limits_deg: str
    forbidden_deg: str
    rate_degps: float
    acceleration_degps2: float
    block_serial: str
    bench: str
    operator: str
    note: str


# fmt: on
UNSTATED: BenchKeys = {}

_COMMAND = re.compile(f"[{COMMANDS}]")
_OF_SYMBOL = {
    "theta": (-6.3, 6.3), "phi": (-6.3, 6.3), "K": (-10.0, 10.0), "b": (-100.0, 100.0),
    "nu": (-0.78, 0.78),  # accelerometer 2 has an axis with y above zero: within 45 deg
}  # fmt: skip


def _between(least: float, most: float, value: Any) -> float:
    """Return the value as a number within limits; text and booleans are refused."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError("it must be a valid number")
    if not (isinstance(value, int) or math.isfinite(value)):
        raise ValueError("it must be a finite number")
    if value < least:
        raise ValueError(f"it must be greater than or equal to {least:g}")
    if value > most:
        raise ValueError(f"it must be less than or equal to {most:g}")
    return float(value)


def _text(value: Any) -> str:
    """Return text without control characters."""
    if not isinstance(value, str) or len(value) > LONGEST or _COMMAND.search(value):
        raise ValueError("it must be text without control characters")
    value.encode()  # raises ValueError for an unpaired surrogate
    return value


def _date(value: Any) -> str:
    """Return the text of a date."""
    parse_date(_text(value))  # raises ValueError
    return value


def _one_of(choices: tuple[str, ...], value: Any) -> str:
    """Return the value if it is one of those known."""
    if value not in choices:
        raise ValueError(f"it must be one of {', '.join(choices)}")
    return value


def _true(value: Any) -> bool:
    """Return True, for which text may stand."""
    return _one_of(("true", "True"), str(value)) != ""


def _nominal(value: Any) -> dict[str, float]:
    """Return the values of the paper's parameters by symbol."""
    if not isinstance(value, dict):
        raise ValueError("it must be a valid dictionary")
    nominal = dict[str, float]()
    for symbol, size in value.items():
        label = cut(repr(symbol)[1:-1] if isinstance(symbol, str) else str(symbol), 100)  # no line ends in it
        if symbol not in paper_parameters.SYMBOLS:
            raise ValueError(f"{label}: it is unknown")
        try:
            nominal[symbol] = _between(*_OF_SYMBOL[symbol.rstrip("123")], size)
        except ValueError as error:
            raise ValueError(f"{label}: {error}") from None
    return nominal


class Key(NamedTuple):
    """One key: ``read`` converts its value or raises ValueError, and ``words`` tell a user what the value must be."""

    read: Callable[[Any], Any]
    words: str


def _number(least: float, most: float, words: str) -> Key:
    """Make the key of a number between limits."""
    return Key(partial(_between, least, most), f"a finite number from {least:g} to {most:g}, {words}")


_WORDS = "text of at most 1000 characters without control characters"
KEYS: Mapping[str, Key] = {
    "format_version": Key(partial(_one_of, (FORMAT_VERSION,)), "1, all that this program reads: update kf_calib"),
    "axes": Key(_text, 'axes, outer to inner, such as "y z x"'),
    "joints": Key(_text, 'names, outer to inner, such as "outer middle inner"'),
    "channels": Key(partial(text_of, "channels"), 'the channels of accelerometers 1, 2, 3, such as "1,-2,3"'),
    "accel_scale": Key(partial(text_of, "accel_scale"), "the size of one count, positive, or one for each channel"),
    "accel_unit": Key(partial(text_of, "accel_unit"), f"the unit of the raw readings, one of {', '.join(UNITS)}"),
    "counts": Key(partial(text_of, "counts"), "how the raw numbers are to be read, such as unsigned16 or offset=512"),
    CONVERTED: Key(partial(_one_of, ("true",)), "true, or left out: the samples are readings of the accelerometers "
                   "already, and no raw input"),
    RESTATE: Key(_true, "true, or left out: a raw input that is stated goes before the file's"),
    "up": Key(
        partial(_one_of, UP),
        f"the axis that points up when all angles are zero, one of {', '.join(UP)}: z for sensors and angles as ROS "
        "names them",
    ),
    "reference": Key(
        partial(_one_of, ("base", "inertial")),
        "base (angles relative to the bench) or inertial (stabilised platform)",
    ),
    "gravity_mps2": _number(1, 30, "local gravity in m/s^2, about 9.8"),
    "latitude_deg": _number(-90, 90, "the latitude in deg"),
    "height_m": _number(-12000, 100000, "the height in m"),
    "azimuth_deg": _number(-360, 360, "the azimuth of the bench's x axis from North toward East in deg"),
    "angle_sigma_deg": _number(0, 180, "the setting error of an orientation, 1 sigma, in deg; leave it out where it is "
                               "not known"),
    "scatter_sigma_mps2": _number(0, 100, "the scatter from dwell to dwell, 1 sigma, in m/s^2; leave it out where it "
                                  "is not known"),
    "square_sigma_deg": _number(1e-4, 45, "how square the axes are, 1 sigma, in deg, for runs without angles"),
    "limits_deg": Key(_text, 'ranges of gimbals in deg, such as "outer=-170:170 z=-90:90"'),
    "forbidden_deg": Key(_text, 'zones that gimbals must not enter, in deg, such as "z=10:40,x=-5:5; y=150:180"'),
    "rate_degps": _number(1e-3, 1e4, "the greatest rate of a gimbal in deg/s"),
    "acceleration_degps2": _number(1e-3, 1e5, "the greatest acceleration of a gimbal in deg/s^2"),
    "nominal": Key(
        _nominal,
        f'a JSON object such as {{"theta1": 0}} of parameters ({", ".join(paper_parameters.SYMBOLS)}) in rad, 1 or '
        "m/s^2, nu within 0.78 rad",
    ),
    "date": Key(_date, "when the run began, such as 2024-05-31 or 2024-05-31T14:05 (UTC) or 2024-05-31T14:05+02:00"),
    **dict.fromkeys(FREE_TEXT, Key(_text, _WORDS)),
}  # fmt: skip


def checked_keys(metadata: Mapping[str, Any]) -> BenchKeys:
    """The checked values of a bench's keys, without numbers that were left empty; raises BenchError, naming the key."""
    for key in metadata:
        if key not in KEYS:
            raise BenchError(f"bench key {cut(key, 60)!r} is not known: use one of {', '.join(sorted(KEYS))}.")
    values = {key: checked(key, value) for key, value in metadata.items() if not (key in NUMBERS and value == "")}
    return cast(BenchKeys, values)


def checked(key: str, value: Any) -> Any:
    """The value of a key, converted to its type; numbers and nominal parameters may be given as text. Raises
    BenchError."""
    read, words = KEYS[key]
    try:
        return read(_plain(key, value))
    except ValueError as error:
        hint = how_to_write(value) if isinstance(value, str) and key in NUMBERS else ""
        shown_value = cut(repr(value) if isinstance(value, str | Real) else str(value), 60)
        why = f" ({error})" if key == "nominal" else ""
        raise BenchError(f"bench key {key} is {shown_value}{why}, and must be {words}{hint}.") from None


def _plain(key: str, value: Any) -> Any:
    """Convert text that stands for a number, for JSON or for an axis, and numbers of numpy to those of Python."""
    match value:
        case str() if key == "nominal":
            try:
                return json.loads(value)
            except (ValueError, RecursionError):
                raise ValueError("not JSON") from None
        case str() if key == "up":
            return value.strip().lower().removeprefix("+")
        case str() if key in NUMBERS:
            try:
                return number_from(value)
            except ValueError:
                return value
        case Mapping():
            return {each: _plain("", size) for each, size in value.items()}
        case Real() if not isinstance(value, int):
            return float(value)
        case _:
            return value


_PLACES = ("outer", "middle", "inner")
Range = tuple[float, float]


def gimbal_named(text: str, axes: Sequence[str]) -> int:
    """Number of a gimbal, from 0, by its name; axes: names of the axes, outer to inner. Raises BenchError."""
    count, letters = len(axes), [name.lstrip("-") for name in axes]
    places = dict(zip(_PLACES if count == 3 else ("outer", "inner")[:count], range(count), strict=False))
    numbers = {str(j + 1): j for j in range(count)}
    by_letter = {letter: j for j, letter in enumerate(letters) if letters.count(letter) == 1}
    known = numbers | places | by_letter
    if text not in known:
        raise BenchError(f"gimbal {cut(text, 60)!r} is not known: use one of {', '.join(known)}.")
    return known[text]


def ranges(text: str, axes: Sequence[str]) -> dict[int, Range]:
    """Ranges in deg by gimbal from text such as ``z=-90:90`` or ``outer=0:30,x=-10:10``; raises BenchError."""
    by_gimbal = dict[int, Range]()
    for part in text.split(","):
        name, equals, ends = part.strip().partition("=")
        low, colon, high = ends.partition(":")
        try:
            low_deg, high_deg = float(low), float(high)
        except ValueError:
            low_deg = high_deg = math.nan
        if not (equals and colon and -360.0 <= low_deg <= high_deg <= 360.0 and high_deg - low_deg <= 360.0):
            raise BenchError(
                f"{cut(part.strip(), 60)!r} is no range of a gimbal: write AXIS=LOW:HIGH in deg, as in z=-90:90."
            )
        by_gimbal[gimbal_named(name, axes)] = low_deg, high_deg
    return by_gimbal


def limits_of(text: str, axes: Sequence[str]) -> dict[int, Range]:
    """The limits by gimbal, from ranges that spaces, commas or semicolons part; raises BenchError."""
    parts = text.replace(";", " ").replace(",", " ").split()
    return ranges(",".join(parts), axes) if parts else {}


def zones_of(text: str, axes: Sequence[str]) -> list[dict[int, Range]]:
    """The forbidden zones, which semicolons part; each has ranges of gimbals, parted by commas. Raises BenchError."""
    return [ranges(part, axes) for part in text.split(";") if part.strip()]
