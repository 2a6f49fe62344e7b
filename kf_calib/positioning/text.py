"""A bench that drives itself: what it is doing, its decisions as JSON and in words, and a dry run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench.arrays import Floats
from kf_calib.positioning.loop import Phase
from kf_calib.positioning.positioner import HandPositioner
from kf_calib.support.text import angles_in_words
from kf_calib.support.units import span
from kf_calib.views.live.content import Doing
from kf_calib.views.terminal import table

if TYPE_CHECKING:
    from kf_calib.positioning.drive import Drive, Outcome


def run_object(drive: Drive) -> dict[str, Any]:
    """The key ``run`` of the JSON objects: what the bench is doing, and all decisions so far."""
    outcome = drive.outcome
    return {
        "phase": drive.state.phase.value,
        "orientations": drive.state.number,
        "decisions": drive.decisions,
        "ended": None if outcome is None else outcome.ended,
        "why": None if outcome is None else outcome.why,
        "stands_at_deg": None if outcome is None else outcome.stands_at,
        "stopped": None if outcome is None else outcome.stopped,
        "lasted_s": None if outcome is None else outcome.lasted_s,
    }


def doing_of(drive: Drive) -> Doing | None:
    """What the bench is doing, by itself or by hand; None where it has ended."""
    state = drive.state
    if state.phase is Phase.ENDED:
        return None
    if state.phase is not Phase.MOVING:
        what = "THE BENCH STANDS AND MEASURES" if state.target else "THE BENCH BEGINS"
        return Doing(what, _doing_in_words(drive))
    where = angles_in_words(state.target)
    by_hand = isinstance(drive.positioner, HandPositioner)
    what = f"TURN TO {where}, THEN PRESS ENTER" if by_hand else f"THE BENCH TURNS TO {where}"
    return Doing(what, _doing_in_words(drive), state.target)


def _doing_in_words(drive: Drive) -> str:
    """What the bench is doing, and why, in a line."""
    state = drive.state
    if state.suggestion is None:
        where = f" at {angles_in_words(state.target)}" if state.target else ""
        return f"the bench: {state.phase.value}{where}"
    stay = f", to stay {span(state.suggestion.stay_s)}" if state.phase.value == "moving" else ""
    where = angles_in_words(state.target)
    return f"the bench, stay {state.number}: {state.phase.value} {where}{stay}; {state.suggestion.why}"


def ended_in_words(outcome: Outcome) -> RenderableType:
    """The lines after a run: why it ended, where the table stands, and how it went."""
    stays = sum(1 for decision in outcome.decisions if decision.gimbal_deg) + 1
    where = f"; the table stands at {angles_in_words(outcome.stands_at)}" if outcome.stands_at else ""
    return Text(f"The run ended after {span(outcome.lasted_s)} and {stays} orientations: {outcome.why}{where}.")


def dry_run(poses: Floats, ways: Sequence[Sequence[Floats]], slews_s: Sequence[float], stay_s: float, overhead_s: float
            ) -> RenderableType:  # fmt: skip
    """The path of the opening and its duration. poses (n, k), rad; ways: stations to each; slews_s: time to each."""
    passed_s, rows = 0.0, list[tuple[str, ...]]()
    for number, (pose, way, slew_s) in enumerate(zip(poses, ways, slews_s, strict=True), start=1):
        passed_s += slew_s + overhead_s + stay_s
        stations = "; ".join(_deg(station) for station in way[:-1])
        rows.append((str(number), _deg(pose), stations, span(slew_s), span(passed_s)))
    path = table("", ("", "gimbals, deg", "by way of", "slew", "there until"), rows)
    return Group(path, Text(f"{len(poses)} orientations to begin with, {span(passed_s)}; what follows is decided as "
                             "the run goes on. Nothing was moved."))  # fmt: skip


def dry_run_object(
    poses: Floats, ways: Sequence[Sequence[Floats]], slews_s: Sequence[float], stay_s: float, overhead_s: float
) -> dict[str, Any]:
    """The same as JSON."""
    total_s = float(np.sum(slews_s)) + len(poses) * (stay_s + overhead_s)
    stations = [[np.degrees(station).round(6) for station in way] for way in ways]
    return {"gimbal_deg": np.degrees(poses).round(6), "stations_deg": stations, "slew_s": slews_s, "stay_s": stay_s,
            "duration_s": total_s}  # fmt: skip


def _deg(pose: Floats) -> str:
    return ", ".join(f"{angle:g}" for angle in np.degrees(pose).round(2) + 0.0)
