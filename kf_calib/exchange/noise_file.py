"""The noise of a recording's sensors as a file, ``kf-calib noise --save``: JSON in SI units, of one version.

saved = open_noise("noise.json")
saved.channels[0].terms["white"].value     # m/s^2/√Hz
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from kf_calib.errors import InputError
from kf_calib.exchange.calibration_file import now
from kf_calib.exchange.calibration_parts import FilePart, FiniteNumber, Positive, Sha256, Text, first_misfit
from kf_calib.noise.power_laws import TERMS
from kf_calib.noise.rest_noise import ChannelNoise, RestNoise
from kf_calib.support.output_files import write_whole
from kf_calib.support.text import cut, sentence

NOISE_FORMAT = "kf_calib.noise"
_LARGEST_BYTES = 1_000_000
_MOST = 100  # channels, and sizes of clusters
_HOW = "give a file that kf-calib noise --save has written"
TermName = Literal["quantisation", "white", "bias_instability", "random_walk"]


class SavedSize(FilePart):
    """Size of a term and its 95 % interval; value is null where it is not seen: high is then a limit, low is 0."""

    value: Positive | None
    low: Positive
    high: Positive | None

    @model_validator(mode="after")
    def _is_in_order(self) -> SavedSize:
        high = self.low if self.high is None else self.high
        if not self.low <= high or (self.value is not None and not self.low <= self.value <= (self.high or self.value)):
            raise ValueError("low, value and high are not in ascending order")
        return self


class SavedChannel(FilePart):
    """The noise of a channel, in ``unit`` and s; terms is null where ``why_not`` says why it has no sizes."""

    name: Text
    unit: Literal["m/s^2", "rad/s", "K"]
    rate_hz: Positive
    reading_sigma: Positive | None
    terms: dict[TermName, SavedSize] | None
    from_s: Positive | None
    taus_s: Annotated[list[Positive], Field(max_length=_MOST)]
    deviations: Annotated[list[FiniteNumber], Field(max_length=_MOST)]
    why_not: Text

    @model_validator(mode="after")
    def _is_whole(self) -> SavedChannel:
        if self.terms is not None and set(self.terms) != {*TERMS}:
            raise ValueError(f"terms must be {', '.join(TERMS)}")
        if len(self.taus_s) != len(self.deviations):
            raise ValueError("taus_s and deviations are not of one length")
        return self


class SavedRestNoise(FilePart):
    """The content of the file. readings, rest_s: at rest, of the accelerometers."""

    format: Literal["kf_calib.noise"]
    version: Literal[1]
    recording: Text
    sha256: Sha256 | None
    readings: Annotated[int, Field(ge=1)]
    rest_s: Positive
    channels: Annotated[list[SavedChannel], Field(max_length=_MOST)]
    created: Text
    program: Text

    def of_unit(self, unit: str) -> list[SavedChannel]:
        """The channels in a unit that have sizes."""
        return [channel for channel in self.channels if channel.unit == unit and channel.terms is not None]


def saved_noise(noise: RestNoise, recording: str = "", sha256: str | None = None) -> SavedRestNoise:
    """The noise as it is saved; recording: its name, sha256: of its file."""
    return SavedRestNoise(
        format=NOISE_FORMAT, version=1, recording=sentence(recording), sha256=sha256, readings=noise.readings,
        rest_s=noise.rest_s, channels=[_channel(channel) for channel in noise.channels], created=now(),
        program=version("kf_calib"),
    )  # fmt: skip


def _channel(channel: ChannelNoise) -> SavedChannel:
    terms = {
        name: SavedSize(value=size.value, low=size.low, high=size.high if size.high < float("inf") else None)
        for name, size in channel.terms.items()
    }
    return SavedChannel(
        name=channel.name, unit=channel.unit, rate_hz=1.0 / channel.period_s,  # pyright: ignore[reportArgumentType]
        reading_sigma=channel.reading_sigma if terms else None, terms=terms or None,  # pyright: ignore[reportArgumentType]
        from_s=channel.from_s if terms else None, taus_s=channel.tau_s.tolist(), deviations=channel.deviation.tolist(),
        why_not=channel.why_not,
    )  # fmt: skip


def write_noise(path: Path, content: SavedRestNoise) -> None:
    """Write the file, wholly or not at all; raises InputError if it cannot be written."""
    write_whole(path, (json.dumps(content.model_dump(mode="json"), indent=1, allow_nan=False) + "\n").encode())


def open_noise(path: str | Path) -> SavedRestNoise:
    """Read a file and check all of it; raises InputError, with the path and the place in it."""
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: is larger than the noise of any recording: {_HOW}.")
        return SavedRestNoise.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): {_HOW}.") from None
    except ValidationError as error:
        place, said, _ = first_misfit(error)
        raise InputError(f"{path}: {cut(f'{place}: ' * bool(place) + said, 200)}: {_HOW}.") from None


def is_noise_file(path: Path) -> bool:
    """Whether a file begins as ``--save`` of noise writes it; one that cannot be read is for others to refuse."""
    try:
        with path.open("rb") as file:
            return NOISE_FORMAT.encode() in file.read(100)
    except OSError:
        return False
