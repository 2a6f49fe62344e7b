"""What a screen shows of a live run now: made once, for the terminal and for the page in a browser alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.online.evaluation import Progress
from kf_calib.online.session import HandJudgement, HandStanding
from kf_calib.online.status import Judgement, RunStatus
from kf_calib.support.text import angles_in_words, counted, sentence
from kf_calib.support.units import STANDARD_GRAVITY_MPS2, shown, span
from kf_calib.views import diagnosis
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import VERDICT_STYLES

if TYPE_CHECKING:
    from kf_calib.sources.live import Status

Line = tuple[tuple[str, str], ...]
"""Parts of a line of text, each with its style in Rich's words, such as ``bold red``; "" for none."""

Side = Literal["left", "right"]
Headings = tuple[tuple[str, Side], ...]

_NAME = 30  # characters of the name of a source that are shown
_TARGET_DECADES = 3.0  # decades above the target at which the bar of a sigma is full
# Without a target: the sigma of a full bar in rad, 1 or g, and the decades below it at which the bar is empty.
_COARSE, _DECADES = 1e-3, 5.0


@dataclass(frozen=True)
class Task:
    """What to do now, and the details in small letters below it.

    colour: green to go on, yellow to hold still, cyan to turn; red where the run has failed. done: the share of the
    rest that is over, 0 to 1; None where no time is set.
    """

    what: str
    below: str
    colour: str
    done: float | None = None


@dataclass(frozen=True)
class Doing:
    """What a bench that drives itself does: in capitals, in a line with the reason, and where it turns to, deg (empty
    while it stands)."""

    what: str
    line: str
    heading_deg: tuple[float, ...] = ()


@dataclass(frozen=True)
class SigmaBar:
    """A sigma in decades above its target as a part of a full bar, 0 to 1; without a target, above a small sigma."""

    share: float
    has_target: bool

    @property
    def is_reached(self) -> bool:
        return self.has_target and self.share <= 0.0


@dataclass(frozen=True)
class SigmaRow:
    """A row of the table of sigmas: a parameter's symbol, a cell below each heading, and its bar (None: no sigma)."""

    symbol: str
    cells: tuple[str, ...]
    bar: SigmaBar | None = None


@dataclass(frozen=True)
class Content:
    """What is known of a run now, in the order in which it is shown.

    headings: of the cells of ``rows``, with the side to which they are aligned. source: the lines about source and
    recording. model: how well the model fits.
    """

    task: Task
    verdict: tuple[str, str] | None
    remarks: Sequence[str]
    doing: str
    source: Sequence[Line]
    headings: Headings
    rows: Sequence[SigmaRow]
    model: Sequence[Line]


_LAST = Task("THE READINGS HAVE ENDED", "the whole run is evaluated", "green")


def content_of(
    standing: RunStatus | HandStanding, status: Status | None, name: str, recording: str = "",
    doing: Doing | None = None,
) -> Content:  # fmt: skip
    """What is shown of a run.

    standing: what is known. status: of the source (None: it has none). name: of the source. recording: path of the file
    that is written. doing: what a bench that drives itself does; None for another.
    """
    judgement = standing.judgement
    if isinstance(standing, HandStanding):
        task, (headings, rows) = _hand_task(standing), _hand_rows(standing.judgement)
    else:
        task, (headings, rows) = _bench_task(standing, doing), _bench_rows(standing)
    return Content(
        task=_LAST if status is not None and status.link == "ended" else task,
        verdict=None if judgement is None else (_verdict(judgement), VERDICT_STYLES[judgement.consistent]),
        remarks=[sentence(text) for text in (standing.problem, standing.notice) if text],
        doing=doing.line if doing else "",
        source=source_lines(standing, status, name, recording),
        headings=headings,
        rows=rows,
        model=_model_lines(judgement) if isinstance(judgement, Judgement) else (),
    )


def ended(content: Content, final: Judgement | HandJudgement | None, error: BaseException | None) -> Content:
    """The same of a run that is over: its verdict as the summary has it, or the error that left it without one."""
    if final is None:
        return replace(content, task=Task("THE RUN HAS ENDED", sentence(str(error)), "red"))
    assert final.result is not None
    dwells = final.result.fit.dwells
    count = f"{len(dwells)} orientations in {span(dwells[-1].end_s)}; the recording, if any, is finished"
    verdict = content.verdict
    if verdict is not None and isinstance(final, Judgement):
        verdict = diagnosis.verdict(final.diagnosis), verdict[1]
    return replace(content, task=Task("THE RUN HAS ENDED", count, "green"), verdict=verdict)


