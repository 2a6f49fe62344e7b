"""The bench: its gimbals, gravity and the Earth's rotation; it converts platform angles to specific force in the
platform.

All frames are right-handed. n has the axes North, Up, East. b is the bench, n turned about the vertical by the azimuth.
u is the frame in which gimbal axes and sensors are named: b turned so that its axis ``up`` points up (u = b if ``up``
is y). p is the platform. The attitude is ``C_bp = C_bu Rot(axis1, q1) Rot(axis2, q2) ...``, outer axis first, where
each gimbal turns about the given axis of its parent, and ``f_p = C_bp^T f_b``. With all angles zero, the axis ``up`` of
the platform points up. By default this is y, and accelerometer 2 reads +g; with z, as in ROS, accelerometer 3 does.

With the reference ``base``, angles are relative to the bench and ``f_b = (0, g, 0)``. With the reference ``inertial``,
the platform is held fixed in inertial space, angles are relative to the bench frame at the time of the first sample,
and gravity turns with the Earth: ``f_b(t) = Rot(omega, |omega| t) (0, g, 0)``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from kf_calib.bench.arrays import Floats, Times, crossed, lengths
from kf_calib.bench.keys import limits_of, zones_of
from kf_calib.bench.raw_input import PLAIN, RawInput
from kf_calib.errors import BenchError
from kf_calib.support.text import cut

EARTH_RATE_RADPS = 7.292115e-5
"""Rate of the Earth's rotation in inertial space (WGS 84), rad/s: 15.041 deg/h."""

Vector = tuple[float, float, float]
_LETTERS: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def normal_gravity(latitude_deg: float, height_m: float = 0.0) -> float:
    """Normal gravity at a latitude and a height above the WGS 84 ellipsoid, m/s^2 (Somigliana's formula).

      gamma = gamma_e (1 + k sin^2 B) / sqrt(1 - e^2 sin^2 B)
      gamma_h = gamma (1 - 2 (1 + f + m - 2 f sin^2 B) h/a + 3 h^2/a^2)

    Source: NGA.STND.0036 (WGS 84, 2014), eq. 4-1 and 4-3. Local gravity differs from it by up to about 1e-3 m/s^2, so
    that a measured value should be stated where one is available. Raises BenchError if the latitude is out of range.
    """
    if not abs(latitude_deg) <= 90.0:
        raise BenchError(f"latitude {latitude_deg:g} deg is not between -90 and 90: give latitude_deg in degrees.")
    semi_major_m, flattening, m = 6378137.0, 1 / 298.257223563, 0.00344978650684
    sin2 = math.sin(math.radians(latitude_deg)) ** 2
    surface = 9.7803253359 * (1 + 0.001931852652458 * sin2) / math.sqrt(1 - 6.694379990141e-3 * sin2)
    ratio = height_m / semi_major_m
    return surface * (1 - 2 * (1 + flattening + m - 2 * flattening * sin2) * ratio + 3 * ratio**2)


def parse_axes(text: str) -> tuple[Vector, ...]:
    """Gimbal axes, outer to inner, from text such as ``"y z x"``: letters (a minus sign reverses the axis) or three
    comma-separated numbers each."""
    return tuple(_parse_axis(word) for word in text.split())


def _parse_axis(word: str) -> Vector:
    """Return the unit vector of one axis given as a letter or as three numbers."""
    sign, letter = (-1.0, word[1:]) if word.startswith("-") else (1.0, word)
    if letter.lower() in _LETTERS:
        x, y, z = _LETTERS[letter.lower()]
        return (sign * x + 0.0, sign * y + 0.0, sign * z + 0.0)
    try:
        numbers = [float(part) for part in word.split(",")]
    except ValueError:
        numbers = []
    length = math.hypot(*numbers) if len(numbers) == 3 else 0.0
    if not (math.isfinite(length) and length > 0):
        raise BenchError(
            f"axis {cut(word, 60)!r} is not known: give each gimbal axis, outer first, as x, y, z or three "
            'comma-separated numbers, for example --axes "y z x".'
        )
    if abs(length - 1.0) < 1e-12:  # so that a unit vector does not change when written and read
        length = 1.0
    return (numbers[0] / length, numbers[1] / length, numbers[2] / length)


