"""The loop of a bench that drives itself, as a function of values: state and observation in, state and command out.

    state, command = step(state, seen, rules)

It knows no clock, no thread and no device, and so can be tried on any course of events. The order of a stay is: a
suggestion is asked for, the way is checked, the gimbals are told to go, they go, they stand, they stay until there are
readings enough. Whatever does not go as it should gives a ``Halt``: the table is to be stopped, and nothing moves any
more.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.design.gimbal_limits import MARGIN_DEG, GimbalLimits, is_free, route, wrap
from kf_calib.design.next_orientation import SlewTimes
from kf_calib.online.suggestion import Suggestion
from kf_calib.positioning.positioner import Watchfulness

_FIRST_S = 8.0  # of readings where the table stands first
_LONGER = 3.0  # times that a stay may last beyond its plan where readings come more slowly than expected
_GRACE_S = 10.0
_PROOF_DEG = 3.0  # of a first move of each gimbal
Angles = tuple[float, ...]


class Phase(enum.Enum):
    """What the loop waits for."""

    BEGINNING = "beginning"
    MOVING = "moving"
    STAYING = "staying"
    ASKING = "choosing"
    ENDED = "ended"


@dataclass(frozen=True)
class Move:
    """Tell the gimbals to go to these angles, deg."""

    gimbal_deg: Angles


@dataclass(frozen=True)
class Ask:
    """Ask for a suggestion, and give it with the next observation."""


@dataclass(frozen=True)
class Halt:
    """Stop the table: something is not as it should be."""

    reason: str


@dataclass(frozen=True)
class End:
    """The run is complete; the table stands."""

    suggestion: Suggestion


Command = Move | Ask | Halt | End


@dataclass(frozen=True)
class Seen:
    """What is known at a moment.

    now_s: time when the read-back gimbal_deg had come; held_up_s: how long after it was asked for. fault: of the
    controller. trouble: of the source, the recording or the user, why the run is to be broken off. samples: readings in
    all. stay_s: seconds of readings that count in the open dwell. stream_deg: angles of the open dwell as they are
    recorded; None where there is none. suggestion: the one asked for.
    """

    now_s: float
    gimbal_deg: Angles
    fault: str = ""
    trouble: str = ""
    samples: int = 0
    stay_s: float = 0.0
    stream_deg: Angles | None = None
    suggestion: Suggestion | None = None
    held_up_s: float = 0.0


@dataclass(frozen=True)
class Rules:
    """Limits that hold for every command and every read-back: of the bench, of its slews, and of a motion.

    until_s: when the time of the run is spent, and a stay ends in any case.
    """

    limits: GimbalLimits
    slew_times: SlewTimes = field(default_factory=SlewTimes)
    watch: Watchfulness = field(default_factory=Watchfulness)
    until_s: float = math.inf


@dataclass(frozen=True)
class State:
    """Where the loop stands.

    target, start: of the move under way, deg; way: where to go after it. since_s: when the phase began. track: the
    latest read-backs with their times. suggestion: the one that is carried out. heard: number of readings, and when it
    grew last. held_up_s: how long the read-back before the latest was under way. number: of the stay. unproved: how
    many stations of the way are first small moves, which the recorded angles have to show.
    """

    phase: Phase = Phase.BEGINNING
    target: Angles = ()
    start: Angles = ()
    way: tuple[Angles, ...] = ()
    since_s: float = 0.0
    track: tuple[tuple[float, Angles], ...] = ()
    suggestion: Suggestion | None = None
    heard: tuple[int, float] = (0, 0.0)
    held_up_s: float = 0.0
    number: int = 0
    unproved: int = 0


def step(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """One step of the loop."""
    if state.phase is Phase.ENDED:
        return state, None
    state = _noted(state, seen, rules)
    harm = _harm(state, seen, rules)
    state = replace(state, held_up_s=seen.held_up_s)
    if harm:
        return replace(state, phase=Phase.ENDED), Halt(harm)
    match state.phase:
        case Phase.BEGINNING:
            return replace(state, phase=Phase.STAYING, target=seen.gimbal_deg, since_s=seen.now_s, number=1), None
        case Phase.MOVING:
            return _moving(state, seen, rules)
        case Phase.STAYING:
            return _staying(state, seen, rules)
        case _:
            return _choosing(state, seen, rules)


def _noted(state: State, seen: Seen, rules: Rules) -> State:
    """Return the state with what was seen in its track."""
    window_s = seen.now_s - rules.watch.stand_s
    before = [past for past in state.track if past[0] <= window_s][-1:]  # so that the window is covered
    after = [past for past in state.track if past[0] > window_s]
    track = (*before, *after, (seen.now_s, seen.gimbal_deg))
    heard = (seen.samples, seen.now_s) if seen.samples > state.heard[0] or not state.track else state.heard
    return replace(state, track=track, heard=heard)


def _harm(state: State, seen: Seen, rules: Rules) -> str:
    """Return why the table must be stopped now; empty where it need not."""
    here = _deg(seen.gimbal_deg)
    if seen.fault:
        return f"the positioner reports a fault: {seen.fault}"
    if seen.trouble:
        return seen.trouble
    if not all(np.isfinite(seen.gimbal_deg)):
        return f"the read-back {here} is no position"
    if left := _outside(seen.gimbal_deg, rules):
        return f"the platform is at {here}, {left}"
    if (leap_deg := _leap_deg(state, rules)) > 0.0:
        return (
            f"the read-back leaps: by {leap_deg:.0f} deg, faster than {rules.slew_times.rate_degps:g} deg/s can do it"
        )
    return ""


def is_impossible(state: State, seen: Seen, rules: Rules) -> bool:
    """Whether the platform cannot be where a read-back says."""
    return not all(np.isfinite(seen.gimbal_deg)) or _leap_deg(_noted(state, seen, rules), rules) > 0.0


def _outside(gimbal_deg: Sequence[float], rules: Rules) -> str:
    """Return in which way a read-back is where it must not be, in words; empty where it may be there."""
    pose, margin = np.radians([gimbal_deg]), np.radians(MARGIN_DEG)
    low, high = rules.limits.bounds.T
    limited = [j for j in rules.limits.limits_deg if not low[j] - margin <= pose[0, j] <= high[j] + margin]
    if limited:
        return f"beyond the limits of gimbal {limited[0] + 1}"
    inside = replace(rules.limits, limits_deg={}).allowed(wrap(pose))[0]
    return "" if inside else "in a forbidden zone"


def _moving(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """Watch a move until the platform stands at its target."""
    watch, lasted_s, target = rules.watch, seen.now_s - state.since_s, _deg(state.target)
    expected_s = float(rules.slew_times.slews_s(np.radians(state.start), np.radians(state.target)))
    here, off = np.array(seen.gimbal_deg), np.abs(np.array(seen.gimbal_deg) - np.array(state.target)).max()
    low, high = np.minimum(state.start, state.target), np.maximum(state.start, state.target)
    if (here < low - watch.off_path_deg).any() or (here > high + watch.off_path_deg).any():
        return _halted(state, f"on the way to {target} the platform is at {_deg(seen.gimbal_deg)}, off its way")
    way = np.abs(np.array(state.target) - np.array(state.start)).max()
    moved = np.abs(here - np.array(state.start)).max()
    if lasted_s > watch.begin_s and moved <= min(2.0 * watch.tolerance_deg, 0.5 * way):
        return _halted(state, f"the move to {target} did not begin within {watch.begin_s:g} s")
    stands = lasted_s >= watch.stand_s and _stands(state, watch)
    if stands and off <= watch.tolerance_deg:
        if state.unproved:
            return _proving(state, seen, rules)
        if state.way:
            return _to_next_station(state, seen, rules)
        return replace(state, phase=Phase.STAYING, since_s=seen.now_s), None
    if lasted_s > watch.late_factor * expected_s + watch.late_s:
        if stands:
            return _halted(state, f"the platform stands at {_deg(seen.gimbal_deg)} instead of {target}")
        return _halted(state, f"the move to {target} did not end within {lasted_s:.0f} s ({expected_s:.0f} s expected)")
    return state, None


def _proving(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """Wait at the end of a first small move until the recorded angles show it, too."""
    recorded, lasted_s = seen.stream_deg, seen.now_s - state.since_s
    if recorded is not None and _apart_deg(recorded, state.target) <= rules.watch.stream_deg:
        return _to_next_station(replace(state, unproved=state.unproved - 1), seen, rules)
    if lasted_s > rules.watch.silent_s:
        gimbal = int(np.abs(np.array(state.target) - np.array(state.start)).argmax()) + 1
        shown = "no angles are recorded" if recorded is None else f"the angles recorded are {_deg(recorded)}"
        words = f"gimbal {gimbal} was turned by a little, from {_deg(state.start)} to {_deg(state.target)}, and {shown}"
        return _halted(state, f"{words}: check sign, zero, unit and order of the gimbals in the profile")
    return state, None


def _first_moves(start_deg: Angles, rules: Rules) -> list[Angles]:
    """Return where each gimbal in turn goes by a little, to where it may, before anything moves far."""
    here, stations = np.array(start_deg), list[Angles]()
    for gimbal in range(len(here)):
        for way_deg in (_PROOF_DEG, -_PROOF_DEG):
            there = here.copy()
            there[gimbal] += way_deg
            end = np.radians([there])
            if rules.limits.allowed(end)[0] and is_free(rules.limits, np.radians(here), end)[0]:
                stations.append(tuple(there.round(6).tolist()))
                here = there
                break
    return stations


def _staying(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """Stay until there are readings enough."""
    watch, lasted_s = rules.watch, seen.now_s - state.since_s
    wanted_s = state.suggestion.stay_s if state.suggestion else _FIRST_S
    if moved := _moved_by_itself(state, seen, rules):
        return _halted(state, moved)
    if seen.now_s - state.heard[1] > watch.silent_s:
        return _halted(state, f"no reading came for {watch.silent_s:g} s")
    recorded = seen.stream_deg
    is_here = recorded is not None and _apart_deg(recorded, state.target) <= watch.stream_deg
    if not is_here and lasted_s > watch.silent_s and watch.silent_s < np.inf:
        shown = "no angles are recorded" if recorded is None else f"the angles recorded are {_deg(recorded)}"
        words = f"the positioner stands at {_deg(state.target)}, and {shown}: check signs, zeros and order"
        return _halted(state, words)
    longest_s = _LONGER * wanted_s + _GRACE_S
    if (is_here and seen.stay_s >= wanted_s) or lasted_s > longest_s or seen.now_s >= rules.until_s:
        return replace(state, phase=Phase.ASKING, since_s=seen.now_s, suggestion=None), Ask()
    return state, None


def _moved_by_itself(state: State, seen: Seen, rules: Rules) -> str:
    """Return that a platform that should stand has moved, in words; empty where it has not."""
    off = np.abs(np.array(seen.gimbal_deg) - np.array(state.target)).max()
    if off <= 3.0 * rules.watch.tolerance_deg:
        return ""
    return f"the platform should stand at {_deg(state.target)} and is at {_deg(seen.gimbal_deg)}: it moved by itself"


def _choosing(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """Begin what is suggested."""
    suggestion = seen.suggestion
    if moved := _moved_by_itself(state, seen, rules):
        return _halted(state, moved)
    if suggestion is None:
        return state, None
    if suggestion.ended:
        return replace(state, phase=Phase.ENDED, suggestion=suggestion), End(suggestion)
    is_driven = rules.watch.silent_s < math.inf
    first = _first_moves(seen.gimbal_deg, rules) if state.number == 1 and is_driven else []
    begin_deg = first[-1] if first else seen.gimbal_deg
    way = route(rules.limits, np.radians(begin_deg), np.radians(suggestion.gimbal_deg))
    if way is None:
        return _halted(state, f"no way to {_deg(suggestion.gimbal_deg)} keeps within the limits and out of the zones")
    stations = tuple(tuple(float(angle) for angle in np.degrees(station).round(6) + 0.0) for station in way)
    way_there = (*first, *stations)
    state = replace(state, suggestion=suggestion, way=way_there, number=state.number + 1, unproved=len(first))
    return _to_next_station(state, seen, rules)


def _to_next_station(state: State, seen: Seen, rules: Rules) -> tuple[State, Command | None]:
    """Go to the next station of the way, if that is allowed from where the platform is."""
    station, start = state.way[0], np.radians(seen.gimbal_deg)
    end = np.radians([station])
    if not (rules.limits.allowed(end)[0] and is_free(rules.limits, start, end)[0]):
        return _halted(state, f"the way from {_deg(seen.gimbal_deg)} to {_deg(station)} is not allowed")
    state = replace(state, phase=Phase.MOVING, target=station, start=seen.gimbal_deg, way=state.way[1:])
    return replace(state, since_s=seen.now_s), Move(station)


def _halted(state: State, reason: str) -> tuple[State, Command]:
    return replace(state, phase=Phase.ENDED), Halt(reason)


def _stands(state: State, watch: Watchfulness) -> bool:
    """Tell whether the read-backs of the last ``stand_s`` show no motion."""
    (first_s, _), (now_s, _) = state.track[0], state.track[-1]
    if now_s - max(first_s, state.since_s) < watch.stand_s - 1e-6:
        return False
    angles = np.array([angles for _, angles in state.track])
    return bool(np.ptp(angles, axis=0).max() <= watch.still_degps * (now_s - first_s))


def _leap_deg(state: State, rules: Rules) -> float:
    """Return by how much a gimbal moved between two read-backs, where that is more than its rate allows; else 0."""
    track = state.track[-2:]
    if len(track) < 2 or rules.watch.late_s == math.inf:  # a person turns as fast as he can
        return 0.0
    (before_s, before), (now_s, now) = track
    moved = float(np.abs(np.array(now) - np.array(before)).max())
    fastest = rules.watch.late_factor * rules.slew_times.rate_degps
    at_most_s = now_s - before_s + state.held_up_s + rules.watch.latency_s
    return moved if moved > fastest * at_most_s + rules.watch.off_path_deg else 0.0


def _apart_deg(one: Sequence[float], other: Sequence[float]) -> float:
    return float(np.degrees(np.abs(wrap(np.radians(one) - np.radians(other))).max()))


def _deg(angles: Sequence[float]) -> str:
    return f"({', '.join(f'{angle:.2f}'.rstrip('0').rstrip('.') for angle in angles)}) deg"
