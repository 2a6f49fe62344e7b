"""Which panel stands where when a view is opened: the overview first, each parameter and each channel in a tab."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.bench import Bench, Vector
from kf_calib.estimation.correlation import largest_correlation
from kf_calib.estimation.results import Calibration
from kf_calib.views.rerun.chart import sheet
from kf_calib.views.rerun.names import BENCH_TIME, CHANNELS, MICRO, ORIENTATION, TWELVE
from kf_calib.views.rerun.platform import magnified
from kf_calib.views.rerun.residuals import residual_chart
from kf_calib.views.rerun.series import History, nis_band
from kf_calib.views.rerun.sigmas import Falling, overview_sheet, single_sheet

TIED = 0.3
"""Largest correlation below which the matrix has nothing to show."""
TABS = ("Overview", "Sigmas", "Parameters", "Innovations")
_ENDLESS = rr.TimeRangeBoundary.infinite()
WHOLE_RUN = rrb.TimeAxis(view_range=rr.TimeRange(start=_ENDLESS, end=_ENDLESS))
"""The same stretch of time in all panels: left to themselves they begin where their own data do."""


def layout(result: Calibration, history: History, falling: Falling, timeline: str, tab: str) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000, ``tab`` (one of TABS) in front."""
    tabs = [_overview(result, falling), single_sheet(falling, TABS[1]), _parameters(history)]
    tabs += [_innovations(result)] if predicted(result) else []
    tabs += [_correlation(len(falling.shown))] if largest_correlation(result.estimate) >= TIED else []
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=min(TABS.index(tab), len(tabs) - 1)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
    )


def _overview(result: Calibration, falling: Falling) -> rrb.Horizontal:
    judged = [_normalised(result), _nis(result)] if predicted(result) else [_residuals(result)]
    return rrb.Horizontal(
        rrb.Vertical(
            overview_sheet(falling, "σ by orientation; bars: information brought"), _pose(result), row_shares=[7, 2]
        ),
        rrb.Vertical(_platform(result), *judged, row_shares=[6, 3, 3][: 1 + len(judged)]),
        _summary(),
        column_shares=[5, 4.4, 3.8],
        name=TABS[0],
    )


def predicted(result: Calibration) -> bool:
    """Were most dwells predicted from those before? Panels of innovations and NIS would else stand nearly empty."""
    known = [visit.dof > 0 and bool(np.isfinite(visit.innovation_mps2).all()) for visit in result.visits]
    return 2 * sum(known) >= len(known)


def _series(
    contents: list[str], name: str, legend: rrb.Corner2D | None = None, around: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Curves over the timeline in use; no legend unless a corner is given for it."""
    return rrb.TimeSeriesView(
        contents=contents,
        name=name,
        plot_legend=rrb.PlotLegend(legend, visible=legend is not None),
        axis_x=WHOLE_RUN,
        axis_y=None if around is None else rrb.ScalarAxis(range=around),
    )


def _pose(result: Calibration) -> rrb.TimeSeriesView:
    name = "gimbal angles, deg" if result.bench.axes else "attitude, quaternion"
    return _series(["bench/pose/**"], name, rrb.Corner2D.RightTop)


def eye(bench: Bench, position: Vector, target: Vector) -> rrb.EyeControls3D:
    """A look at the platform from ``position`` to ``target``, both in a frame with y up, whatever axis is up."""
    at_rest = np.zeros((1, len(bench.axes))) if bench.axes else np.array([[0.0, 0.0, 0.0, 1.0]])
    place, goal, up = bench.to_platform(np.array([position, target, (0.0, 1.0, 0.0)]), at_rest)
    return rrb.EyeControls3D(position=place, look_target=goal, eye_up=up)


def _platform(result: Calibration) -> rrb.Spatial3DView:
    so_far = [
        rrb.VisibleTimeRange(
            name, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for name in (ORIENTATION, BENCH_TIME)
    ]
    return rrb.Spatial3DView(
        origin="platform",
        name=f"platform: E₁ E₂ E₃{magnified(result.estimate)}; up now and before",
        overrides={"platform/visited": rrb.VisibleTimeRanges(so_far)},
        eye_controls=eye(result.bench, (1.8, 1.2, 2.2), (0.05, 0.18, 0.0)),
        line_grid=False,
    )


def _normalised(result: Calibration) -> rrb.TimeSeriesView:
    contents = ["innovation/bound", *(f"innovation/{channel}/in_sigma" for channel in CHANNELS)]
    ratios = [visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in result.visits]
    reach = 1.1 * max(2.5, float(np.abs(np.nan_to_num(ratios)).max()))
    return _series(contents, "innovations of E₁ E₂ E₃ over their σ, with ±2", around=(-reach, reach))


def _nis(result: Calibration) -> rrb.TimeSeriesView:
    judged = [visit for visit in result.visits if visit.dof > 0]
    band = nis_band(np.array([visit.dof for visit in judged]))
    reach = 1.1 * max(float(band.max()), *(visit.nis for visit in judged))
    return _series(["nis/**"], "NIS by dwell, with the middle 95 % of χ²; red: above", around=(-0.05 * reach, reach))


def _summary() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin="summary", name="result")


def _correlation(count: int) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin="correlation",
        contents=["correlation/picture", "correlation/rows", "correlation/columns"],
        name="Correlation: blue −1, orange +1; grey: not determined",
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.6, count + 0.1], y_range=[-2.4, count + 0.1]),
    )


def _residuals(result: Calibration) -> rrb.Spatial2DView:
    return sheet("residuals", "residuals over their σ by orientation", [residual_chart(result)])


def _parameters(history: History) -> rrb.Grid:
    return rrb.Grid(*(_parameter(history, k) for k in range(len(history.shown))), grid_columns=4, name=TABS[2])


def _parameter(history: History, k: int) -> rrb.TimeSeriesView:
    shown, sigma = history.shown[k], history.sigma[:, k]
    from_nominal = " − nominal" if k < len(TWELVE) else ""
    seen = np.isfinite(sigma).any()
    name = f"{shown.label}{from_nominal} ± σ, {shown.unit}" if seen else f"{shown.label}: not determined"
    around = _readable(history.deviation[:, k], sigma, history.orientation)
    return _series([f"{shown.path}/band", f"{shown.path}/deviation"], name, around=around)


def _readable(deviation: np.ndarray, sigma: np.ndarray, orientation: np.ndarray) -> tuple[float, float] | None:
    """A range that shows the bands of the run's last two thirds: the first estimates are a thousand times wider."""
    late = np.isfinite(sigma) & (orientation >= orientation[-1] / 3)
    if not late.any():
        return None
    low, high = float((deviation - sigma)[late].min()), float((deviation + sigma)[late].max())
    room = 0.1 * (high - low)
    return low - room, high + room


def _innovations(result: Calibration) -> rrb.Vertical:
    values = np.array([np.abs(visit.innovation_mps2) for visit in result.visits])
    bounds = np.array([2 * visit.innovation_sigma_mps2 for visit in result.visits])
    reach = 1.1 * MICRO * float(np.nan_to_num(np.maximum(values, bounds)).max())
    panels = [
        _series(
            [f"innovation/{channel}/value", f"innovation/{channel}/bound"],
            f"innovation of accelerometer {i}: mean of a dwell less its prediction, with ±2σ, µm/s²",
            around=(-reach, reach),
        )
        for i, channel in enumerate(CHANNELS, 1)
    ]
    return rrb.Vertical(*panels, name=TABS[3])
