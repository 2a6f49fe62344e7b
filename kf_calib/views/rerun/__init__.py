"""The Rerun view of what moves: a run in time, the residuals of explanations, the error falling from step to step.

A thin bridge: every number comes from the result, is scaled to a unit an engineer reads, and is sent in columns; Rerun
draws curves and axes. Angles are in arcsec, scale factors in ppm, biases and innovations in µg, or all in SI
(``support.units.shown_in``). Where the orientations so far do not determine a parameter there is no point.

A run has two timelines: ``orientation`` (the count of dwells from 1; 0 is a stated prior) and ``bench_time`` (since the
first sample; points within the dwells too). Entities: ``parameters/ACCELEROMETER/SYMBOL/{sigma,target,
deviation,band}``, ``parameters/effects/SYMBOL/...``, ``platform/...``, ``innovation/CHANNEL/{value,bound,in_sigma}``,
``nis/{value,above,band}``, ``residual/CHANNEL``, ``bench/pose/...``, ``summary``.

A view opens with the overview first, and with parameters and innovations in tabs (``layout``).
"""

from __future__ import annotations

from kf_calib.errors import need

need("rerun", None, "a Rerun view", "rerun-sdk")

# ruff: noqa: E402  # after the check
from functools import singledispatch
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rich.console import Group

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, Vector
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.estimate import correlation
from kf_calib.estimation.results import Calibration
from kf_calib.online.status import Judgement
from kf_calib.support import units
from kf_calib.support.text import angles_in_words, counted
from kf_calib.support.units import shown
from kf_calib.views.console import effect_table, noise_table, parameter_table, verdict, without_table
from kf_calib.views.markdown import markdown
from kf_calib.views.rerun.diagnosis import save_diagnosis_view
from kf_calib.views.rerun.improvement import save_improvement_view
from kf_calib.views.rerun.names import (
    BENCH_TIME,
    CHANNELS,
    DARK,
    KINDS,
    ORIENTATION,
    Colour,
    curves_panel,
    markdown_page,
    quantities,
    rrd_file,
    strict,
    window,
)
from kf_calib.views.rerun.series import (
    VisitHistory,
    log_bench,
    log_innovations,
    log_nis,
    log_parameters,
    log_residuals,
    predicted,
)
from kf_calib.views.rerun.spheres import log_platform, magnified, with_y_up
from kf_calib.views.terminal import note

__all__ = ["BENCH_TIME", "ORIENTATION", "grow", "save_view"]

_NO_TARGET = np.full(12, np.nan)

NEXT: Colour = (255, 160, 205)
_ENDLESS = rr.TimeRangeBoundary.infinite()
WHOLE_RUN = rrb.TimeAxis(view_range=rr.TimeRange(start=_ENDLESS, end=_ENDLESS))
"""The same stretch of time in all panels: left to themselves they begin where their own data do."""


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


save_view.register(Diagnosis, save_diagnosis_view)
save_view.register(Improvement, save_improvement_view)


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
    stream.log("summary", markdown_page(text), static=True)


def judgement_text(judgement: Judgement) -> str:
    """The verdict so far, what is suspected, and the next orientation, in Markdown."""
    going = judgement.next_orientation
    lines = [f"**So far**: {judgement.verdict}"]
    if going is not None:
        lines.append(f"**Next**: gimbals at {angles_in_words(going[0])}: {going[1]}")
    return "\n\n".join(lines)


def log_next(judgement: Judgement, stream: rr.RecordingStream) -> None:
    """Where gravity will point in the platform in the orientation that is advised; nothing where none is."""
    going, bench = judgement.next_orientation, judgement.result.bench
    vectors, labels = np.zeros((0, 3)), list[str]()
    if going is not None and bench.axes:
        now_s = np.array([judgement.result.visits[-1].dwell.end_s])
        force: Floats = bench.specific_force(now_s, np.radians([going[0]]))
        vectors, labels = 1.25 * force / np.linalg.norm(force), [f"next: {angles_in_words(going[0])}"]
    arrow = rr.Arrows3D(vectors=vectors, colors=[NEXT] * len(vectors), radii=[0.012] * len(vectors), labels=labels)
    stream.log("platform/next", arrow, static=True)


def markdown_summary(result: Calibration) -> str:
    """The page in Markdown: what was measured, what the console prints of it, the verdict before the tables, and what
    is hard to tell apart."""
    parts = [verdict(result), parameter_table(result), *map(note, result.warnings)]
    parts += [*([effect_table(result)] if result.model.effects else []), noise_table(result)]
    parts += [without_table(result, outlying) for outlying in result.outlying]
    rms, dof = shown("m/s^2").text(result.residual_rms_mps2), result.consistency.dof
    left = f"Residuals: {rms} rms, {dof} degrees of freedom."
    return "\n\n".join([_measured(result), markdown(Group(*parts)), left, *_ties(result)]) + "\n"


def _measured(result: Calibration) -> str:
    bench, count = result.bench, sum(visit.dwell.count for visit in result.visits)
    serial = f"**{bench.notes['block_serial']}**: " if "block_serial" in bench.notes else ""
    axes = f"axes {bench.to_metadata()['axes']}" if bench.axes else "attitude recorded"
    held = ", inertially held" if bench.reference == "inertial" else ""
    dwells = counted(len(result.visits), "dwell")
    return f"{serial}{dwells}, {count} samples; {axes}{held}, g = {bench.gravity_mps2:.6g} m/s²"


