"""The Rerun view of a plan: where gravity will point in the platform, and the sigmas falling from dwell to dwell.

Timelines as in a replay: ``bench_time`` and ``orientation``. Entities: ``platform/{sphere,frame,tour,visits,up,
uncertainty}``, the charts ``sigmas/KIND`` and ``angles``, ``summary``.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import slerp
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design import optimality_criteria
from kf_calib.design.orientation_plan import Plan
from kf_calib.estimation.information_share import shares_of
from kf_calib.views.plan import gimbal_names, sentences
from kf_calib.views.rerun.chart import LABEL_HEIGHT, Axis, Chart, frames, power, sheet, thin, write
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    BENCH_TIME,
    GIMBALS,
    GOLD,
    GREY,
    WHITE,
    per_si,
    twelve,
)
from kf_calib.views.rerun.platform import ellipsoids, log_ellipsoids, log_frame, magnification
from kf_calib.views.rerun.series import times
from kf_calib.views.rerun.sigmas import Falling, overview_sheet

_ARC = 17  # points of the way between two directions
_LIFT = 1.13


def save(made: Plan, path: str | Path) -> Path:
    """Write the view of a plan to an .rrd file that opens laid out, at the end of the plan."""
    path = Path(path)
    with rrd_file(path, _layout(made)) as stream:
        log_frame(stream)
        _log_tour(made, stream)
        _log_uncertainty(made, stream)
        _falling(made).log_overview(stream)
        _log_angles(made, stream)
        stream.log("summary", rr.TextDocument(_summary(made), media_type=rr.MediaType.MARKDOWN), static=True)
    return path


def _summary(made: Plan) -> str:
    """Figures of merit, sigmas, and angles, in Markdown; the longest comes last."""
    gimbals = "".join(f" {name.replace('_', ' ')}, deg |" for name in gimbal_names(made))
    angles = [
        f"| {k} | {begin:.0f} | " + " | ".join(f"{angle:.2f}" for angle in row) + " |"
        for k, (begin, row) in enumerate(zip(made.at_s - 0.5 * made.timing.dwell_s, made.gimbal_deg, strict=True), 1)
    ]
    final = made.sigma[-1, :STATE_COUNT] * per_si()
    cells = [f"{each.label} {value:.3g} {each.unit}" for each, value in zip(twelve(), final, strict=True)]
    sigmas = ["| σ after the plan | | | |", "|:--|:--|:--|:--|",
              *("| " + " | ".join(cells[4 * i : 4 * i + 4]) + " |" for i in range(3))]  # fmt: skip
    head = f"| | begins, s |{gimbals}\n|--:|--:|{'--:|' * made.poses.shape[1]}"
    told = "\n\n".join([*sentences(made), *(f"**Note**: {remark}" for remark in made.remarks)])
    return "\n".join([told, "", *sigmas, "", head, *angles, ""])


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


def _falling(made: Plan) -> Falling:
    """The sigmas after each orientation; 0 is what was known before."""
    sigma = made.sigma[:, :STATE_COUNT]
    first = 0 if np.isfinite(sigma[0]).any() else 1
    shares = np.vstack([np.zeros((1, STATE_COUNT)), shares_of(sigma)])[first:]
    aims, shown_sigma = np.full(STATE_COUNT, np.nan), sigma[first:] * per_si()
    return Falling(twelve(), np.arange(first, len(sigma)), shown_sigma, shares, aims)


def _log_uncertainty(made: Plan, stream: rr.RecordingStream) -> None:
    """Sensitive axes, and at their tips ellipsoids of 1 sigma, magnified alike, shrinking along the plan."""
    tips, covariances = _sensitivities(made)
    labels = [f"E{'₁₂₃'[i]}" for i in range(3)]
    stream.log(
        "platform/axes", rr.Arrows3D(vectors=tips, colors=ACCELEROMETERS, labels=labels, radii=0.016), static=True
    )
    count = len(covariances)
    log_ellipsoids(
        stream, _index(made, 1), list(range(count)), [ellipsoids(own) for own in covariances], [tips] * count
    )


def _angles(made: Plan) -> Chart:
    """The chart of the gimbal angles of each orientation."""
    across = Axis.counted(1, len(made.poses), "orientation")
    return Chart("angles", across, Axis.around(made.gimbal_deg), width=520.0, height=150.0)


def _log_angles(made: Plan, stream: rr.RecordingStream) -> None:
    chart, number = _angles(made), np.arange(1.0, len(made.poses) + 1.0)
    frames(stream, "angles", [chart])
    for k, (name, angle) in enumerate(zip(gimbal_names(made), made.gimbal_deg.T, strict=True)):
        colour = GIMBALS[k % len(GIMBALS)]
        radius = thin(3.5 if len(number) < 60 else 1.6)
        points = rr.Points2D(chart.at(number, angle), colors=colour, radii=radius)
        stream.log(f"angles/{name}", points, static=True)
        write(stream, f"angles/{name}/name", [((60.0 + 60.0 * k, -LABEL_HEIGHT - 8.0), name.replace("_", " "))], colour)


def _layout(made: Plan) -> rrb.Blueprint:
    so_far = [
        rrb.VisibleTimeRange(
            name, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for name in ("orientation", BENCH_TIME)
    ]
    ranges = rrb.VisibleTimeRanges(so_far)
    factor = magnification(ellipsoids(_sensitivities(made)[1][-1]))
    spread = f" with 1σ ×{power(factor)}" if factor else ""
    platform = rrb.Spatial3DView(
        origin="platform",
        name=f"up, in order of visits; E₁ E₂ E₃{spread}",
        overrides={"platform/visited": ranges, "platform/numbers": ranges},
        eye_controls=rrb.EyeControls3D(position=(2.1, 1.4, 2.6), look_target=(0.05, 0.0, 0.0), eye_up=(0, 1, 0)),
        line_grid=False,
    )
    sigmas = overview_sheet(_falling(made), "σ by orientation; bars: information brought")
    angles = sheet("angles", "gimbal angles, deg", [_angles(made)])
    summary = rrb.TextDocumentView(origin="summary", name="plan")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(sigmas, angles, row_shares=[8, 3]),
            platform, summary, column_shares=[5, 5, 4.2],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="orientation", play_state="following"),
    )  # fmt: skip
