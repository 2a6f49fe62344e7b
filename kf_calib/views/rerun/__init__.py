"""The Rerun view of what moves: a run in time, the residuals of explanations, the error falling from step to step.

A thin bridge: every number comes from the result, is scaled to a unit an engineer reads, and is sent in columns; Rerun
draws curves and axes. Angles are in arcsec, scale factors in ppm, biases and innovations in µg, or all in SI
(``support.units.shown_in``). Where the orientations so far do not determine a parameter there is no point.

A run has two timelines: ``orientation`` (the count of dwells from 1; 0 is a stated prior) and ``bench_time`` (since the
first sample; points within the dwells too). Entities: ``parameters/ACCELEROMETER/SYMBOL/{log10_sigma,log10_target,
deviation,band}``, ``parameters/effects/SYMBOL/...``, ``platform/...``, ``innovation/CHANNEL/{value,bound,in_sigma}``,
``nis/{value,above,band}``, ``residual/CHANNEL``, ``bench/pose/...``, ``summary``.
"""

from __future__ import annotations

from functools import singledispatch
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.estimate import correlation
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.online.status import Judgement
from kf_calib.support.plain_text import printable
from kf_calib.support.units import Unit, shown, significant
from kf_calib.views.console import noise_origins, whole_value
from kf_calib.views.rerun.diagnosis import save_diagnosis_view as save_diagnosis
from kf_calib.views.rerun.improvement import save_improvement_view as save_improvement
from kf_calib.views.rerun.layout import layout
from kf_calib.views.rerun.names import BENCH_TIME, LABELS, ORIENTATION, Colour, quantities, rrd_file, strict
from kf_calib.views.rerun.platform import log_platform
from kf_calib.views.rerun.series import (
    VisitHistory,
    log_bench,
    log_innovations,
    log_nis,
    log_parameters,
    log_residuals,
    predicted,
)

__all__ = ["BENCH_TIME", "ORIENTATION", "grow", "save_view"]

_NO_TARGET = np.full(12, np.nan)


@singledispatch
def save_view(result: Any, path: str | Path) -> Path:
    """Write the view of a result to an .rrd file that opens laid out, and return its path.

    Raises InputError where the file cannot be written.
    """
    raise TypeError(f"there is no Rerun view of {type(result).__name__}: give the result of calibrate, diagnose or "
                    "improve; kf_calib.plot draws figures of the others.")  # fmt: skip


@save_view.register
def _(result: Calibration, path: str | Path) -> Path:
    history = VisitHistory.of(result)
    with rrd_file(Path(path), layout(result, history)) as stream:
        _log(result, history, stream)
        if not predicted(result):
            log_residuals(result, stream)
    return Path(path)


@save_view.register
def _(result: Diagnosis, path: str | Path) -> Path:
    return save_diagnosis(result, Path(path))


@save_view.register
def _(result: Improvement, path: str | Path) -> Path:
    return save_improvement(result, Path(path))


def grow(
    result: Calibration, stream: rr.RecordingStream, shown: int, lay_out: bool, judgement: Judgement | None = None
) -> None:
    """Send what a run shows beyond its first ``shown`` dwells, which were sent already, and the layout if asked to.

    A dwell stays in the curves as it was known when it was sent; platform and page of text are made anew.
    judgement: of the run so far, for its targets, its verdict and the next orientation.
    """
    with strict():
        history = VisitHistory.of(result)
        target = _NO_TARGET if judgement is None else judgement.wanted
        _log(result, history, stream, shown, "" if judgement is None else judgement_text(judgement), target)
        if judgement is not None:
            log_next(judgement, stream)
        if lay_out:
            stream.send_blueprint(layout(result, history, goes_on=True))


def _log(
    result: Calibration, history: VisitHistory, stream: rr.RecordingStream, shown: int = 0, heading: str = "",
    target: Floats = _NO_TARGET,
) -> None:  # fmt: skip
    """Send what a run shows beyond its first ``shown`` dwells; ``heading``: what stands above its page of text."""
    fresh = result.visits[shown:]
    if fresh:
        log_parameters(history.after(result.visits[:shown]), stream, target, shown > 0)
        log_platform(result, stream)
        log_innovations(fresh, stream, shown)
        log_nis(fresh, stream, shown)
        log_bench(result, stream, shown)
    text = "\n\n".join([*([heading] if heading else []), markdown_summary(result)])
    stream.log("summary", rr.TextDocument(printable(text), media_type=rr.MediaType.MARKDOWN), static=True)


NEXT: Colour = (255, 160, 205)


def judgement_text(judgement: Judgement) -> str:
    """The verdict so far, what is suspected, and the next orientation, in Markdown."""
    going = judgement.next_orientation
    lines = [f"**So far**: {judgement.verdict}"]
    if going is not None:
        lines.append(f"**Next**: gimbals at {_angles(going[0])} deg: {going[1]}")
    return "\n\n".join(lines)


