"""The Rerun view of a plan: where gravity will point in the platform, and the sigmas falling from dwell to dwell.

Timelines as in a replay: ``bench_time`` and ``orientation``. Entities: ``platform/{sphere,frame,tour,visits,up,
uncertainty}``, ``parameters/ACCELEROMETER/SYMBOL/log10_sigma``, ``bench/pose/GIMBAL``, ``summary``.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import slerp
from kf_calib.design import optimality_criteria
from kf_calib.design.orientation_plan import Plan
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.support.units import shown
from kf_calib.views.plan import gimbal_names, sentences
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.layout import WHOLE_RUN, power
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    BENCH_TIME,
    GIMBALS,
    GOLD,
    GREY,
    GROUPS,
    LABELS,
    UNIT_OF,
    WHITE,
    colour_of,
    path_of,
    per_si,
)
from kf_calib.views.rerun.platform import FINAL_SIZE, LARGEST, THINNEST, log_frame
from kf_calib.views.rerun.series import times

_ARC = 17  # points of the way between two directions
_LIFT = 1.13


def save(made: Plan, path: str | Path) -> Path:
    """Write the view of a plan to an .rrd file that opens laid out, at the end of the plan."""
    path = Path(path)
    with rrd_file(path, _layout(made)) as stream:
        log_frame(stream)
        _log_tour(made, stream)
        _log_uncertainty(made, stream)
        _log_sigmas(made, stream)
        _log_angles(made, stream)
        stream.log("summary", rr.TextDocument(_summary(made), media_type=rr.MediaType.MARKDOWN), static=True)
    return path


def _summary(made: Plan) -> str:
    """Angles, sigmas and figures of merit, in Markdown."""
    gimbals = "".join(f" {name.replace('_', ' ')}, deg |" for name in gimbal_names(made))
    angles = [
        f"| {k} | {begin:.0f} | " + " | ".join(f"{angle:.2f}" for angle in row) + " |"
        for k, (begin, row) in enumerate(zip(made.at_s - 0.5 * made.timing.dwell_s, made.gimbal_deg, strict=True), 1)
    ]
    sigmas = [
        f"| {LABELS[symbol]} | {shown(unit).number(made.sigma[-1, k])} | {shown(unit).label} |"
        for k, (symbol, unit) in enumerate(UNIT_OF.items())
    ]
    head = f"| | begins, s |{gimbals}\n|--:|--:|{'--:|' * made.poses.shape[1]}"
    told = "\n\n".join([*sentences(made), *(f"**Note**: {remark}" for remark in made.remarks)])
    return "\n".join([head, *angles, "", "| | σ after the plan | |", "|:--|--:|:--|", *sigmas, "", told, ""])


def _index(made: Plan, first: int = 0) -> list[rr.TimeColumn]:
    """The ends of the dwells, after the beginning where ``first`` is 1."""
    half = 0.5 * made.timing.dwell_s
    ends = np.append(made.at_s[:1] - half, made.at_s + half)[1 - first :]
    return times(ends, np.arange(1 - first, len(made.poses) + 1))


def _log_tour(made: Plan, stream: rr.RecordingStream) -> None:
    """Numbered directions of the specific force, the ways between them, and the one that is visited."""
    directions, count = made.directions, len(made.poses)
    stream.log("platform/visits", rr.Points3D(directions, colors=GREY, radii=0.012), static=True)
    numbers = rr.Points3D.columns(
        positions=_LIFT * directions,
        colors=[WHITE] * count,
        radii=[0.0] * count,
        labels=[str(k + 1) for k in range(count)],
    )
    rr.send_columns("platform/numbers", _index(made), numbers, recording=stream)
    dots = rr.Points3D.columns(positions=directions, colors=[WHITE] * count, radii=[0.03] * count)
    rr.send_columns("platform/visited", _index(made), dots, recording=stream)
    up = rr.Arrows3D.columns(vectors=1.25 * directions, colors=[GOLD] * count, radii=[0.014] * count)
    rr.send_columns("platform/up", _index(made), up, recording=stream)
    if count > 1:
        stream.log(
            "platform/tour", rr.LineStrips3D(list(_arcs(directions)), colors=(*GOLD, 90), radii=0.004), static=True
        )


def _arcs(directions: Floats) -> Floats:
    """Great arcs (n - 1, m, 3) from each direction to the next."""
    share = np.linspace(0.0, 1.0, _ARC)[:, None]
    return np.array([
        slerp(np.repeat(a[None], _ARC, axis=0), np.repeat(b[None], _ARC, axis=0), share) if a @ b >= 0
        else _far_arc(a, b, share[:, 0])
        for a, b in itertools.pairwise(directions)
    ])  # fmt: skip


def _far_arc(start: Floats, end: Floats, share: Floats) -> Floats:
    """The great arc between directions more than a quarter turn apart: slerp of quaternions would take the other."""
    axis = np.cross(start, end)
    if np.linalg.norm(axis) < 1e-9:
        axis = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    axis /= np.linalg.norm(axis)
    angle = np.arctan2(float(axis @ np.cross(start, end)), float(start @ end))
    return Rotation.from_rotvec(share[:, None] * angle * axis).apply(start)


def _sensitivities(made: Plan) -> tuple[Floats, Floats]:
    """Nominal s_i (3, 3), and their covariances (n + 1, 3, 3, 3) before the first dwell and after each; NaN: unseen."""
    transform = made.prospect.transform[:STATE_COUNT]
    out = np.full((len(made.factors), 3, 3, 3), np.nan)
    for k, factor in enumerate(made.factors):
        if not optimality_criteria.unseen(factor).any():
            root = transform @ np.linalg.inv(factor)
            covariance = (root @ root.T).reshape(3, 4, 3, 4)
            out[k] = np.array([covariance[i, :3, i, :3] for i in range(3)])
    return made.prospect.state[:STATE_COUNT].reshape(3, 4)[:, :3], out


def magnification(covariances: Floats) -> float:
    """1, 2 or 5 times a power of ten that makes the largest final sigma visible."""
    wanted = FINAL_SIZE / float(np.sqrt(np.linalg.eigvalsh(covariances[-1]).max()))
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted * (1 + 1e-9)) * decade)


def _log_uncertainty(made: Plan, stream: rr.RecordingStream) -> None:
    """Sensitive axes, and at their tips ellipsoids of 1 sigma, magnified alike, shrinking along the plan."""
    tips, covariances = _sensitivities(made)
    labels = [f"E{'₁₂₃'[i]}" for i in range(3)]
    stream.log(
        "platform/axes", rr.Arrows3D(vectors=tips, colors=ACCELEROMETERS, labels=labels, radii=0.016), static=True
    )
    factor, shown = magnification(covariances), list[list[tuple[int, Floats, Floats]]]()
    for own in covariances:
        values, turns = (None, None) if np.isnan(own).any() else np.linalg.eigh(own)
        shown.append([] if values is None or turns is None else [
            (i, factor * np.sqrt(values[i]), turns[i] * np.linalg.det(turns[i]))
            for i in range(3) if factor * np.sqrt(values[i].max()) < LARGEST
        ])  # fmt: skip
    flat = [each for own in shown for each in own]
    columns = rr.Ellipsoids3D.columns(
        centers=np.array([tips[i] for i, _, _ in flat]),
        half_sizes=[np.maximum(half, THINNEST) for _, half, _ in flat],
        quaternions=[Rotation.from_matrix(turn).as_quat() for _, _, turn in flat],
        colors=[(*ACCELEROMETERS[i], 120) for i, _, _ in flat],
    ).partition([len(own) for own in shown])
    rr.send_columns("platform/uncertainty", _index(made, 1), columns, recording=stream)
    stream.log("platform/uncertainty", rr.Ellipsoids3D.from_fields(fill_mode="solid"), static=True)


def _log_sigmas(made: Plan, stream: rr.RecordingStream) -> None:
    logs = np.log10(made.sigma[:, :STATE_COUNT] * per_si())
    for k, symbol in enumerate(paper_parameters.SYMBOLS):
        seen = np.isfinite(logs[:, k])
        path = f"{path_of(symbol)}/log10_sigma"
        index = [rr.TimeColumn(BENCH_TIME, duration=_ends_ns(made)[seen]),
                 rr.TimeColumn("orientation", sequence=np.flatnonzero(seen))]  # fmt: skip
        rr.send_columns(path, index, rr.Scalars.columns(scalars=logs[seen, k]), recording=stream)
        style = rr.SeriesLines(
            names=LABELS[symbol], colors=colour_of(symbol), widths=2.0, interpolation_mode="StepAfter"
        )
        stream.log(path, style, static=True)


def _ends_ns(made: Plan) -> np.ndarray:
    half = 0.5 * made.timing.dwell_s
    ends = np.append(made.at_s[:1] - half, made.at_s + half)
    return np.round(ends * 1e9).astype("timedelta64[ns]")


def _log_angles(made: Plan, stream: rr.RecordingStream) -> None:
    for k, (name, angle) in enumerate(zip(gimbal_names(made), made.gimbal_deg.T, strict=True)):
        path = f"bench/pose/{name}"
        rr.send_columns(path, _index(made), rr.Scalars.columns(scalars=angle), recording=stream)
        style = rr.SeriesPoints(names=name.replace("_", " "), colors=GIMBALS[k % len(GIMBALS)], marker_sizes=4.0)
        stream.log(path, style, static=True)


def _layout(made: Plan) -> rrb.Blueprint:
    so_far = [
        rrb.VisibleTimeRange(
            name, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for name in ("orientation", BENCH_TIME)
    ]
    ranges, factor = rrb.VisibleTimeRanges(so_far), power(magnification(_sensitivities(made)[1]))
    platform = rrb.Spatial3DView(
        origin="platform",
        name=f"platform: directions up in order of visits; E₁ E₂ E₃ with 1σ ×{factor}",
        overrides={"platform/visited": ranges, "platform/numbers": ranges},
        eye_controls=rrb.EyeControls3D(position=(2.1, 1.4, 2.6), look_target=(0.05, 0.0, 0.0), eye_up=(0, 1, 0)),
        line_grid=False,
    )
    sigmas = [
        _series(
            [f"{path_of(symbol)}/log10_sigma" for symbol in group.symbols],
            f"σ of {group.title}: log₁₀ of {shown(group.unit).label}",
        )
        for group in GROUPS
    ]
    angles = _series(["bench/pose/**"], "gimbal angles, deg")
    summary = rrb.TextDocumentView(origin="summary", name="plan")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*sigmas, angles, row_shares=[3, 3, 3, 3]),
            platform, summary, column_shares=[4, 5, 5],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="orientation", play_state="following"),
    )  # fmt: skip


def _series(contents: list[str], name: str) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=True)
    return rrb.TimeSeriesView(contents=contents, name=name, plot_legend=legend, axis_x=WHOLE_RUN)
