"""The noise of sensors in the keys of the programs that ask for it.

White noise N and random walk K of the accelerometers and, where they were there, of the gyroscopes. These programs take
one number for three axes: the largest; and a number in any case: of a term that is not seen, its limit. So no filter
trusts a sensor more than the recording shows.

- Kalibr (``imu.yaml``) and OpenVINS (``imu0:`` of ``kalibr_imu_chain.yaml``): N in m/s^2/√Hz, K in m/s^3/√Hz, and those
  of the gyroscopes in rad/s/√Hz and rad/s^2/√Hz; update_rate in Hz (Kalibr wiki, "IMU Noise Model").
- PX4: EKF2 adds (NOISE dt)^2 to the variance of a velocity and (B_NOISE dt)^2 to that of a bias in each step
  (src/modules/ekf2/EKF/covariance.cpp). With the step dt = 10 ms of EKF2_PREDICT_US that is N^2 dt and K^2 dt where
  NOISE = N / √dt and B_NOISE = K / √dt. A sensor at rest on a table: vibration of a vehicle comes on top.
- robot_localization: takes the covariance that each message brings, row by row, and messages for independent. A filter
  in the sensor makes neighbours alike, so it is N^2 times the rate, or the Allan variance of neighbours where that is
  larger.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal, NamedTuple

from kf_calib.errors import InputError
from kf_calib.exchange.noise_file import SavedChannel, SavedRestNoise, TermName

NoiseProgram = Literal["kalibr", "openvins", "px4", "robot_localization"]
PX4_STEP_S = 0.01
_UNITS = {"m/s^2": ("accelerometer", "ACC", "m/s^3"), "rad/s": ("gyroscope", "GYR", "rad/s^2")}
"""Of readings, with the name of the sensor in full and in PX4, and the unit of its rate of change."""
_LONGEST = 120


def in_comment(text: str) -> str:
    """The text without what could end a comment, or mean anything, in C, YAML or a list of parameters."""
    return re.sub(r"[^\w.+:-]+", "_", text)[:_LONGEST]


def origin_of(what: str, program: str, created: str) -> str:
    """Where numbers come from, fit for a comment of any of the formats; what: fit for it already."""
    return f"{what} by kf_calib {in_comment(program)}, {in_comment(created)}"


class NoiseKey(NamedTuple):
    """A key with its value, its unit, and whether it is a limit of what was not seen."""

    name: str
    value: float
    unit: str
    is_limit: bool


class NoiseExport:
    """Noise in the keys of one program."""

    titles: ClassVar[dict[NoiseProgram, str]] = {
        "kalibr": "Kalibr", "openvins": "OpenVINS", "px4": "PX4", "robot_localization": "robot_localization",
    }  # fmt: skip

    def __init__(self, noise: SavedRestNoise, to: NoiseProgram) -> None:
        """Raises InputError where no accelerometer has a size of its white noise."""
        self.noise, self.to = noise, to
        if not noise.of_unit("m/s^2"):
            raise InputError("no accelerometer has a noise in this file: record a longer rest.")
        self.title = self.titles[to]

    @property
    def keys(self) -> list[NoiseKey]:
        """Keys and values; of robot_localization there are none, but two matrices."""
        keys = list[NoiseKey]()
        for unit, (sensor, word, per_s) in _UNITS.items():
            channels = self.noise.of_unit(unit)
            if not channels:
                continue
            (white, white_limit), (walk, walk_limit) = (_largest(channels, term) for term in ("white", "random_walk"))
            if self.to == "px4":
                scale = PX4_STEP_S**-0.5
                keys.append(NoiseKey(f"EKF2_{word}_NOISE", white * scale, unit, white_limit))
                keys.append(NoiseKey(f"EKF2_{word}_B_NOISE", walk * scale, per_s, walk_limit))
            elif self.to != "robot_localization":
                keys.append(NoiseKey(f"{sensor}_noise_density", white, f"{unit}/sqrt(Hz)", white_limit))
                keys.append(NoiseKey(f"{sensor}_random_walk", walk, f"{per_s}/sqrt(Hz)", walk_limit))
        return keys

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know of them."""
        limits = [key.name for key in self.keys if key.is_limit]
        remarks = [f"{', '.join(limits)}: not seen in this recording, so this is the 95 % limit"] if limits else []
        if self.to in ("kalibr", "openvins") and not self.noise.of_unit("rad/s"):
            remarks.append("the gyroscopes are not in it: take them along by --gyro, or add their keys")
        if self.to == "px4":
            remarks.append("these are of a sensor at rest; vibration in flight is usually far more, so take them for "
                           "the least that makes sense")  # fmt: skip
        return tuple(remarks)

    @property
    def yaml_lines(self) -> list[str]:
        """The lines of a mapping in YAML."""
        lines = [f"{key.name}: {key.value:.6e}  # {key.unit}{', limit' * key.is_limit}" for key in self.keys]
        return [*lines, f"update_rate: {self.rate_hz:.6g}  # Hz"]

    @property
    def rate_hz(self) -> float:
        return self.noise.of_unit("m/s^2")[0].rate_hz

    @property
    def origin(self) -> str:
        """Where the numbers come from, fit for a comment of any of the formats."""
        name = in_comment(self.noise.recording) or "a recording"
        return origin_of(f"noise of {name}", self.noise.program, self.noise.created)

    @property
    def parameter_lines(self) -> list[str]:
        """The lines of a list of PX4's parameters."""
        return [f"1\t1\t{key.name}\t{key.value:.9g}\t9" for key in self.keys]

    def text(self) -> str:
        """The content of a file that has the noise alone."""
        head = [f"# {self.origin}.", *(f"# {in_words}." for in_words in self.remarks)]
        match self.to:
            case "kalibr":
                lines = self.yaml_lines
            case "openvins":
                head = ["%YAML:1.0", *head]
                lines = ["imu0:", *(f"  {line}" for line in self.yaml_lines)]
            case "px4":
                lines = ["#", "# Vehicle-Id Component-Id Name Value Type", *self.parameter_lines]
            case _:
                lines = list(self._covariances())
        return "\n".join([*head, *lines, ""])

    def _covariances(self) -> Iterator[str]:
        """The covariances for sensor_msgs/msg/Imu; the elements of a matrix (3, 3) row by row."""
        for unit, name in (("m/s^2", "linear_acceleration"), ("rad/s", "angular_velocity")):
            channels = self.noise.of_unit(unit)
            if len(channels) == 3:
                diagonal = [_reading_variance(channel) for channel in channels]
                cells = [f"{diagonal[i]:.6e}" if i == j else "0.0" for i in range(3) for j in range(3)]
                yield f"{name}_covariance: [{', '.join(cells)}]"


def _reading_variance(channel: SavedChannel) -> float:
    """Variance of a reading, if readings were independent and had the channel's white noise."""
    white = _largest([channel], "white")[0]
    return max(white**2 * channel.rate_hz, (channel.reading_sigma or 0.0) ** 2)


def _largest(channels: Sequence[SavedChannel], term: TermName) -> tuple[float, bool]:
    """The largest size of a term, or where no channel shows one the largest limit; whether it is one."""
    sizes = [channel.terms[term] for channel in channels if channel.terms is not None]
    values = [size.value for size in sizes if size.value is not None]
    limits = [size.high for size in sizes if size.high is not None]
    if values:
        return max(values), False
    if not limits:
        raise InputError(f"the {term.replace('_', ' ')} is not bounded by this recording: record a longer rest.")
    return max(limits), True
