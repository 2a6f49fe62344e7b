"""A simulated bench that is driven: its platform goes where it is told, and readings are made as its time passes.

The truth is that of a simulated run (``Simulation``), only its motion comes from commands. Every gimbal has a finite
rate and acceleration of its own; the platform may lag behind the encoders by backlash, ring when it arrives, and fail.

    bench = DrivenBench(simulation(options, keys), Servo(rate_degps=30.0))
    bench.move_to([0.0, 90.0, 45.0])
    batch = bench.advance(0.5)                 # the readings of the next half second
    bench.read_deg(), bench.moving, bench.stop()
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError, check_number
from kf_calib.sources.simulation.physics import TrueState
from kf_calib.sources.simulation.sensors import generator
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import Motion

FAULTS = ("stuck", "stall", "off", "drive", "link", "readback", "runaway")
"""What can fail: a move does not begin; it ends half-way; it ends off its target; the drive trips; the link breaks; the
read-back is wrong; the platform does not stop at its target."""

_MOST_DWELLS = 512
_NEVER_NS = 1 << 62
_RINGING = 8.0  # time constants after which nothing is left of it
_OFF_DEG, _WRONG_DEG, _RUN_ON_DEG = 0.5, 20.0, 60.0


@dataclass(frozen=True)
class Servo:
    """What moves the platform.

    rate_degps, acceleration_degps2: greatest of each gimbal. overshoot_deg, ringing_s: amplitude and time constant of
    the oscillation in which it arrives. backlash_deg: play between encoders and platform, which trails in the
    direction in which it was moved last. position_sigma_deg: noise of a read-back.
    fault: one of ``FAULTS``, from ``fault_s`` on; none if empty.
    """

    rate_degps: float = 20.0
    acceleration_degps2: float = 40.0
    overshoot_deg: float = 0.0
    ringing_s: float = 0.2
    backlash_deg: float = 0.0
    position_sigma_deg: float = 0.0
    fault: str = ""
    fault_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rate_degps", "acceleration_degps2", "ringing_s"):
            check_number(name, getattr(self, name), above=True)
        for name in ("overshoot_deg", "backlash_deg", "position_sigma_deg", "fault_s"):
            check_number(name, getattr(self, name))
        if self.fault and self.fault not in FAULTS:
            raise InputError(f"fault {self.fault!r} is not known: use one of {', '.join(FAULTS)}.")


class _Course:
    """The angle of one gimbal over time, deg: parabolas from knot to knot."""

    def __init__(self, start_deg: float) -> None:
        self.knots = [(0.0, start_deg, 0.0, 0.0)]  # time, angle, rate, acceleration from there on
        self.ringing = list[tuple[float, float]]()  # from when, with which amplitude
        self.told: tuple[float, float] | None = None  # where to go, and when it is there

    def at(self, time_s: Floats, ringing_s: float) -> Floats:
        begin_s, angle, rate, acceleration = np.array(self.knots).T
        knot = np.maximum(np.searchsorted(begin_s, time_s, side="right") - 1, 0)
        since_s = time_s - begin_s[knot]
        angles = angle[knot] + since_s * (rate[knot] + 0.5 * acceleration[knot] * since_s)
        for from_s, amplitude in self.ringing:
            phase = (time_s - from_s) / ringing_s
            inside = (phase >= 0.0) & (phase < _RINGING)
            angles[inside] += amplitude * np.exp(-phase[inside]) * np.sin(0.5 * np.pi * phase[inside])
        return angles

    def brake(self, now_s: float, acceleration: float) -> float:
        """Comes to rest as soon as it can, and forgets what it was told; when it rests."""
        self.told = None
        time_s, angle, rate, change = max((knot for knot in self.knots if knot[0] <= now_s), key=lambda knot: knot[0])
        since_s = now_s - time_s
        angle, rate = angle + since_s * (rate + 0.5 * change * since_s), rate + change * since_s
        self.knots = [knot for knot in self.knots if knot[0] <= now_s]
        if abs(rate) < 1e-9:
            return now_s
        braking = -math.copysign(acceleration, rate)
        rest_s = now_s - rate / braking
        self.knots += [(now_s, angle, rate, braking), (rest_s, angle - 0.5 * rate**2 / braking, 0.0, 0.0)]
        return rest_s

    def go(self, now_s: float, target_deg: float, servo: Servo) -> float:
        """Goes from rest to a target, or goes on to it; when it is there."""
        if self.told is not None and self.told[0] == target_deg and now_s < self.told[1]:
            return self.told[1]
        start_s = self.brake(now_s, servo.acceleration_degps2)
        start_deg, rate, acceleration = self.knots[-1][1], servo.rate_degps, servo.acceleration_degps2
        way = target_deg - start_deg
        if abs(way) < 1e-12:
            return start_s
        rate = min(rate, math.sqrt(abs(way) * acceleration))
        rising_s, cruising_s = rate / acceleration, abs(way) / rate - rate / acceleration
        sign = math.copysign(1.0, way)
        rise_deg, end_s = 0.5 * sign * rate * rising_s, start_s + 2.0 * rising_s + cruising_s
        self.knots += [
            (start_s, start_deg, 0.0, sign * acceleration),
            (start_s + rising_s, start_deg + rise_deg, sign * rate, 0.0),
            (end_s - rising_s, target_deg - rise_deg, sign * rate, -sign * acceleration),
            (end_s, target_deg, 0.0, 0.0),
        ]
        if servo.overshoot_deg:
            self.ringing = [(end_s, sign * servo.overshoot_deg)]
            end_s += _RINGING * servo.ringing_s
        self.told = target_deg, end_s
        return end_s


class DrivenMotion(Motion):
    """The motion so far and what is under way; see ``Motion``. The angles of the last dwell hold until a command."""

    def __init__(self, start_deg: Sequence[float], servo: Servo, end_ns: int) -> None:
        super().__init__(np.radians([start_deg]), np.array([0]), np.array([_NEVER_NS]))
        self.servo, self._planned_end_ns = servo, end_ns
        self._courses, self._play_deg = [_Course(angle) for angle in start_deg], [np.zeros(len(start_deg))]

    @property
    def end_ns(self) -> int:
        """About when the run will end: what is drawn for a whole run is drawn for so long."""
        return self._planned_end_ns

    def _profile(self, share: Floats) -> Floats:
        return share

    def angles_at(self, time_ns: Times) -> Floats:
        time_s = np.multiply(time_ns, 1e-9)
        return np.radians(np.column_stack([course.at(time_s, self.servo.ringing_s) for course in self._courses]))

    def leave(self, now_ns: int, targets_deg: Sequence[float]) -> None:
        """Begins to move there, from where it stands or is."""
        now_s, before = now_ns * 1e-9, self.angles_at(np.array([now_ns]))[0]
        ends_s = [course.go(now_s, angle, self.servo) for course, angle in zip(self._courses, targets_deg, strict=True)]
        way = np.asarray(targets_deg, float) - np.degrees(before)
        play = np.where(np.abs(way) > 1e-9, -0.5 * self.servo.backlash_deg * np.sign(way), self._play_deg[-1])
        if not self.is_moving(now_ns):
            self.leave_ns = np.append(self.leave_ns[:-1], [now_ns, _NEVER_NS])
            self.arrive_ns, self.angles_rad = np.append(self.arrive_ns, 0), np.vstack([self.angles_rad, before])
            self._play_deg.append(play)
        self._arrive_at(max(ends_s), play)

    def brake(self, now_ns: int) -> None:
        """Comes to rest as soon as it can."""
        if self.is_moving(now_ns):
            ends_s = [course.brake(now_ns * 1e-9, self.servo.acceleration_degps2) for course in self._courses]
            self._arrive_at(max(ends_s), self._play_deg[-1])

    def is_moving(self, now_ns: int) -> bool:
        return now_ns < int(self.arrive_ns[-1])

    def _arrive_at(self, end_s: float, play_deg: Floats) -> None:
        end_ns = math.ceil(end_s * 1e9) + 1
        self.arrive_ns = np.append(self.arrive_ns[:-1], end_ns)
        self._play_deg[-1] = play_deg
        self.angles_rad[-1] = self.angles_at(np.array([end_ns]))[0]

    def trail(self, state: TrueState) -> None:
        """The step that lets the platform trail behind the encoders."""
        if self.servo.backlash_deg:
            state.angles_rad = state.angles_rad + state.of_dwells(np.radians(self._play_deg))


class DrivenBench:
    """A bench whose platform moves on command; its time passes by ``advance``.

    run: what it is like; its plan only tells where it stands first, and for how long effects in time are drawn.
    """

    def __init__(self, run: Simulation, servo: Servo | None = None, start_deg: Sequence[float] | None = None) -> None:
        self.servo = servo or Servo()
        start_deg = run.plan[0].gimbal_deg if start_deg is None else start_deg
        self._motion = DrivenMotion(list(start_deg), self.servo, run.motion.end_ns)
        self.run = run.moved_by(self._motion, _MOST_DWELLS, self._motion.trail)
        self._make = self.run.batch_maker()
        self._now_ns = 0
        self._rng = generator(run.seed, "read-back")
        self._tripped = False

    @property
    def now_s(self) -> float:
        """The time that has passed, s."""
        return self._now_ns * 1e-9

    @property
    def moving(self) -> bool:
        return self._motion.is_moving(self._now_ns)

    @property
    def fault(self) -> str:
        """What the drive reports: empty where nothing is wrong. Raises OSError where the link is lost."""
        self._use_link()
        return "drive tripped: overcurrent" if self._tripped else ""

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        """Begins to move. Raises OSError where the link is lost."""
        self._use_link()
        target, failing = np.asarray(gimbal_deg, float), self._failing
        if self._tripped or failing == "stuck" or len(self._motion.arrive_ns) >= _MOST_DWELLS:
            return
        here = np.degrees(self._motion.angles_at(np.array([self._now_ns]))[0])
        along = np.sign(target - here)
        if failing == "stall":
            target = 0.5 * (here + target)
        elif failing == "off":
            target = target + _OFF_DEG * along
        elif failing == "runaway":
            target = target + _RUN_ON_DEG * along
        self._motion.leave(self._now_ns, target.tolist())

    def stop(self) -> None:
        """Comes to rest. Raises OSError where the link is lost."""
        self._use_link()
        self._motion.brake(self._now_ns)

    def read_deg(self) -> tuple[float, ...]:
        """The gimbal angles as the controller reads them. Raises OSError where the link is lost."""
        self._use_link()
        angles = np.degrees(self._motion.angles_at(np.array([self._now_ns]))[0])
        angles = angles + self.servo.position_sigma_deg * self._rng.standard_normal(len(angles))
        return tuple((angles + (_WRONG_DEG if self._failing == "readback" else 0.0)).tolist())

    def advance(self, seconds: float) -> Batch:
        """Lets time pass; what was measured meanwhile."""
        self._now_ns += round(seconds * 1e9)
        if self._failing == "drive" and not self._tripped:
            self._tripped = True
            self._motion.brake(self._now_ns)
        return self._make(self.run.next_reading_ns(self._now_ns))

    @property
    def _failing(self) -> str:
        return self.servo.fault if self.servo.fault and self.now_s >= self.servo.fault_s else ""

    def _use_link(self) -> None:
        if self._failing == "link":
            raise ConnectionResetError("the connection to the controller was reset")
