"""What a device sends, and how it becomes readings of accelerometers 1, 2, 3 in m/s^2.

    reading_i = sign_i * size * unit * raw number of channel |channels_i|

This is stated once, as bench keys: by options of ``record``, ``live`` or ``replay``, or in the bench file. A recording
made by this program holds the readings (``converted``), and says what they were made of; a calibration says of which
device it is. Of a device whose numbers are the readings already, nothing is written down.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.counts import SIGNED, ConverterCodes, parse_counts
from kf_calib.errors import BenchError
from kf_calib.support.text import cut, number_from
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

CHANNELS = (1, 2, 3)
UNITS = {
    "m/s2": 1.0, "g": STANDARD_GRAVITY_MPS2, "mg": 1e-3 * STANDARD_GRAVITY_MPS2, "ug": 1e-6 * STANDARD_GRAVITY_MPS2,
}  # fmt: skip
"""Units of raw readings, in m/s^2."""
LABELS = {"m/s2": "m/s^2", "g": "g", "mg": "mg", "ug": "ug"}
OPTIONS = {"channels": "--channels", "accel_scale": "--accel-scale", "accel_unit": "--accel-unit", "counts": "--counts"}
"""The bench keys that state a raw input, and the options that do."""
CONVERTED, RESTATE, RESTATING = "converted", "restate_input", " --restate-input"


def parse_channels(text: str) -> tuple[int, int, int]:
    """The channel of the recording that belongs to each accelerometer, from text such as ``"1,-2,3"``; a minus reverses
    its sign."""
    words = text.strip("[] ").replace(",", " ").split()
    try:
        first, second, third = (int(word) for word in words)
    except ValueError:
        first, second, third = 0, 0, 0
    if sorted(map(abs, (first, second, third))) != [1, 2, 3]:
        raise BenchError(
            f"channels {cut(text, 60)!r} name no order: give the channel of accelerometer 1, 2 and 3, each once, with "
            "a minus where it is reversed, for example --channels 1,-2,3."
        )
    return first, second, third


def parse_scale(text: str) -> tuple[float, float, float]:
    """The size of one count of channels 1, 2, 3 from one number for all or three; raises BenchError."""
    words = text.strip("[] ").replace(",", " ").split()
    try:
        sizes = [number_from(word) for word in words]
    except ValueError:
        sizes = []
    sizes = sizes * 3 if len(sizes) == 1 else sizes
    if len(sizes) != 3 or not all(0.0 < size < math.inf for size in sizes):
        raise BenchError(
            f"accel_scale is {cut(text, 60)!r}: give the size of one count, a positive number for all channels or one "
            "for each, in the unit of the readings, for example --accel-scale 3.9e-6 (--channels reverses signs)."
        )
    return sizes[0], sizes[1], sizes[2]


def parse_unit(text: str) -> str:
    """The name in ``UNITS`` of a unit as people write it; raises BenchError."""
    unit = text.strip().replace("^", "").replace("µ", "u").replace("μ", "u").replace("²", "2").replace("mps2", "m/s2")
    if unit not in UNITS:
        raise BenchError(f"accel_unit is {cut(text, 60)!r}: give one of {', '.join(UNITS)}.")
    return unit


@dataclass(frozen=True)
class RawInput:
    """The raw readings of a device.

    - channels: for accelerometers 1, 2, 3 the channel that it is read on, negative where its sign is reversed.
    - sizes: of one count of channels 1, 2, 3, in ``unit``; 1 where the numbers are in the unit itself.
    - unit: one of ``UNITS``.
    - counts: how the numbers are to be read, as ``parse_counts`` takes it.
    """

    channels: tuple[int, int, int] = CHANNELS
    sizes: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str = "m/s2"
    counts: str = SIGNED

    def __post_init__(self) -> None:
        parse_channels(",".join(map(str, self.channels)))
        parse_scale(",".join(map(repr, self.sizes)))
        parse_unit(self.unit)
        parse_counts(self.counts)

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> RawInput:
        """The raw input that bench keys state; raises BenchError."""
        return cls(
            parse_channels(str(metadata.get("channels", "1,2,3"))),
            parse_scale(str(metadata.get("accel_scale", "1"))),
            parse_unit(str(metadata.get("accel_unit", "m/s2"))),
            str(metadata.get("counts", SIGNED)).strip(),
        )

    @classmethod
    def of_factors(cls, factors: float | Sequence[float]) -> RawInput:
        """Channels in the order of the accelerometers; factors: m/s^2 of one count, of all or each, with its sign."""
        x, y, z = np.broadcast_to(np.asarray(factors, float), 3).tolist()
        first, second, third = (int(math.copysign(k, factor)) for k, factor in zip(CHANNELS, (x, y, z), strict=True))
        return cls((first, second, third), (abs(x), abs(y), abs(z)))

    def to_metadata(self) -> dict[str, str]:
        """The bench keys that state it; none where the device sends readings, and no order where it is the usual."""
        return {} if self.is_plain else self.scale_metadata()

    def scale_metadata(self) -> dict[str, str]:
        """The bench keys that state the size of a count, and which channel is which only where that is said, too."""
        order = {} if self.channels == CHANNELS else {"channels": self.order}
        counts = {} if self.counts == SIGNED else {"counts": self.counts}
        return order | {"accel_scale": self.scale, "accel_unit": self.unit} | counts

    @property
    def is_plain(self) -> bool:
        """Whether the raw numbers are the readings."""
        return self == PLAIN

    def restating(self, key: str) -> str:
        """The option that an advice to state another value of a bench key needs, after a blank; nothing where none is
        stated yet."""
        return RESTATING if key in self.to_metadata() else ""

    @property
    def order(self) -> str:
        """The channels as text."""
        return ",".join(map(str, self.channels))

    @property
    def scale(self) -> str:
        """The size of one count as text: one number for all channels where they have the same."""
        return ",".join(map(repr, self.sizes[:1] if len(set(self.sizes)) == 1 else self.sizes))

    @property
    def factors(self) -> Floats:
        """m/s^2 of one raw unit of channels 1, 2, 3."""
        return np.array(self.sizes) * UNITS[self.unit]

    @cached_property
    def matrix(self) -> Floats:
        """A (3, 3): readings = A raw."""
        channels = np.array(self.channels)
        matrix = np.zeros((3, 3))
        matrix[np.arange(3), np.abs(channels) - 1] = np.sign(channels) * self.factors[np.abs(channels) - 1]
        return matrix

    def readings(self, raw: Floats) -> Floats:
        """Readings (n, 3), m/s^2, of accelerometers 1, 2, 3 from raw numbers (n, 3) of channels 1, 2, 3."""
        if self.is_plain:
            return raw
        with np.errstate(over="ignore"):  # what damage has made too large becomes infinite, and is counted as such
            return self.ordered(self.signed(raw) * self.factors)

    def signed(self, raw: Floats) -> Floats:
        """Raw numbers (n, 3) of channels 1, 2, 3 about zero."""
        return raw if self.counts == SIGNED else self._counts.signed(raw)

    @cached_property
    def _counts(self) -> ConverterCodes:
        return parse_counts(self.counts)

    def ordered(self, channels: Floats) -> Floats:
        """Channels (n, 3) in the order and with the signs of the accelerometers, not scaled."""
        if self.channels == CHANNELS:
            return channels
        places = np.array(self.channels)
        return channels[:, np.abs(places) - 1] * np.sign(places)

    def raw(self, readings: Floats) -> Floats:
        """Raw numbers (n, 3) of channels 1, 2, 3 that give these readings (n, 3): what ``readings`` inverts."""
        numbers = np.empty_like(readings)
        for accelerometer, channel in enumerate(self.channels):
            numbers[:, abs(channel) - 1] = math.copysign(1.0, channel) * readings[:, accelerometer]
        numbers = numbers / self.factors
        return numbers if self.counts == SIGNED else self._counts.unsigned(numbers)

    @property
    def unit_words(self) -> str:
        """What one raw number is: a unit, or a count of a size."""
        label = LABELS[self.unit] + ("" if self.counts == SIGNED else f", {self.counts}")
        if self.sizes == (1.0, 1.0, 1.0):
            return label
        one = len(set(self.sizes)) == 1
        return f"counts of {self.scale} {label}" if one else f"counts of {', '.join(map(repr, self.sizes))} {label}"

    @property
    def formula(self) -> str:
        """Readings in m/s^2 from the raw numbers of channels 1, 2, 3, as formulas."""
        return ", ".join(
            f"{axis} = {math.copysign(1.0, channel) * self.factors[abs(channel) - 1]:.12g} channel{abs(channel)}"
            for axis, channel in zip("xyz", self.channels, strict=True)
        )

    def __str__(self) -> str:
        if self.is_plain:
            return "readings in m/s^2, in the order of the accelerometers"
        order = "channels in the order of the accelerometers"
        if self.channels != CHANNELS:
            order = f"accelerometers 1, 2, 3 on channels {', '.join(map(str, self.channels))}"
        return f"raw readings in {self.unit_words}, {order}"


PLAIN = RawInput()
"""Of a device that sends the readings themselves, in m/s^2."""


def text_of(key: str, value: Any) -> str:
    """The text of a key of a raw input from text, a number or a list of JSON or TOML; raises ValueError."""
    if isinstance(value, list | tuple):
        value = ",".join(map(repr, value))
    if isinstance(value, Real) and not isinstance(value, bool) and key == "accel_scale":
        try:
            value = repr(float(value))
        except OverflowError:
            raise ValueError("it must be a finite number") from None
    if not isinstance(value, str):
        raise ValueError("it must be text")
    try:
        raw_input = RawInput.from_metadata({key: value.strip()})
    except BenchError as error:
        raise ValueError(str(error)) from None
    return {
        "channels": raw_input.order, "accel_scale": raw_input.scale, "accel_unit": raw_input.unit,
        "counts": raw_input.counts,
    }[key]  # fmt: skip


@dataclass(frozen=True)
class Conversion:
    """From the numbers of a file to readings.

    - device: the raw input of the device that the file is of.
    - made_by: what the numbers have been converted by already; None where they are raw.
    """

    device: RawInput
    made_by: RawInput | None = None

    def __call__(self, numbers: Floats) -> Floats:
        """Readings (n, 3), m/s^2, of accelerometers 1, 2, 3 from the numbers (n, 3) of the file."""
        if self.made_by == self.device:
            return numbers
        return self.device.readings(numbers if self.made_by is None else self.made_by.raw(numbers))


def merged_metadata(
    recorded: Mapping[str, Any], overrides: Mapping[str, Any], what: str, default: RawInput | None = None
) -> dict[str, Any]:
    """Bench keys of a file (``what``) with those of options over them; default: the raw input where it states none.

    Raises BenchError where options state another raw input than what is stated already, unless they restate it
    (``restate_input``).
    """
    stated = dict(recorded)
    if default is not None and not default.is_plain and not set(OPTIONS) & set(recorded):
        stated, what = stated | default.to_metadata() | {"channels": default.order}, "the calibration"
    shared = () if overrides.get(RESTATE) else set(OPTIONS) & set(stated) & set(overrides)
    for key in sorted(shared):
        try:
            in_file, in_options = text_of(key, stated[key]), text_of(key, overrides[key])
        except ValueError:
            continue  # told where the bench is made of it
        if in_file != in_options:
            raise BenchError(
                f"{OPTIONS[key]} is {in_options}, and {what} states {in_file}: leave it out, or where what is stated "
                "is wrong, say so by --restate-input."
            )
    return {**stated, **overrides}


def conversion(recorded: Mapping[str, Any], stated: Mapping[str, Any]) -> Conversion:
    """How the numbers of a file become readings; recorded: its bench keys, stated: those with what options say."""
    is_converted = recorded.get(CONVERTED) == "true"
    return Conversion(RawInput.from_metadata(stated), RawInput.from_metadata(recorded) if is_converted else None)


LEVELS = (0.5, 2.0)
"""Between these the norm of readings at rest is gravity, whatever their scale factors and biases."""
_NEAR = (0.8, 1.25)


class WrongUnit(NamedTuple):
    """sentence: what shows it, the likely cause, and what to state, without a full stop at the end. option: what states
    the likely unit, or a size of one count that gives gravity."""

    sentence: str
    option: str


def wrong_unit(level: float, stated: RawInput, gravity_mps2: float) -> WrongUnit:
    """The unit that readings are in; level: their norm at rest, made by the raw input that is stated, over gravity."""
    size = float(stated.factors.mean())
    raw = level * gravity_mps2 / size
    for unit, mps2 in UNITS.items():
        if _NEAR[0] <= raw * mps2 / gravity_mps2 <= _NEAR[1]:
            scale = "" if stated.sizes == (1.0, 1.0, 1.0) else " --accel-scale 1"
            option = f"--accel-unit {unit}{scale}{stated.restating('accel_unit')}"
            return WrongUnit(
                f"the readings have a norm of {raw:.4g} at rest, which is gravity in {LABELS[unit]}, not in "
                f"{stated.unit_words}: state it with {option}",
                option,
            )
    about, restating = f"{size / level / UNITS[stated.unit]:.3g}", stated.restating("accel_scale")
    return WrongUnit(
        f"the readings have a norm of {raw:.4g} {stated.unit_words} at rest, {level:.3g} times gravity "
        f"({gravity_mps2:.4g} m/s^2): they look like counts; give the size of one count in {LABELS[stated.unit]}, of "
        f"about {about}, with --accel-scale{restating}",
        f"--accel-scale {about}{restating}",
    )