def _verdict(judgement: Judgement | HandJudgement) -> str:
    """Return the verdict so far; of a sensor in the hand, with the sides that were seen and the misfit."""
    if isinstance(judgement, Judgement):
        return judgement.verdict
    nis = None if judgement.result is None else judgement.result.consistency.nis_per_dof
    misfit = "" if nis is None else f"NIS/dof {nis:.3g}; "
    return f"{counted(judgement.sides.count, 'side')} seen; {misfit}{judgement.verdict}"


def _model_lines(judgement: Judgement) -> list[Line]:
    """Return how well the model fits, and whether a sigma has risen."""
    lines: list[Line] = [((_fit(judgement), ""),)]
    if judgement.risen is not None:
        risen, factor = judgement.risen
        said = (f"σ of {symbol(risen)} rose {factor:.1f} times with the last orientation: the orientations scatter "
                "more than was known before, or the model has more to determine.")  # fmt: skip
        lines.append(((said, "yellow"),))
    return lines


def source_lines(standing: Progress, status: Status | None, name: str, recording: str) -> list[Line]:
    """The lines about the source and the recording."""
    if status is None:
        return [((f"{name}: {standing.samples} readings", ""),)]
    name = "stdin" if name == "-" else name
    parts = [(name if len(name) <= _NAME else f"{name[:_NAME]}...", "bold"), (" ", "")]
    parts.append((status.link, {"live": "green", "lost": "bold red"}.get(status.link, "yellow")))
    parts.append((f"  {status.rate_hz:.0f} Hz  {status.samples} readings", ""))
    counts = {"gaps": status.gaps, "refused": status.refused, "reconnects": status.reconnects,
              "missing": status.missing, "left out": status.left_out, "dropped": status.dropped}  # fmt: skip
    for word, count in counts.items():
        style = "red" if word in ("missing", "left out", "dropped") else "yellow"
        if count or word in ("gaps", "refused"):
            parts.append((f"  {count} {word.removesuffix('s') if count == 1 else word}", style if count else ""))
    troubles = [trouble for trouble in (status.trouble, status.clock_trouble) if trouble]
    lines: list[Line] = [tuple(parts), *(((sentence(trouble), "bold red"),) for trouble in troubles)]
    if status.recording_trouble:
        lines.append(((f"RECORDING HAS STOPPED: {sentence(status.recording_trouble)}", "bold white on red"),))
    elif recording:
        age = "" if status.sync_age_s is None else f", on the disk up to {status.sync_age_s:.1f} s ago"
        lines.append(((f"recording {recording}: {status.recorded} readings{age}", ""),))
    return lines


def _bench_task(standing: RunStatus, doing: Doing | None) -> Task:
    """Return what to do now, or what the bench does by itself, in capitals, and where the platform stands and where it
    is to go next."""
    judgement, here = standing.judgement, standing.current
    going = None if judgement is None else judgement.next_orientation
    there = "the next orientation of your plan" if going is None else f"{angles_in_words(going[0])}"
    why = "" if going is None else going[1]
    then = f"; the next one {why}" * bool(why)
    if judgement is not None and judgement.reached(standing.sigma):
        if doing:
            return Task("EVERY TARGET IS REACHED", "the bench ends the run by itself", "green")
        return Task("STOP: EVERY TARGET IS REACHED", f"going on to {there} {why}".strip(), "green")
    if here is None:
        moved = f"{standing.dwells} orientations in {span(standing.elapsed_s)}; the platform moves or settles"
        if doing:
            return Task(doing.what, moved, "cyan")
        return Task(f"TURN TO {there.upper() if going is None else there}, THEN HOLD STILL", f"{moved}{then}", "cyan")
    angles = f"{angles_in_words(np.degrees(here.pose))}" if len(here.pose) < 4 else "this attitude"
    at = f"orientation {here.number} at {angles}: {span(here.seconds)}, {here.readings} readings"
    if doing:
        return Task(doing.what, at, "cyan" if doing.heading_deg else "yellow")
    if here.enough:
        return Task(f"GO ON: TURN TO {there.upper() if going is None else there}", f"{at}; enough here{then}", "green")
    return Task("STAY: HOLD STILL", f"{at}; then to {there}{f', which {why}' * bool(why)}", "yellow")


