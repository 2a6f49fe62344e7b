"""A simulated bench: the truth, apart from what any estimator believes.

Nonlinear, by scipy's rotations; of the package it knows the description of the bench and the streams, and no formula.
Each stretch of samples goes, as a ``State``, through a chain of steps: the platform (angles -> attitude -> specific
force), the response of the accelerometers (specific force -> readings), and the recording (noise). A further physical
effect is one more step in the chain. Samples are made as they are asked for; memory does not grow with the run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench import Bench, Vector
from kf_calib.errors import InputError, KfCalibError
from kf_calib.samples import Batch, Floats, Stream, Times
from kf_calib.sources.gimbals import Motion, attitude, between
from kf_calib.sources.noise_sources import Noise, Process, generator
from kf_calib.sources.plans import YZX, Visit
from kf_calib.sources.sensors import Sensors

SIDEREAL_DAY_S = 86164.0905
"""One turn of the Earth in inertial space."""

START_NS = 1_750_000_000_000_000_000
"""Stamp of the first sample: 15 June 2025, 15:06:40 UTC."""

_TEMPERATURE_HZ = 1.0


@dataclass(frozen=True)
class Ambient:
    """Temperature over time: constant + swing sin(2 pi t / period) - warm_up exp(-t / warm_up_s), degC."""

    constant_c: float = 25.0
    swing_c: float = 0.0
    period_s: float = 14400.0
    warm_up_c: float = 0.0
    warm_up_s: float = 1800.0
    sigma_c: float = 0.01  # of the recorded values

    def __call__(self, time_s: Floats) -> Floats:
        swing = self.swing_c * np.sin(2.0 * np.pi * time_s / self.period_s)
        return self.constant_c + swing - self.warm_up_c * np.exp(-time_s / self.warm_up_s)


@dataclass
class State:
    """What is true of n consecutive samples that lie within one dwell, or within one slew.

    Arrays have n rows, or one where a quantity is constant over the stretch: they broadcast. ``dwell`` is the one the
    platform is in, or was last in; ``share`` of the way to the next one it has gone.
    """

    time_s: Floats  # (n,) since the first sample
    ambient: Ambient
    dwell: int
    moving: bool
    arrival_s: float
    share: Floats  # (n,) or (1,)
    angles_rad: Floats  # (n, k) or (1, k); as the encoders see them, without their noise
    attitude: Rotation = field(default_factory=Rotation.identity)  # platform -> bench
    force_mps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))  # specific force, in the platform
    reading_mps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))

    @property
    def temperature_c(self) -> Floats:
        return self.ambient(self.time_s)

    @property
    def since_arrival_s(self) -> Floats:
        return self.time_s - self.arrival_s

    def of_dwells(self, values: Floats) -> Floats:
        """What has ``values`` (m, k) in the dwells and passes smoothly from one to the next: (n, k) or (1, k)."""
        return between(values, np.full(len(self.share), self.dwell), self.share)


Step = Callable[[State], None]
"""One part of the bench: changes what is true in a ``State``. It may remember what went before."""


@dataclass(frozen=True)
class Gimbals:
    """The chain of gimbals: encoder angles -> attitude."""

    axes: Sequence[Vector]

    def __call__(self, state: State) -> None:
        state.attitude = attitude(self.axes, state.angles_rad)


@dataclass(frozen=True)
class SettingError:
    """The platform turned in itself by a small rotation vector in each dwell, ``rotation_rad`` (m, 3)."""

    rotation_rad: Floats

    def __call__(self, state: State) -> None:
        state.attitude = state.attitude * Rotation.from_rotvec(state.of_dwells(self.rotation_rad))


@dataclass(frozen=True)
class Gravity:
    """Specific force seen by the platform: f_p = C_bp^T f_b, f_b = (0, g, 0), which turns with the Earth where the
    platform is held in inertial space."""

    bench: Bench

    def __call__(self, state: State) -> None:
        up = np.array([[0.0, self.bench.gravity_mps2, 0.0]])
        if self.bench.reference == "inertial":
            up = Rotation.from_rotvec(state.time_s[:, None] * self._earth_rate_radps).apply(up)
        state.force_mps2 = state.attitude.inv().apply(up)

    @property
    def _earth_rate_radps(self) -> Floats:
        """Turning rate of the Earth (3,) in the bench frame: North, Up, East turned until x has the azimuth."""
        latitude, azimuth = np.radians([self.bench.latitude_deg, self.bench.azimuth_deg])
        pole = Rotation.from_rotvec([0.0, 0.0, latitude]).apply([1.0, 0.0, 0.0])  # raised from North by the latitude
        from_north = Rotation.from_rotvec([0.0, -azimuth, 0.0])  # East is z: toward it is a turn about Down
        return 2.0 * np.pi / SIDEREAL_DAY_S * from_north.inv().apply(pole)


@dataclass(frozen=True)
class Response:
    """Readings of the three accelerometers: K_i E_i . f + b_i."""

    sensors: Sensors

    def __call__(self, state: State) -> None:
        rows = self.sensors.sensitivities
        state.reading_mps2 = np.einsum("nj,ij->ni", state.force_mps2, rows) + self.sensors.biases_mps2


@dataclass(frozen=True)
class Scatter:
    """An offset of each accelerometer in each dwell, ``offset_mps2`` (m, 3)."""

    offset_mps2: Floats

    def __call__(self, state: State) -> None:
        state.reading_mps2 = state.reading_mps2 + state.of_dwells(self.offset_mps2)


@dataclass(frozen=True)
class Disturbance:
    """Noise added to the readings; ``when_moving``: only in slews."""

    process: Process
    when_moving: bool = False

    def __call__(self, state: State) -> None:
        if state.moving or not self.when_moving:
            state.reading_mps2 = state.reading_mps2 + self.process(len(state.time_s))


class Simulation:
    """A simulated run as a ``Source``: iterating it again gives the same samples.

    bench: what the recording says of the bench; where it has no axes, the gimbals are y z x and the attitude quaternion
    is recorded in place of angles. sample_hz, angle_hz: rates of readings and of poses; temperature comes at 1 Hz.
    slew_rate_degps: greatest speed of the fastest axis (infinity: the platform jumps). batch_samples: readings a batch.
    grade: name of the grade the sensors were drawn from, for the record.
    """

    def __init__(
        self,
        bench: Bench,
        sensors: Sensors,
        noise: Noise,
        plan: Sequence[Visit],
        *,
        sample_hz: float = 100.0,
        angle_hz: float = 10.0,
        ambient: Ambient | None = None,
        slew_rate_degps: float = 20.0,
        seed: int = 0,
        batch_samples: int = 65536,
        grade: str = "",
    ) -> None:
        self.bench, self.sensors, self.noise, self.plan = bench, sensors, noise, tuple(plan)
        self.ambient, self.seed, self.grade = ambient or Ambient(), seed, grade
        self.warnings = list[str]()
        self.fraction = 0.0
        self._axes = bench.axes or YZX
        _refuse_impossible(self.plan, len(self._axes), sample_hz, angle_hz, slew_rate_degps, batch_samples)
        angles_rad = np.radians([visit.gimbal_deg for visit in self.plan])
        self.motion = Motion.through(angles_rad, np.array([visit.dwell_s for visit in self.plan]), slew_rate_degps)
        self._accel, self._pose, self._temperature = map(_Clock.of, (sample_hz, angle_hz, _TEMPERATURE_HZ))
        self._batch_samples = batch_samples

    def __len__(self) -> int:
        """Number of readings."""
        return self._accel.first_at(self.motion.end_ns)

    def __iter__(self) -> Iterator[Batch]:
        steps = self._steps()
        encoder_rng, thermometer_rng = generator(self.seed, "encoders"), generator(self.seed, "thermometer")
        for first in range(0, len(self), self._batch_samples):
            last = min(first + self._batch_samples, len(self))
            start_ns = first * self._accel.period_ns
            end_ns = last * self._accel.period_ns if last < len(self) else self.motion.end_ns
            yield Batch(
                self._readings(first, last, steps),
                self._poses(self._pose.between(start_ns, end_ns), encoder_rng),
                self._temperatures(self._temperature.between(start_ns, end_ns), thermometer_rng),
            )
            self.fraction = last / len(self)

    @property
    def truth(self) -> dict[str, Any]:
        """What no estimator may see, for the side file: parameters by symbol (rad, 1, m/s^2), noise, seed, effects."""
        return {
            "grade": self.grade,
            "seed": self.seed,
            "parameters": dict(self.sensors.parameters),
            "noise": asdict(self.noise),
            "ambient": asdict(self.ambient),
            "effects": [],
        }

    def write_truth(self, recording: str | PathLike[str]) -> Path:
        """Writes ``NAME.truth.json`` beside the recording ``NAME.mcap``; returns its path."""
        path = Path(recording).with_suffix(".truth.json")
        try:
            path.write_text(json.dumps(self.truth, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise KfCalibError(f"{path}: the truth cannot be written ({error.strerror}).") from None
        return path

    def _steps(self) -> list[Step]:
        """The chain, fresh from its start."""
        return [*self._platform_steps(), Response(self.sensors), *self._recording_steps()]

    def _platform_steps(self) -> list[Step]:
        steps: list[Step] = [Gimbals(self._axes)]
        if self.noise.setting_sigma_deg:
            steps.append(SettingError(self._drawn_per_dwell("setting", math.radians(self.noise.setting_sigma_deg))))
        return [*steps, Gravity(self.bench)]

    def _recording_steps(self) -> list[Step]:
        noise, period_s = self.noise, self._accel.period_ns * 1e-9
        processes = noise.processes(self.seed, period_s, len(self) * period_s)
        steps: list[Step] = [Disturbance(process) for process in processes]
        if noise.scatter_mps2:
            steps.append(Scatter(self._drawn_per_dwell("scatter", noise.scatter_mps2)))
        if noise.vibration_mps2:
            rng = generator(self.seed, "vibration")
            steps.append(Disturbance(lambda n: noise.vibration_mps2 * rng.standard_normal((n, 3)), when_moving=True))
        return steps

    def _drawn_per_dwell(self, quantity: str, sigma: float) -> Floats:
        return sigma * generator(self.seed, quantity).standard_normal((len(self.plan), 3))

    def _readings(self, first: int, last: int, steps: Sequence[Step]) -> Stream:
        time_ns = np.arange(first, last) * self._accel.period_ns
        values = np.empty((last - first, 3))
        turning_points = np.searchsorted(time_ns, np.concatenate([self.motion.arrive_ns, self.motion.leave_ns]))
        cuts = np.unique([0, last - first, *turning_points])
        for start, end in zip(cuts[:-1], cuts[1:], strict=True):
            state = self._state(time_ns[start:end])
            for step in steps:
                step(state)
            values[start:end] = state.reading_mps2
        return Stream(START_NS + time_ns, values)

    def _state(self, time_ns: Times) -> State:
        dwell = int(self.motion.locate(time_ns[:1])[0][0])
        moving = bool(time_ns[0] >= self.motion.leave_ns[dwell])
        posed_ns = time_ns if moving else time_ns[:1]
        return State(
            time_s=time_ns * 1e-9,
            ambient=self.ambient,
            dwell=dwell,
            moving=moving,
            arrival_s=float(self.motion.arrive_ns[dwell]) * 1e-9,
            share=self.motion.locate(posed_ns)[1],
            angles_rad=self.motion.angles_at(posed_ns),
        )

    def _poses(self, time_ns: Times, rng: np.random.Generator) -> Stream:
        """Encoder readings, or the attitude they make where the bench has no axes."""
        angles_deg = np.degrees(self.motion.angles_at(time_ns))
        if self.noise.encoder_sigma_deg:
            angles_deg += self.noise.encoder_sigma_deg * rng.standard_normal(angles_deg.shape)
        if self.noise.encoder_step_deg:
            angles_deg = self.noise.encoder_step_deg * np.rint(angles_deg / self.noise.encoder_step_deg)
        angles_rad = np.radians(angles_deg)
        values = angles_rad if self.bench.axes else attitude(self._axes, angles_rad).as_quat()
        return Stream(START_NS + time_ns, values)

    def _temperatures(self, time_ns: Times, rng: np.random.Generator) -> Stream:
        values = self.ambient(time_ns * 1e-9) + self.ambient.sigma_c * rng.standard_normal(len(time_ns))
        return Stream(START_NS + time_ns, values[:, None])


@dataclass(frozen=True)
class _Clock:
    """Stamps at whole multiples of a period."""

    period_ns: int

    @classmethod
    def of(cls, rate_hz: float) -> _Clock:
        return cls(round(1e9 / rate_hz))

    def first_at(self, time_ns: int) -> int:
        """Number of the first stamp at or after that time."""
        return -(-time_ns // self.period_ns)

    def between(self, start_ns: int, end_ns: int) -> Times:
        """The stamps from ``start_ns`` on that lie before ``end_ns``."""
        return np.arange(self.first_at(start_ns), self.first_at(end_ns)) * self.period_ns


def _refuse_impossible(
    plan: Sequence[Visit], axes: int, sample_hz: float, angle_hz: float, slew_rate_degps: float, batch_samples: int
) -> None:
    if not plan:
        raise InputError("the plan visits no orientation: give one or more.")
    for number, visit in enumerate(plan, start=1):
        if len(visit.gimbal_deg) != axes or not all(map(math.isfinite, visit.gimbal_deg)):
            raise InputError(f"visit {number} has angles {visit.gimbal_deg}: give one number for each of {axes} axes.")
        if not 0.0 < visit.dwell_s < math.inf:
            raise InputError(f"visit {number} lasts {visit.dwell_s:g} s: give a positive time.")
    for name, rate_hz in (("sample_hz", sample_hz), ("angle_hz", angle_hz)):
        if not 0.0 < rate_hz <= 1e6:
            raise InputError(f"{name} is {rate_hz:g}: give a rate above 0 and up to 1e6 Hz.")
    if not slew_rate_degps > 0.0 or batch_samples < 1:
        raise InputError("slew_rate_degps and batch_samples must be positive: give them so.")