def _ties(result: Calibration) -> list[str]:
    """The pairs of parameters the orientations tell apart worst."""
    matrix = np.nan_to_num(correlation(result.estimate))
    pairs = sorted(combinations(range(len(matrix)), 2), key=lambda pair: -abs(matrix[pair]))
    names = [each.label for each in quantities(result.model)]
    strong = [f"{names[i]} {names[j]} {matrix[i, j]:+.2f}" for i, j in pairs[:4] if abs(matrix[i, j]) >= 0.5]
    return [f"**Correlated**: {', '.join(strong)}".replace("-", "−")] if strong else []


def layout(result: Calibration, history: VisitHistory, goes_on: bool = False) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000, the overview in front; ``goes_on``: more dwells are to come."""
    tabs = [_overview(result, history, predicted(result) or goes_on), _parameters(history)]
    tabs += [_innovations(result)] if predicted(result) else []
    return window(rrb.Tabs(*tabs), ORIENTATION, "following")


def _overview(result: Calibration, history: VisitHistory, is_predicted: bool) -> rrb.Horizontal:
    pose = "gimbal angles, deg" if result.bench.axes else "attitude, quaternion"
    return rrb.Horizontal(
        rrb.Vertical(*sigma_panels(history), _series(["bench/pose/**"], pose, rrb.Corner2D.RightTop)),
        rrb.Vertical(platform_panel(result), *_fit(is_predicted), row_shares=[2, 1, 1] if is_predicted else [1, 1]),
        rrb.TextDocumentView(origin="summary", name="result"),
        column_shares=[4.55, 4.25, 4.4],
        name="Overview",
    )


def sigma_panels(history: VisitHistory) -> list[rrb.TimeSeriesView]:
    """A panel a kind of parameter, one for the coefficients of effects if there are any."""
    corner = rrb.Corner2D.RightTop
    kinds = [
        (f"{kind}, {shown(unit).label}", [k for k, own in enumerate(paper_parameters.UNITS) if own == unit])
        for unit, kind in KINDS.items()
    ]
    rest = [*range(12, len(history.shown))]
    kinds += [("coefficients of effects", rest)] if rest else []
    return [
        _series([f"{history.shown[k].path}/{curve}" for k in columns for curve in ("sigma", "target")],
                f"σ of {name}", corner, around=history.sigma_range(columns))
        for name, columns in kinds
    ]  # fmt: skip


def _fit(is_predicted: bool) -> list[rrb.TimeSeriesView]:
    """How well each orientation fits: innovations and NIS, or residuals where few dwells were predicted."""
    if not is_predicted:
        return [_series(["residual/**"], "residuals over σ")]
    ratios = [f"innovation/{channel}/in_sigma" for channel in CHANNELS]
    return [
        _series([*ratios, "innovation/bound"], "innovations over σ"),
        _series(["nis/**"], "NIS, with the middle 95 % of χ²; red: above"),
    ]


def _parameters(history: VisitHistory) -> rrb.Grid:
    """A panel for each parameter and coefficient: what is estimated, with 1 sigma."""
    panels = [
        _series([f"{shown.path}/deviation", f"{shown.path}/band"],
                f"{shown.label}{' − nominal' * (k < 12)} ± σ, {shown.unit}", around=history.late_range(k))
        for k, shown in enumerate(history.shown)
    ]  # fmt: skip
    return rrb.Grid(*panels, grid_columns=4, name="Parameters")


def _innovations(result: Calibration) -> rrb.Vertical:
    """A panel an accelerometer, on the same axes, which show the innovations after a third of the run."""
    unit, last = units.shown("m/s^2"), result.visits[-1].dwell.number
    late = [visit for visit in result.visits if visit.dwell.number >= last / 3]
    bounds = np.array([2.0 * visit.innovation_sigma_mps2 for visit in late])
    reach = 1.08 * unit.per_si * float(np.nanmax([np.abs([visit.innovation_mps2 for visit in late]), bounds]))
    panels = [
        _series([f"innovation/{channel}/value", f"innovation/{channel}/bound"],
                f"accelerometer {i}: mean of a dwell less its prediction ± 2σ, {unit.label}", around=(-reach, reach))
        for i, channel in enumerate(CHANNELS, 1)
    ]  # fmt: skip
    return rrb.Vertical(*panels, name="Innovations")


def _series(
    contents: list[str], name: str, legend: rrb.Corner2D | None = None, around: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Curves over the timeline in use."""
    return curves_panel(contents, name, WHOLE_RUN, legend, around)


def eye(bench: Bench, position: Vector, target: Vector) -> rrb.EyeControls3D:
    """A look at the platform from ``position`` to ``target``, both in a frame with y up, whatever axis is up."""
    place, goal, up = with_y_up(bench, position, target, (0.0, 1.0, 0.0))
    return rrb.EyeControls3D(position=place, look_target=goal, eye_up=up)


def platform_panel(result: Calibration) -> rrb.Spatial3DView:
    so_far = [
        rrb.VisibleTimeRange(
            name, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for name in (ORIENTATION, BENCH_TIME)
    ]
    return rrb.Spatial3DView(
        origin="platform",
        name=f"platform{magnified(result.estimate)}",
        overrides={"platform/visited": rrb.VisibleTimeRanges(so_far)},
        eye_controls=eye(result.bench, (1.8, 1.2, 2.2), (0.05, 0.18, 0.0)),
        line_grid=False,
        background=DARK,
    )
