"""Which panel stands where when a view is opened: the overview first, each parameter and each channel in a tab."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.bench import Bench, Vector
from kf_calib.estimation.correlation import largest_correlation
from kf_calib.estimation.results import Calibration
from kf_calib.views.rerun.chart import sheet
from kf_calib.views.rerun.estimates import estimates_sheet
from kf_calib.views.rerun.names import BENCH_TIME, ORIENTATION
from kf_calib.views.rerun.platform import magnified
from kf_calib.views.rerun.residuals import fit_charts, innovation_charts, predicted
from kf_calib.views.rerun.series import History
from kf_calib.views.rerun.sigmas import Falling, overview_sheet, single_sheet

TIED = 0.3
"""Largest correlation below which the matrix has nothing to show."""
TABS = ("Overview", "Sigmas", "Parameters", "Innovations")
_ENDLESS = rr.TimeRangeBoundary.infinite()
WHOLE_RUN = rrb.TimeAxis(view_range=rr.TimeRange(start=_ENDLESS, end=_ENDLESS))
"""The same stretch of time in all panels: left to themselves they begin where their own data do."""


def layout(result: Calibration, history: History, falling: Falling, timeline: str, tab: str) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000, ``tab`` (one of TABS) in front."""
    tabs = [_overview(result, falling), single_sheet(falling, TABS[1]), estimates_sheet(history, TABS[2])]
    tabs += [sheet("innovations", TABS[3], innovation_charts(result))] if predicted(result) else []
    tabs += [_correlation(len(falling.shown))] if largest_correlation(result.estimate) >= TIED else []
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=min(TABS.index(tab), len(tabs) - 1)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
    )


def _overview(result: Calibration, falling: Falling) -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Vertical(
            overview_sheet(falling, "σ by orientation; bars: information brought"), _pose(result), row_shares=[7, 2]
        ),
        rrb.Vertical(
            _platform(result), sheet("fit", "how well each orientation fits", fit_charts(result)), row_shares=[1, 1]
        ),
        _summary(),
        column_shares=[5, 4.4, 3.8],
        name=TABS[0],
    )


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


def _summary() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin="summary", name="result")


def _correlation(count: int) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin="correlation",
        contents=["correlation/picture", "correlation/rows", "correlation/columns"],
        name="Correlation: blue −1, orange +1; grey: not determined",
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.6, count + 0.1], y_range=[-2.4, count + 0.1]),
    )
