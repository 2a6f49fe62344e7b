"""The loop as a function of values: no clock, no thread, no device."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.design.gimbal_limits import GimbalLimits, can_be_reached, is_free, route
from kf_calib.online.suggestion import Suggestion
from kf_calib.positioning.loop import Ask, End, Halt, Move, Phase, Rules, Seen, State, step
from kf_calib.positioning.positioner import Watchfulness

BENCH = Bench(axes_of("yzx"), 9.81, limits_deg="z=-90:90", forbidden_deg="y=30:60,x=-20:20")
RULES = Rules(GimbalLimits.of(BENCH))
GOING = Suggestion("opening", "why", (90.0, 0.0, 90.0), 5.0)
TICK_S = 0.1


def begun(now_s: float = 0.0, rules: Rules = RULES, first: bool = False) -> State:
    """A loop that has asked for a suggestion at zero, after its first small moves unless ``first``."""
    state, command = State(), None
    for samples in range(200):
        seen = Seen(now_s, (0.0, 0.0, 0.0), samples=samples, stay_s=samples * TICK_S, stream_deg=(0.0, 0.0, 0.0))
        state, command = step(state, seen, rules)
        now_s += TICK_S
        if command is not None:
            break
    assert command == Ask() and state.phase is Phase.ASKING
    return state if first else replace(state, number=2)


def told(state: State, now_s: float = 20.0) -> State:
    """After the suggestion to go to (90, 0, 90)."""
    state, command = step(state, Seen(now_s, (0.0, 0.0, 0.0), suggestion=GOING), RULES)
    assert isinstance(command, Move)
    return state


def test_it_waits_for_readings_before_it_asks_and_moves_nothing_till_then() -> None:
    state, commands = State(), list[object]()
    for k in range(60):
        state, command = step(state, Seen(k * TICK_S, (0.0, 0.0, 0.0), samples=0), RULES)
        commands.append(command)
    assert commands == [None] * 60


def test_where_all_gimbals_at_once_might_cross_a_zone_they_go_one_after_the_other() -> None:
    state = begun()
    state, command = step(state, Seen(20.0, (0.0, 0.0, 0.0), suggestion=GOING), RULES)
    assert command == Move((0.0, 0.0, 90.0)) and state.way == ((90.0, 0.0, 90.0),)  # x first: out of the zone's reach
    for k in range(30):
        state, command = step(state, Seen(30.0 + k * TICK_S, (0.0, 0.0, 90.0)), RULES)
        if command:
            break
    assert command == Move((90.0, 0.0, 90.0))


@pytest.mark.parametrize(
    ("going", "words"),
    [((0.0, 95.0, 0.0), "no way"), ((45.0, 0.0, 0.0), "no way"), ((90.0, 0.0, 0.0), None)],
)
def test_a_suggestion_beyond_the_limits_is_never_carried_out(going: tuple[float, ...], words: str | None) -> None:
    state, command = step(begun(), Seen(20.0, (0.0, 0.0, 0.0), suggestion=replace(GOING, gimbal_deg=going)), RULES)
    if words is None:  # round the zone, one gimbal after the other, is no way through it
        assert isinstance(command, Move | Halt)
    else:
        assert isinstance(command, Halt) and words in command.reason and state.phase is Phase.ENDED


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"fault": "interlock"}, "reports a fault: interlock"),
        ({"trouble": "Ctrl-C was pressed"}, "Ctrl-C"),
        ({"gimbal_deg": (0.0, 0.0, 60.0)}, "leaps"),
        ({"gimbal_deg": (0.0, 93.0, 0.0)}, "beyond the limits of gimbal 2"),
        ({"gimbal_deg": (45.0, 0.0, 0.0)}, "forbidden zone"),
        ({"gimbal_deg": (float("nan"), 0.0, 0.0)}, "no position"),
    ],
)
@pytest.mark.parametrize("moves", [False, True])
def test_what_is_not_as_it_should_be_halts_in_every_phase(changed: dict, words: str, moves: bool) -> None:
    state = told(begun()) if moves else step(begun(), Seen(20.0, (0.0, 0.0, 0.0)), RULES)[0]
    state, command = step(state, replace(Seen(20.1, (0.0, 0.0, 0.0)), **changed), RULES)
    assert isinstance(command, Halt) and words in command.reason
    state, command = step(state, Seen(20.2, (0.0, 0.0, 0.0), suggestion=GOING), RULES)
    assert command is None and state.phase is Phase.ENDED  # nothing moves any more


def test_a_move_has_to_begin_and_to_end_in_time() -> None:
    start = told(begun())
    state, command, k = start, None, 0
    while command is None:
        k += 1
        state, command = step(state, Seen(20.0 + k * TICK_S, (0.0, 0.0, 0.0)), RULES)
    assert isinstance(command, Halt) and "did not begin within 3 s" in command.reason and k <= 31
    state, command, k = start, None, 0
    while command is None:  # it creeps
        k += 1
        state, command = step(state, Seen(20.0 + k * TICK_S, (0.0, 0.0, 0.3 * k * TICK_S)), RULES)
    assert isinstance(command, Halt) and "did not end within" in command.reason
    assert k * TICK_S < 1.5 * 5.0 + 5.0 + 0.2


def test_a_read_back_that_was_held_up_on_its_way_is_no_leap() -> None:
    """By a busy computer: 4 deg lie between two that come 20 ms apart, at 20 deg/s, because one of them came late."""
    state = told(begun())
    for now_s, angle in ((20.1, 0.5), (20.5, 5.0), (20.52, 9.0), (20.7, 13.0)):
        state, command = step(state, Seen(now_s, (0.0, 0.0, angle)), RULES)
        assert command is None
    held_up, command = step(state, replace(Seen(20.72, (0.0, 0.0, 13.5)), held_up_s=1.2), RULES)
    assert command is None and step(held_up, Seen(20.8, (0.0, 0.0, 38.0)), RULES)[1] is None
    _, command = step(state, Seen(20.72, (0.0, 0.0, 40.0)), RULES)
    assert isinstance(command, Halt) and "leaps" in command.reason


def test_a_person_may_take_any_time() -> None:
    rules = replace(RULES, watch=Watchfulness().by_hand())
    state = told(begun(rules=rules))
    for k in range(3000):
        state, command = step(state, Seen(20.0 + k, (0.0, 0.0, 0.0)), rules)
        assert command is None
    state, command = step(state, Seen(3020.0, (0.0, 0.0, 90.0)), rules)
    assert command == Move((90.0, 0.0, 90.0))


def test_a_suggestion_to_end_ends() -> None:
    ending = Suggestion("end", "all targets are reached", ended="targets")
    state, command = step(begun(), Seen(20.0, (0.0, 0.0, 0.0), suggestion=ending), RULES)
    assert command == End(ending) and state.phase is Phase.ENDED


angles = st.tuples(st.integers(-180, 180), st.integers(-90, 90), st.integers(-180, 180))


@given(angles, angles)
@settings(max_examples=200, deadline=None)
def test_a_way_enters_no_zone_however_fast_each_gimbal_goes(start: tuple, end: tuple) -> None:
    """By poses drawn in the box between the stations: each gimbal anywhere between its two angles."""
    limits, here, there = RULES.limits, np.radians(start), np.radians(end)
    if not limits.allowed(here[None])[0]:
        return
    way = route(limits, here, there)
    assert (way is not None) == can_be_reached(limits, here, there[None])[0]
    if way is None:
        return
    rng = np.random.default_rng(0)
    assert np.array_equal(way[-1], there)
    for before, after in zip([here, *way[:-1]], way, strict=True):
        assert is_free(limits, before, after[None])[0]
        between = before + rng.random((200, 3)) * (after - before)
        assert limits.allowed(between).all()


def played(gains: np.ndarray, silent: bool = False) -> tuple[list[object], list[tuple[float, ...]]]:
    """Commands and places of a loop whose platform turns by ``gains`` (3, 3) of what the read-back says."""
    rules, state, now_s, here = (
        Rules(GimbalLimits.of(Bench(axes_of("yzx"), 9.81))),
        begun(first=True),
        20.0,
        np.zeros(3),
    )
    commands, places = list[object](), list[tuple[float, ...]]()
    state, command = step(state, Seen(now_s, tuple(here), suggestion=GOING), rules)
    for _ in range(1500):
        if command is not None:
            commands.append(command)
            if not isinstance(command, Move):
                break
            target = np.array(command.gimbal_deg)
        now_s += TICK_S
        here = here + np.clip(target - here, -2.0, 2.0)
        true_deg = tuple((gains @ here).tolist())
        places.append(true_deg)
        still = bool(np.abs(target - here).max() < 1e-9) and not silent
        seen = Seen(now_s, tuple(here.tolist()), samples=len(places), stream_deg=true_deg if still else None)
        state, command = step(state, seen, rules)
        if state.phase is Phase.STAYING:
            break
    return commands, places


def test_each_gimbal_goes_by_a_little_before_anything_goes_far() -> None:
    commands, places = played(np.eye(3))
    moves = [command.gimbal_deg for command in commands if isinstance(command, Move)]
    assert moves[:3] == [(3.0, 0.0, 0.0), (3.0, 3.0, 0.0), (3.0, 3.0, 3.0)] and moves[-1] == GOING.gimbal_deg
    assert places[-1] == pytest.approx(GOING.gimbal_deg)


@pytest.mark.parametrize(("gains", "gimbal"), [
    (np.diag([-1.0, 1.0, 1.0]), 1), (np.diag([1.0, -1.0, 1.0]), 2), (np.diag([1.0, 1.0, np.pi / 180.0]), 3),
    (np.eye(3)[[1, 0, 2]], 1), (np.diag([1.0, 1.0, 2.0]), 3),
])  # fmt: skip
def test_a_gimbal_that_turns_otherwise_than_it_is_told_is_stopped_within_a_few_degrees(
    gains: np.ndarray, gimbal: int
) -> None:
    """A wrong sign, unit, size, or gimbals that are exchanged in the profile."""
    commands, places = played(gains)
    halt = commands[-1]
    assert isinstance(halt, Halt) and f"gimbal {gimbal} was turned by a little" in halt.reason
    assert np.abs(places).max() < 7.0


def test_without_recorded_angles_nothing_goes_far() -> None:
    commands, places = played(np.eye(3), silent=True)
    halt = commands[-1]
    assert isinstance(halt, Halt) and "no angles are recorded" in halt.reason and np.abs(places).max() < 4.0
