"""The Rerun view of a comparison: how far batch least squares is from the filter after each orientation.

Entities: ``apart/KIND/CURVE`` and ``summary``. Differences are in sigma of the filter's estimate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.engine_comparison import Comparison
from kf_calib.support.plain_text import printable
from kf_calib.views.rerun.chart import LABEL_HEIGHT, TOP, Axis, Chart, frames, sheet, thin, write
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.names import GOLD, GREY, Quantity, quantities
from kf_calib.views.rerun.series import Counts, ends
from kf_calib.views.rerun.sigmas import ROOM

_WAYS = {"filterpy": "filterpy", "batch": "batch least squares"}
_SIZE = (900.0, 210.0)


def save(compared: Comparison, path: Path) -> Path:
    """Write the view of a comparison to an .rrd file that opens laid out."""
    number, apart = ends(compared.result.visits)[1], np.abs(compared.running_sigma["batch"])
    shown = quantities(compared.result.model)
    charts = _charts(compared, number, apart)
    with rrd_file(path, _layout(charts)) as stream:
        frames(stream, "apart", charts)
        for i, chart in enumerate(charts):
            _log(chart, number, apart, shown, i, stream)
            _log_ends(chart, compared, float(number[-1]), stream)
        text = rr.TextDocument(printable(_summary(compared)), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", text, static=True)
    return path


def _charts(compared: Comparison, number: Counts, apart: Floats) -> list[Chart]:
    """A chart an accelerometer, on the same axes, and one for the coefficients of effects if there are any."""
    others = [way.max_difference_sigma for way in compared.ways.values()]
    y = Axis.around(np.append(apart.ravel(), others), log=True, room=0.12)
    titles = [f"accelerometer {i + 1}" for i in range(3)] + ["coefficients of effects"] * (apart.shape[1] > 12)
    below = "orientation"
    return [
        Chart(f"apart/{i + 1}", Axis.counted(int(number[0]), int(number[-1]), below if i == len(titles) - 1 else ""), y,
              f"{title}: difference, σ", (0.0, i * (_SIZE[1] + TOP + ROOM)), *_SIZE)
        for i, title in enumerate(titles)
    ]  # fmt: skip


def _log(
    chart: Chart, number: Counts, apart: Floats, shown: tuple[Quantity, ...], i: int, stream: rr.RecordingStream
) -> None:
    """One chart: a curve for each parameter, all dwells so far by least squares against the filter."""
    for k in range(4 * i, 4 * i + 4) if i < 3 else range(12, len(shown)):
        known = apart[:, k] > 0.0  # equal to the last bit: no point on a logarithmic axis
        x, y = number[known].astype(float), apart[known, k]
        path, colour = f"{chart.path}/{k % 4 if i < 3 else k}", shown[k].colour
        stream.log(f"{path}/line", rr.LineStrips2D(chart.strip(x, y), colors=[colour], radii=thin(0.8)), static=True)
        points = rr.Points2D(chart.at(x, y), colors=colour, radii=thin(3.0 if len(x) < 60 else 1.5))
        stream.log(f"{path}/points", points, static=True)
        if len(x):
            place = chart.corner[0] + 14.0 + 48.0 * (k % 4 if i < 3 else k - 12), chart.corner[1] - LABEL_HEIGHT - 8.0
            write(stream, f"{path}/name", [(place, shown[k].label)], colour)


def _log_ends(chart: Chart, compared: Comparison, last: float, stream: rr.RecordingStream) -> None:
    """The largest difference of each other way after the whole run, as a line with its name."""
    for name, colour in zip(_WAYS, (GOLD, GREY), strict=True):
        size = compared.ways[name].max_difference_sigma
        if size > 0.0:
            line = rr.LineStrips2D([chart.level(size)], colors=colour, radii=thin(0.8))
            stream.log(f"{chart.path}/{name}", line, static=True)


def _summary(compared: Comparison) -> str:
    head = "| | s | MB | apart, σ |\n|:--|--:|--:|--:|"
    names = {"block": "this program", **_WAYS}
    rows = [f"| {names[name]} | {way.wall_s:.3g} | {way.peak_mb:.3g} | {way.max_difference_sigma:.2g} |"
            for name, way in compared.ways.items()]  # fmt: skip
    lines = (
        "Lines across, and the last column: after the whole run, the largest difference of all parameters from this "
        "program's filter (gold: filterpy, grey: batch)."
    )
    curves = "Curves: after each orientation, least squares over the readings so far."
    return "\n\n".join(["\n".join([head, *rows]), curves, lines, *compared.remarks]) + "\n"


def _layout(charts: list[Chart]) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(
            sheet("apart", "least squares less filter, by orientation", charts),
            rrb.TextDocumentView(origin="summary", name="three ways"),
            column_shares=[7, 4],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="hidden"),
    )
