"""What the page of a live run in a browser shows: the content of the terminal's screen, and directions on a sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axis_names
from kf_calib.estimation.free_attitude import DIRECTIONS
from kf_calib.online.session import HandStanding
from kf_calib.online.status import RunStatus
from kf_calib.support.text import angles_in_words
from kf_calib.views.live.content import Content

DirectionState = Literal["done", "disagrees", "here", "next"]


@dataclass(frozen=True)
class Direction:
    """Where specific force points in the platform, as a unit vector: in a dwell that is done, of these number, in the
    open dwell, or in the next orientation."""

    state: DirectionState
    number: int | None
    up: tuple[float, float, float]


def page_object(
    content: Content, directions: Sequence[Direction], gimbals: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """The state of the page as a JSON object; gimbals: as of ``gimbals_of``."""
    return {**asdict(content), "directions": list(map(asdict, directions)), "gimbals": gimbals}


def gimbals_of(
    standing: RunStatus | HandStanding, bench: Bench, heading: Sequence[float] = ()
) -> list[tuple[str, str]]:
    """Each gimbal's name and the angle of the next orientation, deg, outer to inner; empty where none is advised.

    heading: where a bench that drives itself goes, deg.
    """
    angles = heading or _next_angles(standing)
    return [
        (f"gimbal {k} ({axis})", angles_in_words([angle]).removesuffix(" deg"))
        for k, (axis, angle) in enumerate(zip(axis_names(bench.axes), angles, strict=False), start=1)
    ]


def _next_angles(standing: RunStatus | HandStanding) -> Sequence[float]:
    if isinstance(standing, HandStanding) or standing.judgement is None or standing.judgement.final:
        return ()
    going = standing.judgement.next_orientation
    return () if going is None else going[0]


def directions_of(standing: RunStatus | HandStanding, bench: Bench, heading: Sequence[float] = ()) -> list[Direction]:
    """Directions of specific force in the platform in all dwells that are judged, in the open one, and in the next
    orientation; ``heading`` as of ``gimbals_of``."""
    return _by_hand(standing) if isinstance(standing, HandStanding) else _on_bench(standing, bench, heading)


def _on_bench(standing: RunStatus, bench: Bench, heading: Sequence[float]) -> list[Direction]:
    judgement, here = standing.judgement, standing.current
    dwells = [] if judgement is None else [visit.dwell for visit in judgement.result.visits]
    wrong = judgement.disagreeing[0] if judgement is not None and judgement.alarm else 0
    places: list[tuple[DirectionState, int | None, float, Floats]] = [
        ("disagrees" if k == wrong else "done", dwell.number, dwell.end_s, dwell.recorded_pose)
        for k, dwell in enumerate(dwells, start=1)
    ]
    if here is not None:
        places.append(("here", here.number, standing.elapsed_s, here.pose))
    following = np.radians(heading or _next_angles(standing))
    if len(following) == bench.pose_width:
        places.append(("next", None, standing.elapsed_s, following))
    if not places:
        return []
    states, numbers, times, poses = zip(*places, strict=True)
    return _directions(states, numbers, bench.specific_force(np.array(times), np.array(poses)))


def _by_hand(standing: HandStanding) -> list[Direction]:
    sides, here = standing.sides, standing.current
    if sides is None:
        return []
    open_number = here.number if here is not None and standing.rest_s > 0.0 else None
    states: list[DirectionState] = ["here" if number == open_number else "done" for number in sides.numbers]
    if standing.judgement is not None and standing.judgement.final:
        return _directions(states, sides.numbers, sides.up)
    return _directions([*states, "next"], [*sides.numbers, None], np.vstack([sides.up, DIRECTIONS[sides.following]]))


def _directions(states: Sequence[DirectionState], numbers: Sequence[int | None], force: Floats) -> list[Direction]:
    unit = (force / np.linalg.norm(force, axis=1, keepdims=True)).round(4).tolist()
    return [Direction(*each) for each in zip(states, numbers, map(tuple, unit), strict=True)]
