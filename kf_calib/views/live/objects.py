"""A live run as one JSON object, and as one line of text, for each dwell, or for each pose of a calibration by hand."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.design.sides import turn_in_words
from kf_calib.online.evaluation import Progress
from kf_calib.online.session import HandJudgement
from kf_calib.online.status import Judgement
from kf_calib.support.text import angles_in_words, counted
from kf_calib.support.units import shown, span
from kf_calib.views.diagnosis import found_object, orientation_object
from kf_calib.views.json import members, replay_object

if TYPE_CHECKING:
    from kf_calib.sources.live import Status


def live_object(judgement: Judgement | HandJudgement, standing: Progress, status: Status | None) -> dict[str, Any]:
    """The JSON object of ``live`` after a dwell or a pose: the keys of ``replay`` as soon as there is a result, on a
    bench those of ``diagnose`` before them, and those of a live run.

    judgement: of the run after the dwell. standing: what is known now. status: of the source (None: it has none).
    """
    wanted = dict(zip(paper_parameters.SYMBOLS, judgement.wanted, strict=True))
    of_live = members(judgement, "consistent", "final") | {
        "standing": judgement.verdict,
        "targets": {name: value for name, value in wanted.items() if math.isfinite(value)},
        "notice": standing.notice,
        "source": status,
    }
    if isinstance(judgement, Judgement):
        known, further = found_object(judgement.diagnosis) | replay_object(judgement.result), _of_bench(judgement)
    else:
        counts = {"samples": standing.samples, "dwells": len(judgement.dwells)}
        known, further = replay_object(judgement.result) if judgement.result else counts, _of_hand(judgement)
    return known | of_live | further


def _of_bench(judgement: Judgement) -> dict[str, Any]:
    """Return the keys of a run on a bench alone."""
    return {
        "p_value": judgement.p_value,
        "diagnosed_dwells": len(judgement.snapshot.result.visits),
        "next_orientation": _going(judgement),
        "alarm": judgement.alarm,
        "looks": judgement.sequential.looks if judgement.sequential else 0,
        "elapsed_s": judgement.result.fit.dwells[-1].end_s,
        "time_left_s": dict(zip(paper_parameters.SYMBOLS, judgement.left_s, strict=True)),
    }


def _of_hand(judgement: HandJudgement) -> dict[str, Any]:
    """Return the keys of a calibration by hand alone."""
    sides, last = judgement.sides, judgement.dwells[-1]
    return {
        "p_value": judgement.result.consistency.p_value if judgement.result else None,
        "undetermined": sides.missing,
        "sides": sides.count,
        "pose": {"number": last.number, "up": sides.last, "repeats": sides.repeats},
        "next_side": {"up": sides.following, "turn": turn_in_words(sides.following)},
        "targets_reached": judgement.reached,
        "elapsed_s": last.end_s,
    }


def _going(judgement: Judgement) -> dict[str, Any] | None:
    """Return the next orientation as a JSON object: as the diagnosis advises, or without an alarm, for the sigmas."""
    if judgement.advice is not None:
        return orientation_object(*judgement.advice)
    going = None if judgement.final else judgement.next_orientation
    return None if going is None else {"gimbal_deg": going[0], "stay_s": None, "why": going[1]}


def line(judgement: Judgement | HandJudgement) -> str:
    """The state of a run after a dwell or a pose in one line of text."""
    return _bench_line(judgement) if isinstance(judgement, Judgement) else _hand_line(judgement)


def _bench_line(judgement: Judgement) -> str:
    result = judgement.result
    dwell, sigma = result.fit.dwells[-1], result.estimate.sigma
    seen = "sigmas not determined yet"
    if np.isfinite(sigma).any():
        k = int(np.nanargmax(sigma / np.where(np.isfinite(judgement.worst), judgement.worst, np.inf)))
        left = f", {span(judgement.left_s[k])} to its target" if np.isfinite(judgement.wanted[k]) else ""
        seen = f"worst sigma {paper_parameters.SYMBOLS[k]} {shown(paper_parameters.UNITS[k]).text(sigma[k])}{left}"
    going = judgement.next_orientation
    following = f"; next {angles_in_words(going[0])} ({going[1]})" if going else ""
    per_dof = result.consistency.nis_per_dof
    nis = "" if per_dof is None else f"; misfit {math.sqrt(per_dof):.2g} × noise"
    return (
        f"dwell {dwell.number} to {dwell.end_s:.0f} s: {result.counts.read} readings; {seen}{nis}; "
        f"{judgement.verdict}{following}"
    )


def _hand_line(judgement: HandJudgement) -> str:
    last, sides = judgement.dwells[-1], judgement.sides
    side = f"{sides.last} up" if sides.repeats is None else f"the side of pose {sides.repeats} again"
    seen, sigma = "", judgement.sigma
    if np.isfinite(sigma).any():
        scale = np.where(np.isfinite(judgement.wanted), judgement.wanted, np.inf)
        if not np.isfinite(scale).any():
            scale = np.array([9.8 if unit == "m/s^2" else 1.0 for unit in paper_parameters.UNITS])
        k = int(np.nanargmax(sigma / scale))
        seen = f"worst sigma {paper_parameters.SYMBOLS[k]} {shown(paper_parameters.UNITS[k]).text(sigma[k])}; "
    seconds = last.end_s - last.start_s
    return (
        f"pose {last.number} ({side}), {seconds:.1f} s used; {counted(sides.count, 'side')} seen; "
        f"{seen}{judgement.verdict}"
    )
