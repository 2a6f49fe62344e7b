"""Drives a bench: carries out what the loop commands, and sees to it that the table is stopped first, however it ends.

drive = Drive(positioner, session, itinerary, rules, time)
outcome = drive.run()              # in any thread; drive.break_off("Ctrl-C") from any other
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from kf_calib.errors import KfCalibError
from kf_calib.online.session import Session
from kf_calib.online.suggestion import Itinerary, Suggestion
from kf_calib.positioning.loop import Angles, Ask, End, Halt, Move, Rules, Seen, State, is_impossible, step
from kf_calib.positioning.positioner import Interruptible, Positioner

_REST_S = 5.0  # in which a table comes to rest after it was told to stop


class Time(Protocol):
    """A clock that can be waited on; that of a simulated bench goes on only then. tick_s: between two looks."""

    tick_s: float

    def now_s(self) -> float: ...

    def sleep(self, seconds: float) -> None: ...


class WallTime:
    """The time of the computer."""

    tick_s = 0.1

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


@dataclass(frozen=True)
class Decision:
    """What was decided, when (s since the drive began), and why. gimbal_deg: empty where the run was to end."""

    number: int
    at_s: float
    purpose: str
    gimbal_deg: Angles
    stay_s: float
    why: str


@dataclass(frozen=True)
class Outcome:
    """How a drive ended.

    ended: ``targets``, ``named``, ``disagrees``, ``orientations``, ``budget`` or ``halted``. why: in words.
    stands_at: the last read-back, deg; empty where none could be had. stopped: whether the table was seen to stand,
    where it was halted. decisions: in their order.
    """

    ended: str
    why: str
    stands_at: Angles
    stopped: bool
    decisions: tuple[Decision, ...]
    lasted_s: float

    @property
    def is_halted(self) -> bool:
        return self.ended == "halted"


class Drive:
    """One run of a bench that drives itself.

    trouble: why the run must be broken off, by the source and the recording; empty where it need not. budget_s: time
    after which the run ends, amid a stay or after a move. decided: is told each decision.
    """

    def __init__(
        self,
        positioner: Positioner,
        session: Session,
        itinerary: Itinerary,
        rules: Rules,
        clock: Time | None = None,
        *,
        trouble: Callable[[], str] = lambda: "",
        budget_s: float = math.inf,
    ) -> None:
        self.positioner, self.session, self.itinerary, self.rules = positioner, session, itinerary, rules
        self.clock, self._trouble, self._budget_s = clock or WallTime(), trouble, budget_s
        self.decided: Callable[[Decision], None] = lambda decision: None
        self.decisions = list[Decision]()
        self.state = State()
        self.outcome: Outcome | None = None
        self._broken_off, self._here, self._began_s = "", Angles(()), self.clock.now_s()
        self._is_stopping = False
        if isinstance(positioner, Interruptible):
            positioner.when_broken_off(lambda: bool(self._broken_off) and not self._is_stopping)

    def break_off(self, reason: str) -> None:
        """Stop the table and end the run, as soon as the loop looks; only sets a flag, for signal handlers."""
        self._broken_off = self._broken_off or reason

    def run(self) -> Outcome:
        """Drive the bench until the run ends; whatever happens, the table is told to stop before this returns."""
        self._began_s = self.clock.now_s()
        self.rules = replace(self.rules, until_s=self._began_s + self._budget_s)
        try:
            self.outcome = self._run()
        except BaseException as error:
            stopped = self._stop()
            said = str(error) if isinstance(error, KfCalibError | OSError) else f"{type(error).__name__}: {error}"
            said = self._broken_off if self._broken_off and isinstance(error, KfCalibError) else said
            self.outcome = self._halted(said.removesuffix("."), stopped)
            if not isinstance(error, Exception):
                raise
        return self.outcome

    def _run(self) -> Outcome:
        suggestion: Suggestion | None = None
        while True:
            seen = replace(self._look(), suggestion=suggestion)
            self.state, command = step(self.state, seen, self.rules)
            suggestion = None
            match command:
                case Move(gimbal_deg):
                    self.positioner.move_to(gimbal_deg)
                case Ask():
                    suggestion = self._suggestion()
                    continue
                case Halt(reason):
                    return self._halted(reason, self._stop())
                case End(last):
                    return self._outcome(last.ended, last.why, stopped=True)
                case None:
                    pass
            self.clock.sleep(self.clock.tick_s)

    def _suggestion(self) -> Suggestion:
        """Return what comes next, and make it known."""
        if self._elapsed_s >= self._budget_s:
            suggestion = Suggestion("end", f"the time of {self._budget_s:g} s is spent", ended="budget")
        else:
            suggestion = self.session.suggest(self.itinerary)
        number, angles = len(self.decisions) + 1, suggestion.gimbal_deg
        decision = Decision(number, self._elapsed_s, suggestion.purpose, angles, suggestion.stay_s, suggestion.why)
        self.decisions.append(decision)
        self.decided(decision)
        return suggestion

    def _look(self) -> Seen:
        asked_s = self.clock.now_s()
        here = tuple(self.positioner.read())
        now_s = self.clock.now_s()
        standing = self.session.standing
        pose = None if standing.current is None else tuple(np.degrees(standing.current.pose).tolist())
        trouble, fault = self._broken_off or self._trouble(), self.positioner.fault()
        seen = Seen(now_s, here, fault, trouble, standing.samples, standing.stayed_s, pose)
        if not is_impossible(self.state, seen, self.rules):
            self._here = here
        return replace(seen, held_up_s=now_s - asked_s)

    def _stop(self) -> bool:
        """Tell the table to stop, twice if need be; whether it was then seen to stand."""
        self._is_stopping = True
        for _ in range(2):
            with suppress(Exception):
                self.positioner.stop()
                if (here := self._rest()) is not None:
                    self._here = here
                    return True
        return False

    def _rest(self) -> Angles | None:
        """Return where the table is seen to stand for ``stand_s`` after a stop; None where it is not.

        A read-back counts only together with others like it: a controller that was told to stop may answer anything.
        """
        watch, began_s, track = self.rules.watch, self.clock.now_s(), list[tuple[float, Angles]]()
        while self.clock.now_s() - began_s <= _REST_S + watch.stand_s:
            now_s = self.clock.now_s()
            track = [past for past in track if past[0] >= now_s - 2.0 * watch.stand_s]
            track.append((now_s, tuple(self.positioner.read())))
            window = [past for past in track if past[0] >= now_s - watch.stand_s - self.clock.tick_s]
            angles, lasted_s = np.array([here for _, here in window]), now_s - window[0][0]
            is_still = np.isfinite(angles).all() and np.ptp(angles, axis=0).max() <= watch.still_degps * lasted_s
            if len(window) > 1 and lasted_s >= watch.stand_s and is_still and self._is_near(window[-1][1]):
                return window[-1][1]
            self.clock.sleep(self.clock.tick_s)
        return None

    def _is_near(self, here: Angles) -> bool:
        """Tell whether the table can have come here from where it was seen last."""
        if not self._here:
            return True
        run_out_deg = self.rules.watch.late_factor * self.rules.slew_times.rate_degps * _REST_S
        return bool(np.abs(np.array(here) - np.array(self._here)).max() <= run_out_deg)

    @property
    def _elapsed_s(self) -> float:
        return self.clock.now_s() - self._began_s

    def _halted(self, reason: str, stopped: bool) -> Outcome:
        return self._outcome("halted", reason, stopped)

    def _outcome(self, ended: str, why: str, stopped: bool) -> Outcome:
        return Outcome(ended, why, self._here, stopped, tuple(self.decisions), self._elapsed_s)