def log_next(judgement: Judgement, stream: rr.RecordingStream) -> None:
    """Where gravity will point in the platform in the orientation that is advised; nothing where none is."""
    going, bench = judgement.next_orientation, judgement.result.bench
    vectors, labels = np.zeros((0, 3)), list[str]()
    if going is not None and bench.axes:
        now_s = np.array([judgement.result.visits[-1].dwell.end_s])
        force: Floats = bench.specific_force(now_s, np.radians([going[0]]))
        vectors, labels = 1.25 * force / np.linalg.norm(force), [f"next: {_angles(going[0])} deg"]
    arrow = rr.Arrows3D(vectors=vectors, colors=[NEXT] * len(vectors), radii=[0.012] * len(vectors), labels=labels)
    stream.log("platform/next", arrow, static=True)


def _angles(degrees: tuple[float, ...]) -> str:
    return ", ".join(f"{round(angle, 1):g}" for angle in degrees)


def markdown_summary(result: Calibration) -> str:
    """The page in Markdown, in the units that people are shown."""
    blocks = [_head(result), _table(result), _verdict(result), *_warnings(result), _noise(result), *_ties(result)]
    return "\n\n".join(blocks) + "\n"


def _head(result: Calibration) -> str:
    bench, count = result.bench, sum(visit.dwell.count for visit in result.visits)
    serial = f"**{bench.notes['block_serial']}**: " if "block_serial" in bench.notes else ""
    axes = f"axes {bench.to_metadata()['axes']}" if bench.axes else "attitude recorded"
    held = ", inertially held" if bench.reference == "inertial" else ""
    dwells = f"{len(result.visits)} dwell{'s' * (len(result.visits) != 1)}"
    return f"{serial}{dwells}, {count} samples; {axes}{held}, g = {bench.gravity_mps2:.6g} m/s²"


def _table(result: Calibration) -> str:
    head = "| | value | − nominal | ± 1σ | |\n|:--|--:|--:|--:|:--|\n"
    return head + "\n".join(_row(parameter) for parameter in result.parameters.values())


def _row(parameter: Parameter) -> str:
    label, unit = LABELS.get(parameter.symbol, parameter.symbol), shown(parameter)
    if parameter.value is None or parameter.sigma is None:
        return f"| {label} | not determined | | | |"
    deviation, sigma = map(_minus, unit.rounded(parameter.value - parameter.nominal, parameter.sigma))
    value = _minus(whole_value(parameter)) if parameter.symbol in LABELS else ""
    return f"| {label} | {value} | {deviation} | {sigma} | {unit.label} |"


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _verdict(result: Calibration) -> str:
    judged = result.consistency
    if judged.p_value is None:
        words = "nothing left over to judge the model by"
    else:
        yes = "agree with the model" if judged.consistent else "**disagree with the model**"
        per_dof = significant(judged.statistic / judged.dof)
        words = f"the dwells {yes}: p {format_p(judged.p_value)}, NIS/dof = {per_dof}, dof = {judged.dof}"
    held, unit = "", shown("m/s^2")
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2 is not None:
        rms, floor = map(unit.number, (result.held_out_rms_mps2, result.held_out_floor_mps2))
        held = f"; held out {rms} (noise alone {floor})"
    return f"**Misfit**: {words}. Residual rms {unit.number(result.residual_rms_mps2)}{held} {unit.label}"


def _noise(result: Calibration) -> str:
    noise, unit = result.noise, shown("m/s^2")
    parts = [f"{_three(unit, noise.sigma_mps2)} {unit.label} a reading"]
    if noise.inflation.max() > 1.05:
        parts.append(f"correlated: variance of means × {_three(Unit('', 1.0), noise.inflation)}")
    if noise.setting_rad > 0:
        origin = noise_origins(result)[1]
        parts.append(f"setting error {shown('rad').text(noise.setting_rad)} ({origin})")
    if noise.scatter_mps2.max() > 0:
        origin = noise_origins(result)[0]
        parts.append(f"scatter {_three(unit, noise.scatter_mps2)} {unit.label} ({origin})")
    return f"**Noise** (1σ): {'; '.join(parts)}"


def _ties(result: Calibration) -> list[str]:
    """The pairs of parameters the orientations tell apart worst."""
    matrix = np.nan_to_num(correlation(result.estimate))
    pairs = sorted(combinations(range(len(matrix)), 2), key=lambda pair: -abs(matrix[pair]))
    names = [each.label for each in quantities(result.model)]
    strong = [f"{names[i]} {names[j]} {matrix[i, j]:+.2f}" for i, j in pairs[:4] if abs(matrix[i, j]) >= 0.5]
    return [f"**Correlated**: {', '.join(strong)}".replace("-", "−")] if strong else []


def _three(unit: Unit, values: Floats) -> str:
    return ", ".join(map(unit.number, values))


def _warnings(result: Calibration) -> list[str]:
    return ["**Warnings**\n\n" + "\n".join(f"- {text}" for text in result.warnings)] if result.warnings else []