def _format_axis(axis: Vector) -> str:
    """Write an axis as a letter if it is a coordinate axis, else as three numbers."""
    for letter, unit in _LETTERS.items():
        if axis == unit:
            return letter
        if axis == tuple(-part for part in unit):
            return f"-{letter}"
    return ",".join(repr(float(part)) for part in axis)


def axis_names(axes: Iterable[Vector]) -> list[str]:
    """The axes, each written as a letter if it is a coordinate axis, else as three numbers."""
    return list(map(_format_axis, axes))


@dataclass(frozen=True)
class Bench:
    """The description of the bench that is known before the first sample (metadata record ``kf_calib.bench``).

    - axes: unit vectors of the gimbal axes, outer to inner; empty if attitude quaternions are recorded instead of
      angles.
    - gravity_mps2: local gravity.
    - reference: ``base`` if angles are relative to the bench, ``inertial`` if the platform is held fixed in inertial
      space.
    - latitude_deg, height_m: the place of the bench; azimuth_deg: the azimuth of its x axis from North toward East.
    - angle_sigma_deg: setting error, one standard deviation; None if it is unknown and has to be estimated.
    - scatter_sigma_mps2: scatter of each accelerometer from dwell to dwell, one standard deviation; None if it is
      unknown and has to be estimated.
    - nominal: nominal parameters that differ from the paper's, in rad, 1 and m/s^2.
    - notes: free text such as the serial number of the block, and the date of the run where it is stated.
    - up: the axis that points up when all angles are zero. The azimuth is that of x, or of y if x is vertical.
    - input: what the device sends, of which the readings are made; a recording holds the readings.
    - joints: names of the gimbals' joints, outer to inner, if angles come as joint states; empty if their names tell.
    - angles: whether angles or attitudes are used. Without them only the size of gravity is known (``free_attitude``).
    - square_sigma_deg: how square the axes of the accelerometers are, one standard deviation; None for 1 deg.
    - limits_deg, forbidden_deg: ranges of gimbals that must not be left, and zones that must not be entered, as text
      (``bench.keys``); rate_degps, acceleration_degps2: greatest of any gimbal; None if not stated.
    """

    axes: tuple[Vector, ...]
    gravity_mps2: float
    reference: Literal["base", "inertial"] = "base"
    latitude_deg: float | None = None
    height_m: float = 0.0
    azimuth_deg: float = 0.0
    angle_sigma_deg: float | None = None
    scatter_sigma_mps2: float | None = None
    nominal: Mapping[str, float] = field(default_factory=dict[str, float])
    notes: Mapping[str, str] = field(default_factory=dict[str, str])
    up: str = "y"
    input: RawInput = PLAIN
    joints: tuple[str, ...] = ()
    angles: bool = True
    square_sigma_deg: float | None = None
    limits_deg: str = ""
    forbidden_deg: str = ""
    rate_degps: float | None = None
    acceleration_degps2: float | None = None

    def __post_init__(self) -> None:
        from kf_calib.bench.keys import NOTES, NUMBERS, checked

        values = {key: getattr(self, key) for key in ("reference", "up", *NUMBERS)}
        stated = {key: value for key, value in values.items() if value is not None or key == "gravity_mps2"}
        notes = {key: value for key, value in self.notes.items() if key in NOTES}
        for key, value in {**stated, "nominal": self.nominal, "joints": " ".join(self.joints), **notes}.items():
            checked(key, value)
        names = axis_names(self.axes)
        limits_of(self.limits_deg, names)  # raise BenchError
        zones_of(self.forbidden_deg, names)
        if self.reference == "inertial" and self.latitude_deg is None:
            raise BenchError(
                "an inertially held platform needs the latitude, because gravity turns with the Earth in it: "
                "give latitude_deg (--latitude)."
            )
        if self.joints and (len(self.joints) != len(self.axes) or len(set(self.joints)) < len(self.joints)):
            raise BenchError(
                f"joints names {len(self.joints)} gimbals ({' '.join(self.joints)}) where there are {len(self.axes)} "
                "axes: name each once, outer to inner."
            )

    @property
    def square_rad(self) -> float:
        """How square the axes of the accelerometers are, one standard deviation, rad."""
        return math.radians(1.0 if self.square_sigma_deg is None else self.square_sigma_deg)

    @property
    def axis_letters(self) -> tuple[str, ...]:
        """Letters of the gimbal axes, outer to inner; empty if an axis has no letter or two have the same."""
        letters = tuple(_format_axis(axis).removeprefix("-") for axis in self.axes)
        return letters if len(set(letters)) == len(letters) and set(letters) <= set(_LETTERS) else ()

    @property
    def pose_width(self) -> int:
        """Number of columns of a pose: the number of gimbals, or 4 for quaternions."""
        return len(self.axes) or 4

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any], has_angles: bool = True) -> Bench:
        """The bench described by the strings of a metadata record (docs/format.md) or by typed values of the same keys;
        raises BenchError."""
        from kf_calib.bench.keys import NOTES, NUMBERS, checked_keys

        values = dict[str, Any](checked_keys(metadata))
        numbers = {key: values[key] for key in NUMBERS if key in values}
        if has_angles and not values.get("axes", "").strip():
            raise BenchError(
                "the gimbal axes are not stated, so the angles cannot be used: give them outer to inner, "
                'for example --axes "y z x".'
            )
        if "gravity_mps2" not in numbers:
            if "latitude_deg" not in numbers:
                raise BenchError(
                    "neither gravity nor latitude is stated: give --gravity in m/s^2 (best), or --latitude in degrees."
                )
            numbers["gravity_mps2"] = normal_gravity(numbers["latitude_deg"], numbers.get("height_m", 0.0))
        return cls(
            axes=parse_axes(values["axes"]) if has_angles else (),
            reference=values.get("reference", "base"),
            nominal=values.get("nominal", {}),
            joints=tuple(values.get("joints", "").replace(",", " ").split()) if has_angles else (),
            notes={key: values[key] for key in NOTES if values.get(key)},
            up=values.get("up", "y"),
            input=RawInput.from_metadata(values),
            limits_deg=values.get("limits_deg", "") if has_angles else "",
            forbidden_deg=values.get("forbidden_deg", "") if has_angles else "",
            **numbers,
        )

    def to_metadata(self) -> dict[str, str]:
        """The strings of a metadata record from which ``from_metadata`` makes this bench again."""
        from kf_calib.bench.keys import FORMAT_VERSION, NUMBERS

        numbers = {key: getattr(self, key) for key in NUMBERS}
        return {
            "format_version": FORMAT_VERSION,
            **({"axes": " ".join(axis_names(self.axes))} if self.axes else {}),
            **({"joints": " ".join(self.joints)} if self.joints else {}),
            "reference": self.reference,
            **{key: repr(float(value)) for key, value in numbers.items() if value is not None},
            **({"nominal": json.dumps(dict(self.nominal))} if self.nominal else {}),
            **({"up": self.up} if self.up != "y" else {}),
            **({"limits_deg": self.limits_deg} if self.limits_deg else {}),
            **({"forbidden_deg": self.forbidden_deg} if self.forbidden_deg else {}),
            **self.input.to_metadata(),
            **self.notes,
        }

    def attitude(self, pose: ArrayLike) -> Floats:
        """Attitude matrices C_bp (n, 3, 3) of poses (n, k): gimbal angles in rad, or quaternions x y z w."""
        columns = [self.to_platform(np.eye(3)[:, i], np.asarray(pose, float)) for i in range(3)]
        return np.stack(columns, axis=1)  # row i of C_bp is bench axis i in platform coordinates

    def to_platform(self, vector: Floats, pose: Floats) -> Floats:
        """C_bp^T vector (n, 3): a bench vector (3,) or (n, 3) in platform coordinates at poses (n, k)."""
        if self.up != "y":
            vector = vector @ _frame_with_up(self.up).T
        if not self.axes:
            x, y, z, w = np.moveaxis(pose / np.linalg.norm(pose, axis=-1, keepdims=True), -1, 0)
            return _turn_by_quaternion(vector, np.stack([-x, -y, -z], axis=-1), w[..., None])
        for axis, angle_rad in zip(self.axes, np.moveaxis(pose, -1, 0), strict=True):
            vector = turn(vector, np.array(axis), -angle_rad)
        return vector

    @property
    def earth_rate_radps(self) -> Floats:
        """The Earth's rotation vector (3,), rad/s, in bench coordinates; raises BenchError if the latitude is not
        known."""
        if self.latitude_deg is None:
            raise BenchError("the Earth's rotation needs the latitude: give latitude_deg (--latitude).")
        latitude, azimuth = math.radians(self.latitude_deg), math.radians(self.azimuth_deg)
        north, up = math.cos(latitude), math.sin(latitude)
        return EARTH_RATE_RADPS * np.array([north * math.cos(azimuth), up, -north * math.sin(azimuth)])

    def specific_force(self, elapsed_s: Floats, pose: Floats) -> Floats:
        """Specific force f_p (n, 3), m/s^2, in the platform at times ``elapsed_s`` (n,) since the first sample and
        poses (n, k)."""
        up = np.broadcast_to([0.0, self.gravity_mps2, 0.0], (len(elapsed_s), 3))
        if self.reference == "inertial":
            rate = self.earth_rate_radps
            speed = float(np.linalg.norm(rate))
            up = turn(up, rate / speed, speed * elapsed_s)
        return self.to_platform(up, np.asarray(pose, float))


