"""What is estimated against time, with 1 sigma: a chart for each parameter and coefficient.

Entities: ``estimates/{frame,curves}``.
"""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.views.rerun.chart import LEFT, RIGHT, TOP, Axis, Chart, Ink, frames, sheet, thin
from kf_calib.views.rerun.names import GREY
from kf_calib.views.rerun.series import History
from kf_calib.views.rerun.sigmas import ROOM

_AT_MOST = 300  # points of a curve
_MINUTES = 180.0
"""Runs of more seconds have an axis in minutes."""


def _charts(history: History) -> list[Chart]:
    """Four charts a row."""
    rows = -(-len(history.shown) // 4)
    wide, tall = 300.0, max(90.0, 860.0 / rows - TOP - ROOM)
    out = list[Chart]()
    for k, shown in enumerate(history.shown):
        row, column = divmod(k, 4)
        seen = np.isfinite(history.sigma[:, k]).any()
        named = f"{shown.label} − nominal ± σ, {shown.unit}" if k < 12 else f"{shown.label} ± σ, {shown.unit}"
        x = Axis.around(history.elapsed_s / _per(history), _unit(history) if row == rows - 1 else "", room=0.02)
        corner = (column * (wide + LEFT + RIGHT), row * (tall + TOP + ROOM))
        title = named if seen else f"{shown.label}: not determined"
        out.append(Chart(f"estimates/{k}", x, _readable(history, k), title, corner, wide, tall, shown.colour))
    return out


def _per(history: History) -> float:
    return 60.0 if history.elapsed_s[-1] > _MINUTES else 1.0


def _unit(history: History) -> str:
    return "time, min" if _per(history) > 1.0 else "time, s"


def _readable(history: History, k: int) -> Axis:
    """A range that shows the bands of the run's last two thirds: the first estimates are a thousand times wider."""
    late = np.isfinite(history.sigma[:, k]) & (history.orientation >= history.orientation[-1] / 3)
    value, sigma = history.deviation[late, k], history.sigma[late, k]
    return Axis.around(np.concatenate([value - sigma, value + sigma]), room=0.1)


def log_estimates(history: History, stream: rr.RecordingStream) -> None:
    """Send the charts; parts of curves that are out of range run along the edge."""
    charts, ink = _charts(history), Ink()
    frames(stream, "estimates", charts)
    rows = np.unique(np.linspace(0, len(history.elapsed_s) - 1, _AT_MOST).round().astype(int))
    x = history.elapsed_s[rows] / _per(history)
    for k, chart in enumerate(charts):
        value, sigma = history.deviation[rows, k], history.sigma[rows, k]
        for side in (value - sigma, value + sigma):
            ink.lines(chart.strip(x, side), GREY, thin(0.5))
        ink.lines(chart.strip(x, value), history.shown[k].colour, thin(1.2))
    ink.send(stream, "estimates/curves")


def estimates_sheet(history: History, name: str) -> rrb.Spatial2DView:
    """The charts in one view."""
    return sheet("estimates", name, _charts(history))
