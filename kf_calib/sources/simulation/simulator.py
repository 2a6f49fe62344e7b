"""A simulated bench: the truth, apart from what any estimator believes.

Nonlinear, by scipy's rotations; of the package it knows the description of the bench and the streams, and no formula.
Each stretch of samples goes through a chain of steps (``physics``): the platform, the response of the accelerometers,
the recording. A further physical effect is one more step in the chain. Samples are made as they are asked for; memory
does not grow with the run.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.sources.simulation.injected.kinds import Hidden, SimulatedBench, Stage, steps_of
from kf_calib.sources.simulation.physics import (
    Ambient,
    Disturbance,
    TrueState,
    TrueStep,
    WalkingBias,
    adding,
    gravity,
    inputs,
    response,
    set_attitudes,
    turning_platform,
)
from kf_calib.sources.simulation.sensors import Sensors, TrueNoise, generator
from kf_calib.sources.simulation.visit_plans import YZX, Motion, PlannedVisit, attitude, stays

START_NS = 1_750_000_000_000_000_000
"""Stamp of the first sample: 15 June 2025, 15:06:40 UTC."""

_TEMPERATURE_HZ = 1.0
_READING_BYTES, _POSE_BYTES, _TEMPERATURE_BYTES = 50, 30, 35  # in a recording, compressed
_LONGEST_S = 7e9  # the stamps of a recording end in 2262


class Simulation:
    """A simulated run as a ``Source``: iterating it again gives the same samples.

    bench: what the recording says of the bench; where it has no axes, the gimbals are y z x and the attitude quaternion
    is recorded in place of angles. sample_hz, angle_hz: rates of readings and of poses; temperature comes at 1 Hz.
    slew_rate_degps: greatest speed of the fastest axis (infinity: the platform jumps). batch_samples: readings a batch.
    grade: name of the grade the sensors were drawn from, for the record. hidden: further physical effects, which only
    the truth tells.
    """

    def __init__(
        self,
        bench: Bench,
        sensors: Sensors,
        noise: TrueNoise,
        plan: Sequence[PlannedVisit],
        *,
        sample_hz: float = 100.0,
        angle_hz: float = 10.0,
        ambient: Ambient | None = None,
        slew_rate_degps: float = 20.0,
        seed: int = 0,
        batch_samples: int = 65536,
        grade: str = "",
        hidden: Sequence[Hidden] = (),
    ) -> None:
        self.bench, self.sensors, self.noise, self.plan = bench, sensors, noise, stays(plan)
        self.ambient, self.seed, self.grade = ambient or Ambient(), seed, grade
        self.hidden = tuple(hidden)
        self.warnings = list[str]()
        self.fraction = 0.0
        self._further: tuple[TrueStep, ...] = ()
        self._axes = bench.axes or YZX
        _refuse_impossible(self.plan, len(self._axes), sample_hz, angle_hz, slew_rate_degps, batch_samples)
        angles_rad = np.radians([visit.gimbal_deg for visit in self.plan])
        self.motion = Motion.through(angles_rad, np.array([visit.dwell_s for visit in self.plan]), slew_rate_degps)
        self._accel, self._pose, self._temperature = map(_Clock.of, (sample_hz, angle_hz, _TEMPERATURE_HZ))
        self._batch_samples = batch_samples

    def __len__(self) -> int:
        """Number of readings."""
        return self._accel.first_at(self.motion.end_ns)

    @property
    def duration_s(self) -> float:
        return self.motion.end_ns * 1e-9

    @property
    def file_bytes(self) -> int:
        """About as large its recording becomes."""
        poses, temperatures = (clock.first_at(self.motion.end_ns) for clock in (self._pose, self._temperature))
        return _READING_BYTES * len(self) + _POSE_BYTES * poses + _TEMPERATURE_BYTES * temperatures

    def __iter__(self) -> Iterator[Batch]:
        make = self.batch_maker()
        for first in range(0, len(self), self._batch_samples):
            last = min(first + self._batch_samples, len(self))
            yield make(last * self._accel.period_ns if last < len(self) else self.motion.end_ns)
            self.fraction = last / len(self)

    def batch_maker(self) -> Callable[[int], Batch]:
        """What makes the batch of all before a time since the first reading that was not in the batch before."""
        steps, begin_ns = self._steps(), 0
        encoder_rng, thermometer_rng = generator(self.seed, "encoders"), generator(self.seed, "thermometer")

        def make(end_ns: int) -> Batch:
            nonlocal begin_ns
            start_ns, begin_ns = begin_ns, end_ns
            return Batch(
                self._readings(self._accel.between(start_ns, end_ns), steps),
                self._poses(self._pose.between(start_ns, end_ns), encoder_rng),
                self._temperatures(self._temperature.between(start_ns, end_ns), thermometer_rng),
            )

        return make

    def next_reading_ns(self, time_ns: int) -> int:
        """When the first reading at or after a time comes, both since the first one."""
        return self._accel.first_at(time_ns) * self._accel.period_ns

    def moved_by(self, motion: Motion, most_dwells: int, platform: TrueStep) -> Simulation:
        """The same bench whose platform moves otherwise, and goes through a further step before its hidden effects.

        motion: may go on while readings are made. most_dwells: for which what differs from dwell to dwell is drawn.
        """
        other = copy.copy(self)
        other.motion, other._further, other.warnings = motion, (platform,), list[str]()
        other.plan = (*self.plan, *[self.plan[-1]] * (most_dwells - len(self.plan)))
        return other

    def hiding(self, hidden: Sequence[Hidden], noise: TrueNoise | None = None) -> Simulation:
        """The same run with these hidden effects in place of its own, and with other noise where some is given."""
        other = copy.copy(self)
        other.hidden, other.noise, other.fraction = tuple(hidden), noise or self.noise, 0.0
        other.warnings = list[str]()
        return other

    def by_hand(self) -> Simulation:
        """The same run as a recording of a board that is turned by hand has it: without its angles and its gimbals."""
        other = self.hiding(self.hidden)
        square = {"theta1": 0.0, "theta3": 0.0}
        other.bench = replace(self.bench, axes=(), angles=False, angle_sigma_deg=None, nominal=square)
        return other

    def parameters_at_end(self) -> dict[str, float] | None:
        """The parameters at the last reading, where the biases have walked there; None where they have not."""
        simulated, noise = self._simulated, TrueNoise(walk_mps2_per_sqrt_s=self.noise.walk_mps2_per_sqrt_s)
        processes = noise.processes(self.seed, simulated.period_s, simulated.duration_s)
        hidden = chain.from_iterable(self._hidden_steps().values())
        processes += [step.process for step in hidden if isinstance(step, WalkingBias)]
        if not processes:
            return None
        counts = [min(self._batch_samples, len(self) - first) for first in range(0, len(self), self._batch_samples)]
        ends = [[process(count)[-1] for count in counts][-1] for process in processes]
        there = dict(self.sensors.parameters)
        for k, walked in enumerate(np.sum(ends, axis=0).tolist(), start=1):
            there[f"b{k}"] += walked
        return there

    def _steps(self) -> tuple[list[TrueStep], list[TrueStep]]:
        """The chain, fresh from its start: what comes before the attitude that the gimbals make, and what after it."""
        hidden = self._hidden_steps()
        turned: list[TrueStep] = [*self._further, *hidden["angles"]]
        platform: list[TrueStep] = [*hidden["attitude"], *self._setting_steps()]
        sensed: list[TrueStep] = [inputs(self.sensors), *hidden["input"], response(self.sensors), *hidden["reading"]]
        force: list[TrueStep] = [gravity(self.bench), *hidden["force"]]
        return turned, [*platform, *force, *sensed, *self._noise_steps(), *hidden["record"]]

    def _hidden_steps(self) -> dict[Stage, list[TrueStep]]:
        return steps_of(self.hidden, self._simulated)

    @property
    def _simulated(self) -> SimulatedBench:
        period_s = self._accel.period_ns * 1e-9
        return SimulatedBench(
            self.bench, self._axes, self.sensors, self.motion, period_s, len(self) * period_s, self.seed
        )

    def _setting_steps(self) -> list[TrueStep]:
        if not self.noise.setting_sigma_deg:
            return []
        rotation_rad = self._drawn_per_dwell("setting", math.radians(self.noise.setting_sigma_deg))
        return [turning_platform(lambda state: state.of_dwells(rotation_rad))]

    def _noise_steps(self) -> list[TrueStep]:
        noise, period_s = self.noise, self._accel.period_ns * 1e-9
        processes = noise.processes(self.seed, period_s, len(self) * period_s)
        steps: list[TrueStep] = [Disturbance(process) for process in processes]
        if noise.scatter_mps2:
            offset_mps2 = self._drawn_per_dwell("scatter", noise.scatter_mps2)
            steps.append(adding(lambda state: state.of_dwells(offset_mps2)))
        if noise.vibration_mps2:
            rng = generator(self.seed, "vibration")
            steps.append(Disturbance(lambda n: noise.vibration_mps2 * rng.standard_normal((n, 3)), when_moving=True))
        return steps

    def _drawn_per_dwell(self, quantity: str, sigma: float) -> Floats:
        return sigma * generator(self.seed, quantity).standard_normal((len(self.plan), 3))

    def _readings(self, time_ns: Times, steps: tuple[Sequence[TrueStep], Sequence[TrueStep]]) -> Stream:
        before, after = steps
        values = np.empty((len(time_ns), 3))
        turning_points = np.searchsorted(time_ns, np.concatenate([self.motion.arrive_ns, self.motion.leave_ns]))
        cuts = np.unique([0, len(time_ns), *turning_points])
        stretches = [slice(start, end) for start, end in pairwise(cuts.tolist())]
        dwells = self.motion.locate(time_ns[cuts[:-1]])[0].tolist()
        states = [self._state(time_ns[part], dwell) for part, dwell in zip(stretches, dwells, strict=True)]
        for state in states:
            for step in before:
                step(state)
        set_attitudes(states, self.bench.up)
        for part, state in zip(stretches, states, strict=True):
            for step in after:
                step(state)
            values[part] = state.reading_mps2
        return Stream(START_NS + time_ns, values)

    def _state(self, time_ns: Times, dwell: int) -> TrueState:
        moving = bool(time_ns[0] >= self.motion.leave_ns[dwell])
        posed_ns = time_ns if moving else time_ns[:1]
        return TrueState(
            time_s=np.multiply(time_ns, 1e-9),
            ambient=self.ambient,
            dwell=dwell,
            moving=moving,
            arrival_s=float(self.motion.arrive_ns[dwell]) * 1e-9,
            share=self.motion.locate(posed_ns)[1],
            axes=self._axes,
            angles_rad=self.motion.angles_at(posed_ns),
        )

    def _poses(self, time_ns: Times, rng: np.random.Generator) -> Stream:
        """Encoder readings, or the attitude they make where the bench has no axes; none where they do not count."""
        if not self.bench.angles:
            return Stream.empty(self.bench.pose_width)
        angles_deg = np.degrees(self.motion.angles_at(time_ns))
        if self.noise.encoder_sigma_deg:
            angles_deg += self.noise.encoder_sigma_deg * rng.standard_normal(angles_deg.shape)
        if self.noise.encoder_step_deg:
            angles_deg = self.noise.encoder_step_deg * np.rint(angles_deg / self.noise.encoder_step_deg)
        angles_rad = np.radians(angles_deg)
        values = angles_rad if self.bench.axes else attitude(self._axes, angles_rad).as_quat()
        return Stream(START_NS + time_ns, values)

    def _temperatures(self, time_ns: Times, rng: np.random.Generator) -> Stream:
        values = self.ambient(np.multiply(time_ns, 1e-9)) + self.ambient.sigma_c * rng.standard_normal(len(time_ns))
        if self.ambient.step_c:
            values = self.ambient.step_c * np.rint(values / self.ambient.step_c)
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
    plan: Sequence[PlannedVisit],
    axes: int,
    sample_hz: float,
    angle_hz: float,
    slew_rate_degps: float,
    batch_samples: int,
) -> None:
    if not plan:
        raise InputError("the plan visits no orientation: give one or more.")
    for number, visit in enumerate(plan, start=1):
        if len(visit.gimbal_deg) != axes or not all(map(math.isfinite, visit.gimbal_deg)):
            raise InputError(f"visit {number} has angles {visit.gimbal_deg}: give one number for each of {axes} axes.")
        if not 0.0 < visit.dwell_s < math.inf:
            raise InputError(f"visit {number} lasts {visit.dwell_s:g} s: give a positive time.")
    total_s = sum(visit.dwell_s for visit in plan)
    if total_s > _LONGEST_S:
        raise InputError(
            f"the visits last {total_s:.3g} s in all, {total_s / 31557600:.3g} years: the stamps of a recording hold "
            "220; dwell shorter."
        )
    for name, rate_hz in (("sample_hz", sample_hz), ("angle_hz", angle_hz)):
        if not 0.0 < rate_hz <= 1e6:
            raise InputError(f"{name} is {rate_hz:g}: give a rate above 0 and up to 1e6 Hz.")
    if not slew_rate_degps > 0.0 or batch_samples < 1:
        raise InputError("slew_rate_degps and batch_samples must be positive: give them so.")


_ANY_DEG = 1e3  # a setting error that leaves the size of f alone, and rounding far below the noise


def without_angles(run: Simulation) -> Simulation:
    """The run as an evaluation without angles sees it, for sizes in sigma: every orientation may be any."""
    return run.hiding(run.hidden, replace(run.noise, setting_sigma_deg=_ANY_DEG))