def metadata_of(values: Mapping[str, Any]) -> dict[str, str]:
    """The strings of a metadata record from values of JSON or TOML.

    Raises ValueError or RecursionError for integers of thousands of digits and for excessively nested lists.
    """
    texts = {key: value.isoformat() if isinstance(value, date) else value for key, value in values.items()}
    return {key: text if isinstance(text, str) else json.dumps(text, default=str) for key, text in texts.items()}


def _frame_with_up(up: str) -> Floats:
    """Return C_ub (3, 3), which transforms bench vectors to the frame u whose axis ``up`` points up.

    The x axis of u, or its y axis if x is vertical, has the direction of the bench's x axis.
    """
    vertical = np.array(_parse_axis(up))
    level = np.array(_LETTERS["y" if up.endswith("x") else "x"])
    return np.column_stack([level, vertical, np.cross(level, vertical)])  # the bench's x, y, z in coordinates of u


def turn(vector: Floats, axis: Floats, angle_rad: Floats | float) -> Floats:
    """The vector (..., 3) rotated about a unit axis by an angle, Rot(axis, angle) vector, by Rodrigues' formula.

    ``vector`` is (3,) or (n, 3); ``angle_rad`` is a scalar or (n,).
    """
    cos, sin = np.cos(angle_rad)[..., None], np.sin(angle_rad)[..., None]
    along = (vector @ axis)[..., None] * axis
    x, y, z = axis.tolist()
    across = vector @ np.array(
        [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    )  # axis x vector; np.cross costs ten times more
    return along + cos * (vector - along) + sin * across


def turn_by(vector: Floats, rotation_rad: Floats) -> Floats:
    """The vector (3,) or vectors (n, 3) turned by a rotation vector (3,); the same ones if it is zero."""
    angle_rad = float(np.linalg.norm(rotation_rad))
    return turn(vector, rotation_rad / angle_rad, angle_rad) if angle_rad else vector


def turned(vectors: Floats, rotations_rad: Floats) -> Floats:
    """Vectors (n, 3), each turned by its own rotation vector (n, 3); the same where that is zero."""
    angles_rad = lengths(rotations_rad)[:, None]
    axes = rotations_rad / np.where(angles_rad > 0.0, angles_rad, 1.0)
    along = (vectors * axes).sum(axis=1, keepdims=True) * axes
    return along + np.cos(angles_rad) * (vectors - along) + np.sin(angles_rad) * crossed(axes, vectors)


def _turn_by_quaternion(vector: Floats, imaginary: Floats, real: Floats) -> Floats:
    """Rotate vectors by quaternions given by their imaginary and real parts."""
    shape = np.broadcast_shapes(vector.shape, imaginary.shape)
    vector, imaginary = np.broadcast_to(vector, shape), np.broadcast_to(imaginary, shape)
    doubled = 2.0 * np.cross(imaginary, vector)
    return vector + real * doubled + np.cross(imaginary, doubled)


def unwrap_pose(
    pose: Floats, is_quaternion: bool, before: tuple[Floats, Floats] | None = None
) -> tuple[Floats, Floats]:
    """Poses (n, k) made continuous, and the whole turns (n, k) or signs (n, 1) that were applied.

    Each angle is brought within half a turn of the one before, and each quaternion to the sign that is nearer to the
    one before. ``before`` holds the last earlier pose as it was recorded and its turns or sign; with it, poses that
    arrive in parts give exactly the same result as all at once.
    """
    last, last_turns = (pose[0], np.ones(1) if is_quaternion else np.zeros(pose.shape[1])) if before is None else before
    stacked = np.vstack([last, pose])
    if is_quaternion:
        signs = last_turns * np.cumprod(np.where(np.einsum("ij,ij->i", stacked[1:], stacked[:-1]) < 0, -1.0, 1.0))
        return pose * signs[:, None], signs[:, None]
    turns = last_turns - np.cumsum(np.rint(np.diff(stacked, axis=0) / (2.0 * np.pi)), axis=0)
    return pose + 2.0 * np.pi * turns, turns


def interpolate_pose(at_ns: Times, time_ns: Times, pose: Floats, is_quaternion: bool) -> Floats:
    """Poses at ``at_ns``, linear between continuous angles and by slerp between quaternions; constant beyond the
    ends."""
    before = np.clip(np.searchsorted(time_ns, at_ns, side="right") - 1, 0, max(len(time_ns) - 2, 0))
    after = np.minimum(before + 1, len(time_ns) - 1)
    span = np.maximum(time_ns[after] - time_ns[before], 1)
    weight = np.clip((at_ns - time_ns[before]) / span, 0.0, 1.0)[:, None]
    start, end = pose[before], pose[after]
    if not is_quaternion:
        return start + weight * (end - start)
    return slerp(start, end, weight)


def slerp(start: Floats, end: Floats, weight: Floats) -> Floats:
    """Quaternions (n, 4) on the shorter great arc from ``start`` to ``end`` at the fraction ``weight`` (n, 1)."""
    start = start / np.linalg.norm(start, axis=-1, keepdims=True)
    end = end / np.linalg.norm(end, axis=-1, keepdims=True)
    end = np.where(np.sum(start * end, axis=-1, keepdims=True) < 0, -end, end)
    # atan2 of the two chords is exact for small arcs, where acos of a dot product near 1 loses half the digits
    half = np.arctan2(np.linalg.norm(end - start, axis=-1), np.linalg.norm(end + start, axis=-1))[:, None]
    arc = 2.0 * half
    tiny = arc < 1e-12
    safe = np.where(tiny, 1.0, np.sin(arc))
    start_weight = np.where(tiny, 1.0 - weight, np.sin((1.0 - weight) * arc) / safe)
    end_weight = np.where(tiny, weight, np.sin(weight * arc) / safe)
    return start_weight * start + end_weight * end


def pose_distance(one: Floats, other: Floats, is_quaternion: bool) -> Floats:
    """Distance of two poses (..., k), rad: the largest difference of an angle, or the angle of rotation between
    quaternions."""
    if not is_quaternion:
        return np.max(np.abs(one - other), axis=-1)
    one = one / np.linalg.norm(one, axis=-1, keepdims=True)
    other = other / np.linalg.norm(other, axis=-1, keepdims=True)
    other = np.where(np.sum(one * other, axis=-1, keepdims=True) < 0, -other, other)
    chord = np.linalg.norm(one - other, axis=-1), np.linalg.norm(one + other, axis=-1)
    return 4.0 * np.arctan2(*chord)


def mean_pose(pose: Floats) -> Floats:
    """Mean (k,) of continuous poses (n, k) that lie close together; quaternions have to be of one sign, and the mean is
    not normalised."""
    return pose.mean(axis=0)


def axes_of(names: Iterable[str]) -> tuple[Vector, ...]:
    """Axes from single words or letters, as in ``axes_of("yzx")``."""
    return parse_axes(" ".join(names))
