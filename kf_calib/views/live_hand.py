"""A live calibration by hand as a screen, as one line of text for each pose, and as one JSON object for each pose."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.design.sides import turn_in_words
from kf_calib.online.hand_status import HandJudgement, HandStanding
from kf_calib.support.plain_text import sentence
from kf_calib.support.units import shown, span
from kf_calib.views.console import symbol
from kf_calib.views.json import clean, replay_object
from kf_calib.views.live import bar, link, source_object
from kf_calib.views.tables import Bar, ConsoleTable

if TYPE_CHECKING:
    from kf_calib.sources.live import Status

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
    """All that is known of a run now, for a terminal of 80 x 24 characters.

    standing: what is known. status: of the source (None: it has none). name: of the source. recording: path of the file
    that is written. hint: line at the bottom.
    """
    judgement = standing.judgement
    resting = f"still for {standing.rest_s:.0f} s of {standing.enough_s:g} s" if standing.rest_s else "it moves"
    style = "bold green" if standing.rest_s >= standing.enough_s else "bold"
    parts: list[RenderableType] = [
        link(standing, status, name, recording), _rest(standing, resting), Text(sentence(standing.task), style=style),
        _sigmas(judgement),
    ]  # fmt: skip
    if judgement is not None:
        parts.append(Text(_found(judgement)))
    parts += [Text(sentence(text), style="yellow") for text in (standing.problem, standing.notice) if text]
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


def _sigmas(judgement: HandJudgement | None) -> RenderableType:
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
        sigma, wanted = float(judgement.sigma[k]), float(judgement.wanted[k])
        off, spread = unit.rounded(parameter.value - parameter.nominal, sigma)
        target = unit.number(wanted) if math.isfinite(wanted) else ""
        table.add_row(symbol(name), off, f"± {spread}", unit.label, target, bar(sigma, wanted, k))
    return table


def _found(judgement: HandJudgement) -> str:
    """Return the line about sides and misfit."""
    sides = judgement.sides.count
    result = judgement.result  # axes that are only taken for square would dominate the misfit
    nis = None if result is None or result.model.square else result.consistency.nis_per_dof
    misfit = "" if nis is None else f"NIS/dof {nis:.3g}; "
    return f"{sides} side{'s' * (sides != 1)} seen; {misfit}{judgement.verdict}"