def _bench_rows(standing: RunStatus) -> tuple[Headings, list[SigmaRow]]:
    """Return headings and rows of the twelve sigmas with what they are to come down to, in what time: their targets, or
    where none is set half of what they were after the last orientation."""
    wanted = np.full(12, np.nan) if standing.judgement is None else standing.judgement.aims
    last = np.full(12, np.nan) if standing.judgement is None else standing.judgement.result.estimate.sigma
    targets, rows = bool(np.isfinite(wanted).any()), list[SigmaRow]()
    for k, name in enumerate(paper_parameters.SYMBOLS):
        unit = shown(paper_parameters.UNITS[k])
        sigma, left = standing.sigma[k], standing.left_s[k]
        if not math.isfinite(sigma):
            rows.append(SigmaRow(symbol(name), ("-", unit.label, "not seen yet", "", "")))
            continue
        aim = wanted[k] if targets else 0.5 * last[k]
        # a prediction can be too early: only sigma itself tells that a target is reached, and the bar then says so
        time = ("" if targets else "reached") if sigma <= aim else span(left) if left else "soon"
        aimed = (unit.number(aim, zeros=not targets), unit.label, time) if math.isfinite(aim) else ("", "", "")
        cells = unit.number(sigma, zeros=True), unit.label, *aimed
        rows.append(SigmaRow(symbol(name), cells, bar(float(sigma), float(wanted[k]), k)))
    of_aim = "target" if targets else "half of last"
    return (("1σ now", "right"), ("", "left"), (of_aim, "right"), ("", "left"), ("in", "right")), rows


def bar(sigma: float, wanted: float, k: int) -> SigmaBar:
    """The bar of a sigma of parameter k; wanted: its target, NaN where there is none."""
    if math.isfinite(wanted):
        return SigmaBar(math.log10(max(sigma / wanted, 1e-9)) / _TARGET_DECADES, has_target=True)
    size = _COARSE * (STANDARD_GRAVITY_MPS2 if paper_parameters.UNITS[k] == "m/s^2" else 1.0)
    return SigmaBar(1.0 + math.log10(max(sigma / size, 1e-30)) / _DECADES, has_target=False)


def _fit(judgement: Judgement) -> str:
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
    return text


def _hand_task(standing: HandStanding) -> Task:
    """Return what to do now, and how long it has rested in this pose."""
    here, is_enough = standing.current, standing.rest_s >= standing.enough_s
    resting = f"still for {standing.rest_s:.0f} s of {standing.enough_s:g} s" if standing.rest_s else "it moves"
    where = f"pose {here.number}, {here.up} up: " if here is not None and standing.rest_s else ""
    done = f"{counted(standing.dwells, 'pose')} in {span(standing.elapsed_s)}"
    colour = "green" if is_enough else "yellow" if standing.rest_s else "cyan"
    return Task(
        sentence(standing.task), f"{done}; {where}{resting}", colour, min(standing.rest_s / standing.enough_s, 1.0)
    )


def _hand_rows(judgement: HandJudgement | None) -> tuple[Headings, list[SigmaRow]]:
    """Return headings and rows of the nine parameters with sigmas and targets; what the frame fixes is left out."""
    rows, result = list[SigmaRow](), None if judgement is None else judgement.result
    for k, name in enumerate(paper_parameters.SYMBOLS):
        if name in ("theta1", "phi1", "nu2"):
            continue
        unit = shown(paper_parameters.UNITS[k])
        parameter = None if result is None else result.parameters[name]
        if judgement is None or result is None or parameter is None or parameter.value is None:
            rows.append(SigmaRow(symbol(name), ("square" if result else "-", "", unit.label, "")))
            continue
        sigma, wanted = float(judgement.sigma[k]), float(judgement.aims[k])
        off, spread = unit.rounded(parameter.value - parameter.nominal, sigma)
        target = unit.number(wanted) if math.isfinite(wanted) else ""
        rows.append(SigmaRow(symbol(name), (off, f"± {spread}", unit.label, target), bar(sigma, wanted, k)))
    return (("less nominal", "right"), ("σ", "right"), ("", "left"), ("target", "right")), rows
