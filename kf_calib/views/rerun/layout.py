"""Which panel stands where when a view of a run is opened: the overview first, parameters and innovations in tabs."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.bench import Bench, Vector
from kf_calib.estimation.results import Calibration
from kf_calib.support import units
from kf_calib.views.rerun.names import BENCH_TIME, CHANNELS, GROUPS, ORIENTATION
from kf_calib.views.rerun.platform import magnified
from kf_calib.views.rerun.series import VisitHistory, predicted

_ENDLESS = rr.TimeRangeBoundary.infinite()
WHOLE_RUN = rrb.TimeAxis(view_range=rr.TimeRange(start=_ENDLESS, end=_ENDLESS))
"""The same stretch of time in all panels: left to themselves they begin where their own data do."""


def layout(result: Calibration, history: VisitHistory, goes_on: bool = False) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000, the overview in front; ``goes_on``: more dwells are to come."""
    tabs = [_overview(result, history, predicted(result) or goes_on), _parameters(history)]
    tabs += [_innovations(result)] if predicted(result) else []
    return rrb.Blueprint(
        rrb.Tabs(*tabs),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=ORIENTATION, play_state="following"),
    )


def _overview(result: Calibration, history: VisitHistory, is_predicted: bool) -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Vertical(*_sigmas(history), _pose(result)),
        rrb.Vertical(_platform(result), *_fit(is_predicted), row_shares=[2, 1, 1] if is_predicted else [1, 1]),
        rrb.TextDocumentView(origin="summary", name="result"),
        column_shares=[5, 4.4, 3.8],
        name="Overview",
    )


def _sigmas(history: VisitHistory) -> list[rrb.TimeSeriesView]:
    """A panel a kind of parameter, one for the coefficients of effects if there are any."""
    corner = rrb.Corner2D.RightTop
    kinds = [(f"{group.title}, {units.shown(group.unit).label}",
              [k for k, shown in enumerate(history.shown[:12]) if shown.path.rpartition("/")[2] in group.symbols])
             for group in GROUPS]  # fmt: skip
    rest = [*range(12, len(history.shown))]
    kinds += [("coefficients of effects", rest)] if rest else []
    return [
        _series([f"{history.shown[k].path}/{curve}" for k in columns for curve in ("log10_sigma", "log10_target")],
                f"log₁₀ σ of {name}", corner)
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
        name=f"platform{magnified(result.estimate)}",
        overrides={"platform/visited": rrb.VisibleTimeRanges(so_far)},
        eye_controls=eye(result.bench, (1.8, 1.2, 2.2), (0.05, 0.18, 0.0)),
        line_grid=False,
    )
