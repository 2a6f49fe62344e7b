"""A live run as a screen, as one line of text for each dwell, and as one JSON object for each dwell.

A live calibration by hand as a screen, as one line of text for each pose, and as one JSON object for each pose.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.design.sides import turn_in_words
from kf_calib.online.evaluation import Progress
from kf_calib.online.session import HandJudgement, HandStanding
from kf_calib.online.status import Judgement, Standing
from kf_calib.support.text import sentence
from kf_calib.support.units import STANDARD_GRAVITY_MPS2, shown, span
from kf_calib.views.console import symbol
from kf_calib.views.diagnosis import found_object, orientation_object
from kf_calib.views.json import clean, replay_object
from kf_calib.views.terminal import Bar, ConsoleTable

if TYPE_CHECKING:
    from kf_calib.sources.live import Status

_BAR, _NAME = 18, 30
_TARGET_DECADES = 3.0  # decades above the target at which the bar of a sigma is full
# Without a target: the sigma of a full bar in rad, 1 or g, and the decades below it at which the bar is empty.
_COARSE, _DECADES = 1e-3, 5.0


def live_object(judgement: Judgement, standing: Standing, status: Status | None) -> dict[str, Any]:
    """The JSON object of ``live`` after a dwell: the keys of ``replay`` and ``diagnose``, and those of a live run.

    judgement: of the run after the dwell. standing: what is known now. status: of the source (None: it has none).
    """
    left = dict(zip(paper_parameters.SYMBOLS, judgement.left_s, strict=True))
    wanted = dict(zip(paper_parameters.SYMBOLS, judgement.wanted, strict=True))
    of_live = {
        "consistent": judgement.consistent,
        "p_value": judgement.p_value,
        "final": judgement.final,
        "diagnosed_dwells": len(judgement.look.result.visits),
        "next_orientation": _going(judgement),
        "standing": judgement.verdict,
        "alarm": judgement.alarm,
        "looks": judgement.watch.looks if judgement.watch else 0,
        "elapsed_s": judgement.result.fit.dwells[-1].end_s,
        "targets": {name: value for name, value in wanted.items() if math.isfinite(value)},
        "time_left_s": left,
        "notice": standing.notice,
        "source": source_object(status),
    }
    return found_object(judgement.diagnosis) | replay_object(judgement.result) | clean(of_live)


def _going(judgement: Judgement) -> dict[str, Any] | None:
    """Return the next orientation as a JSON object: as the diagnosis advises, or without an alarm, for the sigmas."""
    if judgement.advice is not None:
        return orientation_object(*judgement.advice)
    going = None if judgement.final else judgement.next_orientation
    return None if going is None else {"gimbal_deg": list(going[0]), "stay_s": None, "why": going[1]}


def source_object(status: Status | None) -> dict[str, Any] | None:
    """The state of a live source as a JSON object, or None."""
    return None if status is None else clean(asdict(status))


def line(judgement: Judgement) -> str:
    """The state of a run after a dwell in one line of text."""
    result = judgement.result
    dwell, sigma = result.fit.dwells[-1], result.estimate.sigma
    seen = "sigmas not determined yet"
    if np.isfinite(sigma).any():
        k = int(np.nanargmax(sigma / np.where(np.isfinite(judgement.worst), judgement.worst, np.inf)))
        left = f", {span(judgement.left_s[k])} to its target" if np.isfinite(judgement.wanted[k]) else ""
        seen = f"worst sigma {paper_parameters.SYMBOLS[k]} {shown(paper_parameters.UNITS[k]).text(sigma[k])}{left}"
    going = judgement.next_orientation
    following = f"; next {_angles(going[0])} deg ({going[1]})" if going else ""
    per_dof = result.consistency.nis_per_dof
    nis = "" if per_dof is None else f"; misfit {math.sqrt(per_dof):.2g} × noise"
    return (
        f"dwell {dwell.number} to {dwell.end_s:.0f} s: {result.tally.read} readings; {seen}{nis}; "
        f"{judgement.verdict}{following}"
    )


def screen(
    standing: Standing, status: Status | None, name: str, recording: str = "", hint: str = "", doing: str = ""
) -> RenderableType:
    """All that is known of a run now, for a terminal of 80 x 24 characters; of a smaller one, what stands last is cut
    off: what to do and the verdict stand first.

    standing: what is known. status: of the source (None: it has none). name: of the source. recording: path of the file
    that is written. hint: line at the bottom. doing: what a bench that drives itself does.
    """
    judgement = standing.judgement
    parts: list[RenderableType] = [_to_do(standing, by_itself=bool(doing))]
    if judgement is not None:
        style = {True: "bold green", False: "bold yellow", None: "bold"}[judgement.consistent]
        parts.append(Text(judgement.verdict, style=style))
    parts += [Text(sentence(text), style="yellow") for text in (standing.problem, standing.notice) if text]
    parts += [Text(doing)] if doing else []
    parts += [link(standing, status, name, recording), _sigmas(standing)]
    if judgement is not None:
        parts.append(_fit(judgement))
        if judgement.risen is not None:
            risen, factor = judgement.risen
            parts.append(Text(
                f"σ of {symbol(risen)} rose {factor:.1f} times with the last orientation: the orientations scatter "
                "more than was known before, or the model has more to determine.", style="yellow",
            ))  # fmt: skip
    if hint:
        parts.append(Text(hint, style="dim"))
    return Group(*parts)


def link(standing: Progress, status: Status | None, name: str, recording: str) -> Text:
    """Return the lines about the source and the recording."""
    if status is None:
        return Text(f"{name}: {standing.samples} readings")
    text = Text.assemble((name if len(name) <= _NAME else f"{name[:_NAME]}...", "bold"), " ")
    text.append(status.link, {"live": "green", "lost": "bold red"}.get(status.link, "yellow"))
    text.append(f"  {status.rate_hz:.0f} Hz  {status.samples} readings")
    counts = {"gaps": status.gaps, "refused": status.refused, "reconnects": status.reconnects,
              "missing": status.missing, "left out": status.left_out, "dropped": status.dropped}  # fmt: skip
    for word, count in counts.items():
        style = "red" if word in ("missing", "left out", "dropped") else "yellow"
        if count or word in ("gaps", "refused"):
            text.append(f"  {count} {word.removesuffix('s') if count == 1 else word}", style if count else "")
    for trouble in (status.trouble, status.clock_trouble):
        if trouble:
            text.append(f"\n{sentence(trouble)}", "bold red")
    if status.recording_trouble:
        text.append(f"\nRECORDING HAS STOPPED: {sentence(status.recording_trouble)}", "bold white on red")
    if recording and not status.recording_trouble:
        age = "" if status.sync_age_s is None else f", on the disk up to {status.sync_age_s:.1f} s ago"
        text.append(f"\nrecording {recording}: {status.recorded} readings{age}")
    return text


def _to_do(standing: Standing, *, by_itself: bool) -> Panel:
    """Return what to do now in a frame, in capitals, and below it where the platform stands and where it goes next;
    by_itself: whether the bench does it."""
    judgement, here = standing.judgement, standing.current
    going = None if judgement is None else judgement.next_orientation
    there = "the next orientation of your plan" if going is None else f"{_angles(going[0])} deg"
    then = "" if going is None else f": {going[1]}"
    if judgement is not None and judgement.reached(standing.sigma):
        if by_itself:
            return _frame("EVERY TARGET IS REACHED", "the bench ends the run by itself", "green")
        return _frame("STOP: EVERY TARGET IS REACHED", f"going on to {there} {then.lstrip(': ')}".strip(), "green")
    if here is None:
        moved = f"{standing.dwells} orientations in {span(standing.elapsed_s)}; the platform moves or settles"
        return _frame(f"TURN TO {there.upper() if going is None else there}, THEN HOLD STILL", f"{moved}{then}", "cyan")
    angles = f"{_angles(np.degrees(here.pose))} deg" if len(here.pose) < 4 else "this attitude"
    at = f"orientation {here.number} at {angles}: {span(here.seconds)}, {here.readings} readings"
    if here.enough:
        return _frame(
            f"GO ON: TURN TO {there.upper() if going is None else there}", f"{at}; enough here{then}", "green"
        )
    return _frame("STAY: HOLD STILL", f"{at}; then to {there}{then}", "yellow")


def _frame(what: str, below: str, colour: str) -> Panel:
    text = Text.assemble((what, f"bold {colour}"), *([f"\n{below}"] if below else []))
    return Panel(text, border_style=colour, padding=(0, 1))


def _sigmas(standing: Standing) -> RenderableType:
    """Return the table of the twelve sigmas with what they are to come down to, in what time: their targets, or where
    none is set half of what they were after the last orientation."""
    table = ConsoleTable.grid(padding=(0, 1))
    wanted = np.full(12, np.nan) if standing.judgement is None else standing.judgement.aims
    targets = bool(np.isfinite(wanted).any())
    for justify in ("left", "right", "left", "right", "left", "right", "left"):
        table.add_column(justify=justify, no_wrap=True)
    table.add_row("", "1σ now", "", "target" if targets else "half of last", "", "in", "", style="dim")
    last = np.full(12, np.nan) if standing.judgement is None else standing.judgement.result.estimate.sigma
    for k, name in enumerate(paper_parameters.SYMBOLS):
        unit = shown(paper_parameters.UNITS[k])
        sigma, left = standing.sigma[k], standing.left_s[k]
        if not math.isfinite(sigma):
            table.add_row(symbol(name), "-", unit.label, "not seen yet", "", "", "")
            continue
        aim = wanted[k] if targets else 0.5 * last[k]
        # a prediction can be too early: only sigma itself tells that a target is reached, and the bar then says so
        time = ("" if targets else "reached") if sigma <= aim else span(left) if left else "soon"
        aimed = (unit.number(aim), unit.label, time) if math.isfinite(aim) else ("", "", "")
        table.add_row(symbol(name), unit.number(sigma), unit.label, *aimed, bar(float(sigma), float(wanted[k]), k))
    return table


def bar(sigma: float, wanted: float, k: int) -> Bar:
    """Return a bar for a sigma, in decades above its target; without one, in decades above a small sigma."""
    if math.isfinite(wanted):
        share = math.log10(max(sigma / wanted, 1e-9)) / _TARGET_DECADES
    else:
        size = _COARSE * (STANDARD_GRAVITY_MPS2 if paper_parameters.UNITS[k] == "m/s^2" else 1.0)
        share = 1.0 + math.log10(max(sigma / size, 1e-30)) / _DECADES
    if math.isfinite(wanted) and share <= 0:
        return Bar("reached", style="green")
    full = round(_BAR * min(max(share, 0.0), 1.0))
    return Bar("█" * full + "·" * (_BAR - full), style="cyan" if math.isfinite(wanted) else "blue")


def _fit(judgement: Judgement) -> Text:
    """Return the line about the model: how well it fits, and its held-out error."""
    result = judgement.result
    judged = result.consistency
    text = f"12 parameters{''.join(f' + {effect}' for effect in result.model.effects)}; "
    if judged.nis_per_dof is None:
        text += "nothing to judge the fit by yet"
    else:
        text += f"misfit {math.sqrt(judged.nis_per_dof):.2g} × noise"
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2:
        rms, floor, unit = result.held_out_rms_mps2, result.held_out_floor_mps2, shown("m/s^2")
        text += f"; orientations left out: {unit.text(rms, 2)} off, noise alone {unit.number(floor, 2)}"
    return Text(text)


def _angles(degrees: Floats | tuple[float, ...]) -> str:
    """Return angles in deg as text, to a tenth of a degree."""
    return ", ".join(f"{round(float(angle), 1):g}" for angle in degrees)


_BAR = 20


def hand_object(judgement: HandJudgement, standing: HandStanding, status: Status | None) -> dict[str, Any]:
    """The JSON object of ``live --no-angles`` after a pose: the keys of ``replay`` once there is a result, and its own.

    judgement: of the run after the pose. standing: what is known now. status: of the source (None: it has none).
    """
    sides, result, last = judgement.sides, judgement.result, judgement.dwells[-1]
    known = {"samples": standing.samples, "dwells": len(judgement.dwells)} if result is None else replay_object(result)
    wanted = dict(zip(paper_parameters.SYMBOLS, judgement.wanted, strict=True))
    of_hand = {
        "consistent": judgement.consistent,
        "p_value": None if result is None else result.consistency.p_value,
        "final": judgement.final,
        "standing": judgement.verdict,
        "undetermined": sides.missing,
        "sides": sides.count,
        "pose": {"number": last.number, "up": sides.last, "repeats": sides.repeats},
        "next_side": {"up": sides.following, "turn": turn_in_words(sides.following)},
        "targets": {name: value for name, value in wanted.items() if math.isfinite(value)},
        "targets_reached": judgement.reached,
        "elapsed_s": last.end_s,
        "notice": standing.notice,
        "source": source_object(status),
    }
    return known | clean(of_hand)


def hand_line(judgement: HandJudgement) -> str:
    """The state of a run after a pose in one line of text."""
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
        f"pose {last.number} ({side}), {seconds:.1f} s used; {sides.count} side{'s' * (sides.count != 1)} seen; "
        f"{seen}{judgement.verdict}"
    )


def hand_screen(
    standing: HandStanding, status: Status | None, name: str, recording: str = "", hint: str = ""
) -> RenderableType:
    """All that is known of a run now, as ``screen``.

    standing: what is known. status: of the source (None: it has none). name: of the source. recording: path of the file
    that is written. hint: line at the bottom.
    """
    judgement = standing.judgement
    resting = f"still for {standing.rest_s:.0f} s of {standing.enough_s:g} s" if standing.rest_s else "it moves"
    style = "bold green" if standing.rest_s >= standing.enough_s else "bold"
    parts: list[RenderableType] = [Text(sentence(standing.task), style=style), _rest(standing, resting)]
    if judgement is not None:
        parts.append(Text(_found(judgement)))
    parts += [Text(sentence(text), style="yellow") for text in (standing.problem, standing.notice) if text]
    parts += [link(standing, status, name, recording), _sigmas_by_hand(judgement)]
    if hint:
        parts.append(Text(hint, style="dim"))
    return Group(*parts)


def _rest(standing: HandStanding, resting: str) -> Text:
    """Return the line about the pose that it is in, or that it moves."""
    full = round(_BAR * min(standing.rest_s / standing.enough_s, 1.0))
    here = standing.current
    where = f"pose {here.number}, {here.up} up: " if here is not None and standing.rest_s else ""
    done = f"{standing.dwells} pose{'s' * (standing.dwells != 1)} in {span(standing.elapsed_s)}"
    return Text(f"{done}  {'█' * full}{'·' * (_BAR - full)}  {where}{resting}")


def _sigmas_by_hand(judgement: HandJudgement | None) -> RenderableType:
    """Return the table of the nine parameters with their sigmas and targets; what the frame fixes is left out."""
    table = ConsoleTable.grid(padding=(0, 1))
    for justify in ("left", "right", "right", "left", "right", "left"):
        table.add_column(justify=justify, no_wrap=True)
    table.add_row("", "less nominal", "σ", "", "target", "", style="dim")
    result = None if judgement is None else judgement.result
    for k, name in enumerate(paper_parameters.SYMBOLS):
        if name in ("theta1", "phi1", "nu2"):
            continue
        unit = shown(paper_parameters.UNITS[k])
        parameter = None if result is None else result.parameters[name]
        if judgement is None or result is None or parameter is None or parameter.value is None:
            table.add_row(symbol(name), "square" if result else "-", "", unit.label, "", Bar(""))
            continue
        sigma, wanted = float(judgement.sigma[k]), float(judgement.aims[k])
        off, spread = unit.rounded(parameter.value - parameter.nominal, sigma)
        target = unit.number(wanted) if math.isfinite(wanted) else ""
        table.add_row(symbol(name), off, f"± {spread}", unit.label, target, bar(sigma, wanted, k))
    return table


def _found(judgement: HandJudgement) -> str:
    """Return the line about sides and misfit."""
    sides = judgement.sides.count
    nis = None if judgement.result is None else judgement.result.consistency.nis_per_dof
    misfit = "" if nis is None else f"NIS/dof {nis:.3g}; "
    return f"{sides} side{'s' * (sides != 1)} seen; {misfit}{judgement.verdict}"
