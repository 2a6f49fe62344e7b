"""What each key that describes a bench must be: for records in recordings, streams, TOML files, options and Python."""

from __future__ import annotations

import json
from collections.abc import Mapping
from numbers import Real
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import ConfigDict, Field, with_config
from typing_extensions import TypedDict

from kf_calib import paper
from kf_calib.errors import BenchError, how_to_write
from kf_calib.schema import TEXT, Misfit, converted
from kf_calib.text import cut

FORMAT_VERSION = "1"
UP = ("y", "z", "x", "-y", "-z", "-x")
"""Axes that can point up when all angles are zero."""
NUMBERS = ("gravity_mps2", "latitude_deg", "height_m", "azimuth_deg", "angle_sigma_deg", "scatter_sigma_mps2")
FREE_TEXT = ("block_serial", "bench", "operator", "note")


def _between(least: float, most: float) -> Any:
    return Annotated[float, Field(ge=least, le=most, allow_inf_nan=False)]


_OF_SYMBOL = {
    "theta": _between(-6.3, 6.3), "phi": _between(-6.3, 6.3), "K": _between(-10, 10), "b": _between(-100, 100),
    "nu": _between(-0.78, 0.78),  # accelerometer 2 has an axis with y above zero: within 45 deg
}  # fmt: skip
_Nominal = with_config(ConfigDict(extra="forbid"))(
    TypedDict(
        "_Nominal",
        {symbol: _OF_SYMBOL[symbol.rstrip("123")] for symbol in paper.SYMBOLS},  # pyright: ignore  # not written out
        total=False,
    )
)


class Key(NamedTuple):
    """kind: the type that a value is converted to, with its limits. words: what it must be, for people."""

    kind: Any
    words: str


def _number(least: float, most: float, words: str) -> Key:
    return Key(_between(least, most), f"a finite number from {least:g} to {most:g}, {words}")


_WORDS = "text of at most 1000 characters without control characters"
KEYS: Mapping[str, Key] = {
    "format_version": Key(Literal["1"], "1, all that this program reads: update kf_calib"),
    "axes": Key(TEXT, 'axes, outer to inner, such as "y z x"'),
    "joints": Key(TEXT, 'names, outer to inner, such as "outer middle inner"'),
    "channels": Key(TEXT, 'the channels of accelerometers 1, 2, 3, such as "1,-2,3"'),
    "up": Key(
        Literal["y", "z", "x", "-y", "-z", "-x"],
        f"the axis that points up when all angles are zero, one of {', '.join(UP)}: z for sensors and angles as ROS "
        "names them",
    ),
    "reference": Key(
        Literal["base", "inertial"], "base (angles relative to the bench) or inertial (stabilised platform)"
    ),
    "gravity_mps2": _number(1, 30, "local gravity in m/s^2, about 9.8"),
    "latitude_deg": _number(-90, 90, "the latitude in deg"),
    "height_m": _number(-12000, 100000, "the height in m"),
    "azimuth_deg": _number(-360, 360, "the azimuth of the bench's x axis from North toward East in deg"),
    "angle_sigma_deg": _number(0, 180, "the setting error of an orientation, 1 sigma, in deg; leave it out where it is "
                               "not known"),
    "scatter_sigma_mps2": _number(0, 100, "the scatter from dwell to dwell, 1 sigma, in m/s^2; leave it out where it "
                                  "is not known"),
    "nominal": Key(
        _Nominal,
        f'a JSON object such as {{"theta1": 0}} of parameters ({", ".join(paper.SYMBOLS)}) in rad, 1 or m/s^2, nu '
        "within 0.78 rad",
    ),
    **dict.fromkeys(FREE_TEXT, Key(TEXT, _WORDS)),
}  # fmt: skip


def known(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a bench's keys, checked, without numbers that are left empty. Raises BenchError, with the key."""
    for key in metadata:
        if key not in KEYS:
            raise BenchError(f"bench key {cut(key, 60)!r} is not known: use one of {', '.join(sorted(KEYS))}.")
    return {key: checked(key, value) for key, value in metadata.items() if not (key in NUMBERS and value == "")}


def checked(key: str, value: Any) -> Any:
    """The value of a key as its type; numbers and the nominal parameters may be text. Raises BenchError."""
    kind, words = KEYS[key]
    try:
        return converted(_plain(key, value), kind)
    except Misfit as error:
        hint = how_to_write(value) if isinstance(value, str) and key in NUMBERS else ""
        said = cut(repr(value) if isinstance(value, str | Real) else str(value), 60)
        why = f" ({error})" if key == "nominal" else ""
        raise BenchError(f"bench key {key} is {said}{why}, and must be {words}{hint}.") from None


def _plain(key: str, value: Any) -> Any:
    """Text that stands for a number, for JSON or for an axis as that; numbers of numpy as Python's."""
    match value:
        case str() if key == "nominal":
            try:
                return json.loads(value)
            except (ValueError, RecursionError):
                raise Misfit("not JSON") from None
        case str() if key == "up":
            return value.strip().lower().removeprefix("+")
        case str() if key in NUMBERS:
            try:
                return float(value)
            except ValueError:
                return value
        case Mapping():
            return {each: _plain("", size) for each, size in value.items()}
        case Real() if not isinstance(value, int):
            return float(value)
        case _:
            return value
