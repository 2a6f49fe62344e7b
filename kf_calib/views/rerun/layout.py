"""Which panel stands where when a view is opened: the overview first, each parameter and each channel in a tab."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench import paper_parameters
from kf_calib.bench.bench import Bench, Vector
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import shown
from kf_calib.views.rerun.names import BENCH_TIME, CHANNELS, GROUPS, LABELS, ORIENTATION, UNIT_OF, path_of
from kf_calib.views.rerun.platform import magnification
from kf_calib.views.rerun.series import History, nis_band

SHORT_RUN = 8  # dwells
TABS = ("Overview", "Parameters", "Innovations")
_ENDLESS = rr.TimeRangeBoundary.infinite()
WHOLE_RUN = rrb.TimeAxis(view_range=rr.TimeRange(start=_ENDLESS, end=_ENDLESS))
"""The same stretch of time in all panels: left to themselves they begin where their own data do."""


def layout(result: Calibration, history: History, timeline: str, tab: str) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000, ``tab`` (one of TABS) in front."""
    tabs = [_overview(result), _parameters(history), *([_innovations(result)] if _predicted(result) else [])]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=min(TABS.index(tab), len(tabs) - 1)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
    )


def _overview(result: Calibration) -> rrb.Horizontal:
    judged = [_normalised(result), _nis(result)] if _predicted(result) else []
    return rrb.Horizontal(
        rrb.Vertical(*_sigmas(result), _dwells(), _pose(result), row_shares=[5, 3.2, 3.2, 1.5, 3]),
        rrb.Vertical(_platform(result), *(judged or [_correlation()]), row_shares=[6, 3, 3] if judged else [1, 1]),
        rrb.Vertical(_summary(), *([_correlation()] if judged else []), row_shares=[7, 5] if judged else [1]),
        column_shares=[5, 4.2, 3.6],
        name=TABS[0],
    )


def _predicted(result: Calibration) -> bool:
    """Was any dwell predicted from those before? Panels of innovations and NIS would else stand empty."""
    return any(visit.dof > 0 and np.isfinite(visit.innovation_mps2).all() for visit in result.visits)


def _sigmas(result: Calibration) -> list[rrb.TimeSeriesView]:
    # the curves fall, so the upper right is free; in a short run without a prior they begin late, and the left is
    late = len(result.visits) <= SHORT_RUN and result.settings.prior.diffuse
    corner = rrb.Corner2D.LeftTop if late else rrb.Corner2D.RightTop
    return [
        _series(
            [f"{path_of(symbol)}/log10_sigma" for symbol in group.symbols],
            f"σ of {group.title}: log₁₀ of {shown(group.unit).label}",
            corner,
        )
        for group in GROUPS
    ]


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


def _dwells() -> rrb.StateTimelineView:
    return rrb.StateTimelineView(contents=["bench/dwell"], name="dwell", time_view=WHOLE_RUN)


def _pose(result: Calibration) -> rrb.TimeSeriesView:
    name = "gimbal angles, deg" if result.bench.axes else "attitude, quaternion"
    return _series(["bench/pose/**"], name, rrb.Corner2D.RightTop)


def eye(bench: Bench, position: Vector, target: Vector) -> rrb.EyeControls3D:
    """A look at the platform from ``position`` to ``target``, both in a frame with y up, whatever axis is up."""
    at_rest = np.zeros((1, len(bench.axes))) if bench.axes else np.array([[0.0, 0.0, 0.0, 1.0]])
    place, goal, up = bench.to_platform(np.array([position, target, (0.0, 1.0, 0.0)]), at_rest)
    return rrb.EyeControls3D(position=place, look_target=goal, eye_up=up)


def _platform(result: Calibration) -> rrb.Spatial3DView:
    factor = magnification(result.estimate)
    ellipsoids = f" with 1σ ×{power(factor)}" if factor else ""
    so_far = [
        rrb.VisibleTimeRange(
            name, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for name in (ORIENTATION, BENCH_TIME)
    ]
    return rrb.Spatial3DView(
        origin="platform",
        name=f"platform: E₁ E₂ E₃{ellipsoids}; up now and before",
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


def _correlation() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin="correlation",
        contents=["correlation/picture", "correlation/rows", "correlation/columns"],
        name="correlation: blue −1, orange +1; grey: unseen",
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.6, 12.1], y_range=[-1.5, 12.1]),
    )


def _parameters(history: History) -> rrb.Grid:
    return rrb.Grid(
        *(_parameter(history, k) for k in range(len(paper_parameters.SYMBOLS))), grid_columns=4, name=TABS[1]
    )


def _parameter(history: History, k: int) -> rrb.TimeSeriesView:
    symbol, sigma = paper_parameters.SYMBOLS[k], history.sigma[:, k]
    path, label = path_of(symbol), LABELS[symbol]
    unit, seen = shown(UNIT_OF[symbol]), np.isfinite(sigma).any()
    name = f"{label} − nominal ± σ, {unit.label}" if seen else f"{label}: not determined"
    around = _readable(history.deviation[:, k], sigma, history.orientation)
    return _series([f"{path}/band", f"{path}/deviation"], name, around=around)


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
    unit = shown("m/s^2")
    reach = 1.1 * unit.per_si * float(np.nan_to_num(np.maximum(values, bounds)).max())
    panels = [
        _series(
            [f"innovation/{channel}/value", f"innovation/{channel}/bound"],
            f"innovation of accelerometer {i}: mean of a dwell less its prediction, with ±2σ, {unit.label}",
            around=(-reach, reach),
        )
        for i, channel in enumerate(CHANNELS, 1)
    ]
    return rrb.Vertical(*panels, name=TABS[2])


def power(factor: float) -> str:
    """``5·10⁴`` for 5e4; factors below 1000 as they are."""
    if factor < 1000:
        return f"{factor:g}"
    exponent = round(np.floor(np.log10(factor) + 1e-9))
    digits = f"10{exponent}".translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))[2:]
    lead = factor / 10.0**exponent
    return f"10{digits}" if round(lead) == 1 else f"{lead:.0f}·10{digits}"
