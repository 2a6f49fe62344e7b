"""What the accelerometer block feels, and what an effect may depend on."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numpy.polynomial import legendre

from kf_calib.bench.arrays import Floats, Indices
from kf_calib.bench.bench import Bench, turn

REFERENCE_TEMPERATURE_C = 25.0
"""T of the catalogue is the temperature less this."""

_P = ParamSpec("_P")

_POINTS, _WEIGHTS = legendre.leggauss(10)
_INTEGRALS = legendre.legvander(_POINTS, 2).T * _WEIGHTS  # (3, n): of Legendre's polynomials times a function

_RATE_WINDOW_S = 5.0  # at least: a thermometer of 0.01 K noise then shows rates of 1e-3 K/s
_RATE_STILL = 0.02
_UNSURE = 5.0  # sigmas of a setting error
_LEAST_MOVE_RAD = 1e-4  # of a gimbal: less is noise of its encoder, or creep
_ON_WAY = 8  # parts of a way from dwell to dwell
_COURSE = (
    "elapsed_s",
    "since_arrival_s",
    "force_mps2",
    "previous_force_mps2",
    "pose",
    "previous_pose",
    "temperature_c",
)
_OF_ALL = ("bench", "sensitivity", "carrier_hz", "part", "whole", "places")  # is the same at all instants


def smooth_between(times: Floats, values: Floats, at: Floats) -> Floats:
    """Values (n,) at instants ``at`` of a smooth curve through ``values`` (k,) at rising ``times``.

    Piecewise cubic, with the slopes of Akima (J. ACM 17, 1970) in their modified form, which follow steps without
    swinging over.

    scipy.interpolate.Akima1DInterpolator(method="makima") gives the same, and takes as long to load as a run to judge.
    """
    if len(times) < 3:
        return np.interp(at, times, values)
    steps = np.diff(times)
    chords = np.diff(values) / steps
    before = 2.0 * chords[0] - chords[1], 3.0 * chords[0] - 2.0 * chords[1]
    after = 2.0 * chords[-1] - chords[-2], 3.0 * chords[-1] - 2.0 * chords[-2]
    m = np.concatenate([before[::-1], chords, after])
    size = np.abs(np.diff(m)) + 0.5 * np.abs(m[1:] + m[:-1])
    left, right = size[2:], size[:-2]  # what weighs the chord before, and that behind
    known = left + right > 1e-9 * np.max(left + right, initial=0.0)
    slopes = 0.5 * (m[1:-2] + m[2:-1])
    slopes = np.where(known, (left * m[1:-2] + right * m[2:-1]) / np.where(known, left + right, 1.0), slopes)
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
    u = at - times[k]
    bend = (3.0 * chords[k] - 2.0 * slopes[k] - slopes[k + 1]) / steps[k]
    twist = (slopes[k] + slopes[k + 1] - 2.0 * chords[k]) / steps[k] ** 2
    return values[k] + u * (slopes[k] + u * (bend + u * twist))


def lagged(at_s: Floats, values: Floats, tau_s: float) -> Floats:
    """L (n,) at instants that do not fall: tau dL/dt = values - L, in balance at first; values in straight lines.

    With steps h, r = h / tau: L_n = p L_(n-1) + (c - p) v_(n-1) + (1 - c) v_n, p = e^-r, c = (1 - p)/r.
    """
    from scipy.linalg import get_blas_funcs

    ratio = np.maximum(np.diff(at_s), 0.0) / tau_s
    decay, mean = np.exp(-ratio), np.where(ratio > 0.0, -np.expm1(-ratio) / np.where(ratio > 0.0, ratio, 1.0), 1.0)
    driven = np.append(values[0], (1.0 - mean) * values[1:] + (mean - decay) * values[:-1])
    bands = np.asfortranarray(np.vstack([np.ones(len(values)), np.append(-decay, 0.0)]))
    solve: Any = get_blas_funcs("tbsv", dtype=np.float64)  # scipy.signal.lfilter would take 0.7 s to load
    return solve(1, bands, driven, lower=1)


def through_play(values: Floats, half_width: float, start: float) -> list[float]:
    """Values (n,) through a play that begins at ``start``: y_n = max(v_n - r, min(v_n + r, y_(n-1))), the operator of
    Prandtl and Ishlinskii."""
    followed = itertools.accumulate(
        values.tolist(), lambda held, now: max(now - half_width, min(now + half_width, held)), initial=start
    )
    return list(followed)[1:]


def _of_the_whole(compute: Callable[Concatenate[Stimulus, _P], Floats]) -> Callable[Concatenate[Stimulus, _P], Floats]:
    """What depends on the course of the whole run: computed once for all of its parts, each of which has its instants
    of it."""

    @functools.wraps(compute)
    def of_part(stimulus: Stimulus, /, *args: _P.args, **kwargs: _P.kwargs) -> Floats:
        if stimulus.whole is None:
            return compute(stimulus, *args, **kwargs)
        known, key = stimulus.whole.known, (compute.__name__, *args, *kwargs.values())
        if key not in known:
            known[key] = of_part(stimulus.whole, *args, **kwargs)
        return known[key][stimulus.places]

    return of_part


@dataclass(frozen=True)
class Stimulus:
    """The state of the bench at m instants of dwells.

    elapsed_s, since_arrival_s, temperature_c: (m,); force_mps2: specific force in the platform frame, (m, 3), and pose,
    (m, k), NaN where it is not known, each of the dwell before, too; sensitivity (3, 3): rows K_i E_i at which small
    rotations are linearised;
    variance_mps2_2: variance of the readings about here, (m, 3). rate_radps, rate_change_radps2: omega of the platform
    in its own frame and its derivative there, (m, 3), zero where it stands. half_s, within: half the length of the
    piece of a dwell an instant belongs to, and where in it that is, from -1 to 1, (m,); zeros where it is of no piece.
    turned_rad: rotation vector by which effects of the model have turned the specific force already, (m, 3) or (1, 3).
    attitude_rad: rotation vector by which the platform then stands off that, as far as the readings show it, likewise.
    carrier_hz: of dwells folded on a carrier, 0: none; part: of a column, that without the carrier (0) or the envelope
    of its cosine (1), sine (2).
    """

    bench: Bench
    elapsed_s: Floats
    since_arrival_s: Floats
    force_mps2: Floats
    previous_force_mps2: Floats
    pose: Floats
    previous_pose: Floats
    temperature_c: Floats
    sensitivity: Floats
    variance_mps2_2: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    rate_radps: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    rate_change_radps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    half_s: Floats = field(default_factory=lambda: np.zeros(1))
    within: Floats = field(default_factory=lambda: np.zeros(1))
    turned_rad: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    attitude_rad: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    carrier_hz: float = 0.0
    part: int = 0
    whole: Stimulus | None = None
    """What it is a part of: temperatures that came before matter, too."""
    places: slice = field(default_factory=lambda: slice(None))
    """Which instants of the whole it has."""

    def at(self, places: slice) -> Stimulus:
        """It at some of its instants."""
        values = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in _OF_ALL}
        some = {name: value if len(value) < len(self) else value[places] for name, value in values.items()}
        return replace(self, **some, whole=self, places=places)

    def __len__(self) -> int:
        return len(self.elapsed_s)

    @cached_property
    def known(self) -> dict[tuple[object, ...], Floats]:
        """What its parts have asked for of its whole course, by name and constants."""
        return {}

    @property
    def span_s(self) -> float:
        """From the first instant to the last."""
        return float(max(np.ptp(self.elapsed_s), 1e-9))

    @property
    def longest_piece_s(self) -> float:
        """Of the pieces of dwells."""
        return float(max(2.0 * self.half_s.max(), 1e-9))

    @property
    def usual_piece_s(self) -> float:
        """Length of the piece that the middle of all the time in dwells lies in."""
        halves = np.sort(self.half_s)
        return float(max(2.0 * halves[np.searchsorted(np.cumsum(halves), 0.5 * halves.sum())], 1e-9))

    @cached_property
    def about(self) -> tuple[Floats, Floats]:
        """Instants (m, n) in the piece of each instant, and shares (m, n): the sum over them of shares times a function
        of time is, at the instant, the parabola nearest to that function in the piece.

        sum_l (2 l + 1) / 2 c_l P_l(u), c_l the integral of P_l times the function over -1 < u < 1, P_l Legendre's
        polynomials: by Gauss's rule, which holds for up to three cycles.
        """
        at_s = (self.elapsed_s - self.within * self.half_s)[:, None] + self.half_s[:, None] * _POINTS
        shares = legendre.legvander(self.within, 2) @ (np.array([[0.5], [1.5], [2.5]]) * _INTEGRALS)
        return at_s, np.broadcast_to(shares, at_s.shape)

    @cached_property
    def axes(self) -> Floats:
        """Unit input axes E_i (3, 3), a row each."""
        return self.sensitivity / np.linalg.norm(self.sensitivity, axis=1, keepdims=True)

    @property
    def unsure_rad(self) -> float:
        """The largest turn from dwell to dwell that setting errors may feign, of which both ends of a turn have one."""
        return _UNSURE * float(np.radians(self.bench.angle_sigma_deg or 0.0))

    @cached_property
    def along(self) -> Floats:
        """a_i (m, 3): specific force along the input axis of each accelerometer."""
        return self.force_mps2 @ self.axes.T

    @cached_property
    def pendulous(self) -> Floats:
        """a_p (m, 3): along the pendulous axes y, z, x of accelerometers 1, 2, 3."""
        return self.force_mps2[:, [1, 2, 0]]

    @cached_property
    def output(self) -> Floats:
        """a_o (m, 3): along the output axes z, x, y of accelerometers 1, 2, 3."""
        return self.force_mps2[:, [2, 0, 1]]

    @cached_property
    def step(self) -> Floats:
        """Delta a_i (m, 3): the last change of a_i from dwell to dwell; zero in the first."""
        return (self.force_mps2 - self.previous_force_mps2) @ self.axes.T

    @_of_the_whole
    def played(self, half_width_mps2: float) -> Floats:
        """a_i (m, 3) through a play of this half-width, m/s^2, from the orientation before: it follows only where it is
        pushed."""
        before = (self.along - self.step)[0]
        columns = [through_play(self.along[:, i], half_width_mps2, float(before[i])) for i in range(3)]
        return np.stack(columns, axis=1)

    def move(self, gimbal: int) -> Floats:
        """The move (m,) of a gimbal since the dwell before, rad; 0 where it is no larger than what setting errors, the
        noise of an encoder or rounding may feign: these have a sign, too."""
        moves = self.pose[:, gimbal] - self.previous_pose[:, gimbal]
        return np.where(np.abs(moves) > max(_LEAST_MOVE_RAD, self.unsure_rad), moves, 0.0)

    @_of_the_whole
    def way(self, gimbal: int) -> Floats:
        """The way (m,) that a gimbal has turned since the first dwell, rad: the sum of its moves, of either sense."""
        order = np.argsort(self.elapsed_s, kind="stable")
        moves, leaves = np.abs(self.move(gimbal)[order]), np.diff(self.since_arrival_s[order]) < 0.0
        way = np.empty(len(self))
        way[order] = moves + np.append(0.0, np.where(leaves, moves[:-1], 0.0)).cumsum()
        return way

    def lag(self, values: Floats | float, tau_s: float) -> Floats:
        """L (m, n): tau dL/dt = x - L, in balance at first; x, the values (m, n), in straight lines between instants,
        which are all of a run in order of time (``with_ways``)."""
        columns = np.broadcast_to(values, (len(self), *(np.shape(values)[1:] or (1,))))
        return np.stack([lagged(self.elapsed_s, column, tau_s) for column in columns.T], axis=1)

    @_of_the_whole
    def side(self, gimbal: int) -> Floats:
        """The sense (m,) of the last move of a gimbal, 1 or -1, which it keeps while it stands still; 0 until it moves.

        Poses that are proposed all come after the same dwell, and none after another: one that leaves the gimbal where
        it is has 0, since the side that it was on is not known.
        """
        senses = np.sign(self.move(gimbal))
        begins = senses != 0.0
        if not self.half_s.any():  # instants of no piece, which are not measured
            begins[1:] |= np.all(self.previous_pose[1:] == self.previous_pose[:-1], axis=1)
        return senses[np.maximum.accumulate(np.where(begins, np.arange(len(self)), 0))]

    @cached_property
    def force_rate_mps3(self) -> Floats:
        """df/dt (m, 3) in the platform frame: f x omega."""
        return np.cross(self.force_mps2, self.rate_radps)

    @cached_property
    def warmth(self) -> Floats:
        """T (m,): temperature less the reference, K; zero where it is not measured."""
        return np.nan_to_num(self.temperature_c - REFERENCE_TEMPERATURE_C)

    @cached_property
    def warming(self) -> Floats:
        """dT/dt (m,), K/s: the change of temperature over so long that its noise matters little.

        From 5 s before to 5 s after, and twice as long until that changes the rate by no more than 2 % (rms): what a
        rate that is mostly noise leaves of an effect another one explains. At the longest an eighth of the run.
        """
        if self.whole is not None:
            return self.whole.warming[self.places]
        times, _ = self._smooth_warmth
        window_s, best, best_change = _RATE_WINDOW_S, self._change(_RATE_WINDOW_S), np.inf
        rate = best
        while 2.0 * window_s <= max((times[-1] - times[0]) / 8.0, _RATE_WINDOW_S):
            window_s *= 2.0
            longer = self._change(window_s)
            size = float(np.mean(longer**2))
            change = float(np.mean((longer - rate) ** 2)) / size if size > 0.0 else 0.0
            if change < best_change:
                best, best_change = rate, change
            if change < _RATE_STILL**2:
                break
            rate = longer
        return best

    def _change(self, window_s: float) -> Floats:
        """The change (m,) of temperature per second over a window to either side of each instant.

        Nearer to an end of the run than one window, it is continued in a straight line; in a run shorter than four
        windows, the window is cut off at the end instead.
        """
        times, _ = self._smooth_warmth
        first, last = times[0] + window_s, times[-1] - window_s
        if last - first < 2.0 * window_s:
            return self._change_from(self.elapsed_s - window_s, self.elapsed_s + window_s)
        at = np.clip(self.elapsed_s, first, last)
        rate = self._change_from(at - window_s, at + window_s)
        for end, inner in ((first, first + window_s), (last, last - window_s)):
            ends = np.array([end, inner])
            at_end, at_inner = self._change_from(ends - window_s, ends + window_s)
            beyond = (self.elapsed_s - end) / (inner - end)
            rate += np.where(beyond < 0.0, beyond * (at_inner - at_end), 0.0)
        return rate

    def _change_from(self, before_s: Floats, after_s: Floats) -> Floats:
        """The change (n,) of temperature per second from instants to others, within the run."""
        times, values = self._smooth_warmth
        before_s, after_s = np.maximum(before_s, times[0]), np.minimum(after_s, times[-1])
        change = smooth_between(times, values, after_s) - smooth_between(times, values, before_s)
        return change / np.maximum(after_s - before_s, 1e-9)

    @cached_property
    def _smooth_warmth(self) -> tuple[Floats, Floats]:
        """Instants and temperatures less the reference, K, that a smooth curve goes through: the middles of the pieces,
        and both ends."""
        times, first = np.unique(np.append(self.elapsed_s[1:-1:3], self.elapsed_s[[0, -1]]), return_index=True)
        return times, np.append(self.warmth[1:-1:3], self.warmth[[0, -1]])[first]

    @property
    def level_axes(self) -> Floats:
        """North and East in the bench frame, (2, 3)."""
        azimuth = np.radians(self.bench.azimuth_deg)
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        return np.array([[cos, 0.0, -sin], [sin, 0.0, cos]])

    @_of_the_whole
    def lagged_warmth(self, tau_s: float) -> Floats:
        """L (m,), K: tau dL/dt = T - L, in balance at first; T passes smoothly through the middles of the pieces."""
        times, values = self._smooth_warmth
        span = max(times[-1] - times[0], 1e-9)
        grid = np.linspace(times[0], times[-1], int(np.clip(20.0 * span / tau_s, 1000, 20_000)))
        return np.interp(self.elapsed_s, grid, lagged(grid, smooth_between(times, values, grid), tau_s))

    @_of_the_whole
    def remembered(self, tau_s: float) -> Floats:
        """x (m, 3), m/s^2: tau dx/dt = a_i - x, in balance at first."""
        return self.of_course(lambda course: course.lag(course.along, tau_s))

    @_of_the_whole
    def of_course(self, values: Callable[[Stimulus], Floats]) -> Floats:
        """Values (m, n) of a function of the whole run in order of time (``with_ways``), at the instants of this."""
        course, places = self.with_ways
        return values(course)[places]

    @cached_property
    def with_ways(self) -> tuple[Stimulus, Indices]:
        """The whole run in order of time with instants on the ways from dwell to dwell, and which of all its own are:
        there the platform turns from pose to pose until it has arrived, all gimbals at once, slowly at both ends."""
        order = np.argsort(self.elapsed_s, kind="stable")
        arrived = np.flatnonzero(np.diff(self.since_arrival_s[order]) < 0.0) + 1
        leaving, arriving = self.at_instants(order[arrived - 1]), self.at_instants(order[arrived])
        arrived_s = np.maximum(arriving.elapsed_s - arriving.since_arrival_s, leaving.elapsed_s)
        parts = [self.at_instants(order), *(
            leaving.on_way_to(arriving, arrived_s, share) for share in np.arange(1, _ON_WAY + 1) / _ON_WAY
        )]  # fmt: skip
        joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COURSE}
        all_s = joined["elapsed_s"]
        in_time = np.lexsort((np.arange(len(all_s)) < len(order), all_s))  # at the same time the way comes first
        rank, places = np.empty(len(all_s), np.intp), np.empty(len(order), np.intp)
        rank[in_time] = np.arange(len(all_s))
        places[order] = rank[: len(order)]
        course = Stimulus(self.bench, sensitivity=self.sensitivity,
                          **{name: values[in_time] for name, values in joined.items()})  # fmt: skip
        vars(course)["warming"] = np.interp(course.elapsed_s, self.elapsed_s[order], self.warming[order])
        return course, places

    def at_instants(self, numbers: Indices) -> Stimulus:
        """Another run, of some of the instants alone, by what a course is made of."""
        kept = {name: getattr(self, name)[numbers] for name in _COURSE}
        return Stimulus(self.bench, **kept, sensitivity=self.sensitivity)

    def on_way_to(self, arriving: Stimulus, arrived_s: Floats, share: float) -> Stimulus:
        """Instants at a share of the time of ways that begin here and end at another's."""
        turned, pose, before = share**2 * (3.0 - 2.0 * share), arriving.pose, arriving.previous_pose
        if not self.bench.axes:  # a quaternion and its negative are the same
            before = np.where(np.sum(before * pose, axis=1, keepdims=True) < 0.0, -before, before)
        at_s, pose = self.elapsed_s + share * (arrived_s - self.elapsed_s), before + turned * (pose - before)
        force = self.force_mps2 + turned * (arriving.force_mps2 - self.force_mps2)
        if self.bench.angles and np.isfinite(before).all() and share < 1.0:
            force = self.bench.specific_force(at_s, pose)
        warm = self.temperature_c + share * (arriving.temperature_c - self.temperature_c)
        return replace(arriving, elapsed_s=at_s, force_mps2=force, pose=pose, temperature_c=warm,
                       since_arrival_s=0.0 * at_s)  # fmt: skip

    @_of_the_whole
    def played_warmth(self, half_width_k: float) -> Floats:
        """T (m,), K, through a play of this half-width, from the first T on."""
        order = np.argsort(self.elapsed_s, kind="stable")
        warm = self.warmth[order]
        through = np.empty(len(warm))
        through[order] = through_play(warm, half_width_k, float(warm[0]))
        return through

    @cached_property
    def level_in_platform(self) -> Floats:
        """North and East seen in the platform, (m, 2, 3)."""
        return np.stack([self.to_platform(axis) for axis in self.level_axes], axis=1)

    @cached_property
    def gimbal_axes(self) -> Floats:
        """The axis of each gimbal seen in the platform, (m, k, 3)."""
        axes = np.zeros((len(self), len(self.bench.axes), 3))
        for k, axis in enumerate(self.bench.axes):
            axes[:, k] = self.inner(np.array(axis), k)
        return axes

    def to_platform(self, vector: Floats) -> Floats:
        """A bench vector (3,) seen in the platform, (m, 3)."""
        return np.broadcast_to(self.bench.to_platform(vector, self.pose), (len(self), 3))

    def inner(self, vector: Floats, gimbal: int) -> Floats:
        """A vector (3,) or (m, 3) of the frame carried by a gimbal, seen in the platform, (m, 3)."""
        for k in range(gimbal + 1, len(self.bench.axes)):
            vector = turn(vector, np.array(self.bench.axes[k]), -self.pose[:, k])
        return np.broadcast_to(vector, (len(self), 3))
