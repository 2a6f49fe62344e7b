"""A live run as a screen, as one line of text for each dwell, and as one JSON object for each dwell."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask
from kf_calib.online.progress import Progress
from kf_calib.online.status import Judgement, Standing
from kf_calib.support.plain_text import sentence
from kf_calib.support.units import STANDARD_GRAVITY_MPS2, shown, span
from kf_calib.views.console import symbol
from kf_calib.views.diagnosis import found_object, orientation_object
from kf_calib.views.json import clean, replay_object
from kf_calib.views.tables import Bar, Table

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
    nis = "" if per_dof is None else f"; NIS/dof {per_dof:.3g}"
    return (
        f"dwell {dwell.number} to {dwell.end_s:.0f} s: {result.tally.read} readings; {seen}{nis}; "
        f"{judgement.verdict}{following}"
    )


def screen(standing: Standing, status: Status | None, name: str, recording: str = "", hint: str = "") -> RenderableType:
    """All that is known of a run now, for a terminal of 80 x 24 characters.

    standing: what is known. status: of the source (None: it has none). name: of the source. recording: path of the file
    that is written. hint: line at the bottom.
    """
    judgement = standing.judgement
    parts: list[RenderableType] = [link(standing, status, name, recording), _here(standing), _sigmas(standing)]
    if judgement is not None:
        parts += [_fit(judgement), Text(judgement.verdict, style=_style(judgement))]
        if _set(judgement).any() and (standing.sigma <= judgement.wanted)[_set(judgement)].all():
            parts.append(Text("every target is reached", style="bold green"))
        going = judgement.next_orientation
        if going is not None:
            parts.append(Text(f"next: gimbals at {_angles(going[0])} deg: {going[1]}", style="bold"))
    parts += [Text(sentence(text), style="yellow") for text in (standing.problem, standing.notice) if text]
    if hint:
        parts.append(Text(hint, style="dim"))
    return Group(*parts)


def _set(judgement: Judgement) -> Mask:
    """Return a mask (12,) of the parameters that have a target."""
    return np.isfinite(judgement.wanted)


def _style(judgement: Judgement) -> str:
    """Return the style in which the verdict is shown."""
    return {True: "bold green", False: "bold yellow", None: "bold"}[judgement.consistent]


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
            text.append(f"  {count} {word}", style if count else "")
    for trouble in (status.trouble, status.clock_trouble):
        if trouble:
            text.append(f"\n{sentence(trouble)}", "bold red")
    if status.recording_trouble:
        text.append(f"\nRECORDING HAS STOPPED: {sentence(status.recording_trouble)}", "bold white on red")
    if recording and not status.recording_trouble:
        age = "" if status.sync_age_s is None else f", on the disk up to {status.sync_age_s:.1f} s ago"
        text.append(f"\nrecording {recording}: {status.recorded} readings{age}")
    return text


def _here(standing: Standing) -> Text:
    """Return the line about the open dwell."""
    here = standing.current
    if here is None:
        return Text(f"{standing.dwells} dwells in {span(standing.elapsed_s)}; moving or settling")
    angles = _angles(np.degrees(here.pose)) if len(here.pose) < 4 else "attitude"
    text = Text(f"orientation {here.number} at {angles} deg: {span(here.seconds)}, {here.readings} readings")
    if here.enough:
        text.append(": enough, go on", "bold green")
    elif here.enough is False:
        text.append(": stay, its sigmas still fall")
    return text


def _sigmas(standing: Standing) -> RenderableType:
    """Return the table of the twelve sigmas with their targets, the time to them (or to half the sigma), and bars."""
    table = Table.grid(padding=(0, 1))
    wanted = np.full(12, np.nan) if standing.judgement is None else standing.judgement.wanted
    for justify in ("left", "right", "left", "right", "right", "left"):
        table.add_column(justify=justify, no_wrap=True)
    table.add_row("", "σ", "", "target", "left", "", style="dim")
    for k, name in enumerate(paper_parameters.SYMBOLS):
        unit = shown(paper_parameters.UNITS[k])
        sigma, left = standing.sigma[k], standing.left_s[k]
        if not math.isfinite(sigma):
            table.add_row(symbol(name), "-", unit.label, "", "", "")
            continue
        target = unit.number(wanted[k]) if math.isfinite(wanted[k]) else "half"
        table.add_row(
            symbol(name),
            unit.number(sigma),
            unit.label,
            target,
            span(left) if left else "",
            bar(float(sigma), float(wanted[k]), k),
        )
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
    """Return the line about the model, its NIS and its held-out error."""
    result = judgement.result
    judged = result.consistency
    text = f"12 parameters{''.join(f' + {effect}' for effect in result.model.effects)}; "
    text += "NIS: nothing to judge by" if judged.nis_per_dof is None else f"NIS/dof {judged.nis_per_dof:.3g}"
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2:
        rms, floor, unit = result.held_out_rms_mps2, result.held_out_floor_mps2, shown("m/s^2")
        text += f"; held out {unit.text(rms, 2)} rms, noise alone {unit.number(floor, 2)}"
    return Text(text)


def _angles(degrees: Floats | tuple[float, ...]) -> str:
    """Return angles in deg as text, to a tenth of a degree."""
    return ", ".join(f"{round(float(angle), 1):g}" for angle in degrees)
