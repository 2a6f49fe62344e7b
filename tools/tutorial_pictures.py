"""The pictures of docs/tutorial.md: `.venv/bin/python tools/tutorial_pictures.py` draws them again, from the recording.

Panels are Rerun's, drawn without a window (kf_calib.views.screenshot); the missing effect is the one that the diagnosis
names. Pictures are reduced to a palette: they are small enough to live in the repository.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image

import kf_calib
from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.support.units import shown
from kf_calib.views.rerun.names import ACCELEROMETERS, GOLD, GREY, GROUPS, LABELS, ORIENTATION, colour_of, per_si
from kf_calib.views.screenshot import screenshot

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
RECORDING = ROOT / "recordings" / "hidden.mcap"
PALETTE = 64  # colours


def main() -> None:
    before = diagnose(kf_calib.calibrate(kf_calib.open_recording(RECORDING)))
    assert before.after is not None, "the diagnosis names no effect"
    after = diagnose(before.after)
    draw_readings(before, DOCS / "tutorial_readings.png")
    draw_residuals([before, after], DOCS / "tutorial_residuals.png")
    draw_sigmas(before.after, DOCS / "tutorial_sigmas.png")


def draw_readings(found: Diagnosis, png: Path) -> None:
    """Readings of the dwell and accelerometer that fit worst, less what the model says, with their mean."""
    number, i = np.unravel_index(np.abs(found.residual_ratios).argmax(), found.residual_ratios.shape)
    visit = found.before.visits[number]
    time_ns, values = zip(
        *((batch.accel.time_ns, batch.accel.values[:, i]) for batch in kf_calib.open_recording(RECORDING)), strict=True
    )
    elapsed_s = (np.concatenate(time_ns) - time_ns[0][0]) * 1e-9
    inside = (elapsed_s >= visit.dwell.start_s) & (elapsed_s <= visit.dwell.end_s)
    unit, readings = shown("m/s^2"), np.concatenate(values)[inside]
    misfit = visit.residual_mps2[i] * unit.per_si
    values = (readings - readings.mean()) * unit.per_si + misfit
    with tempfile.TemporaryDirectory() as folder, rr.RecordingStream("readings") as stream:
        points = rr.SeriesPoints(names="reading", colors=ACCELEROMETERS[i], markers="circle", marker_sizes=2.0)
        send(stream, "readings/each", values, points)
        send(stream, "readings/model", np.zeros(len(values)), rr.SeriesLines(names="model", colors=GREY, widths=1.5))
        mean = rr.SeriesLines(names=f"their mean, {misfit:+.1f}", colors=GOLD, widths=2.5)
        send(stream, "readings/mean", np.full(len(values), misfit), mean)
        name = f"E{i + 1}, dwell {number + 1}, reading by reading: reading − model of twelve parameters, {unit.label}"
        panels = rrb.Horizontal(panel("readings", name, len(values), legend=True))
        take(stream, panels, Path(folder, "readings.rrd"), png, (1200, 360))


def draw_residuals(found: Sequence[Diagnosis], png: Path) -> None:
    """Residuals of the dwells over their sigma: a column a model, a row an accelerometer, one scale for all."""
    ratios = [each.residual_ratios for each in found]
    reach = 1.1 * max(np.abs(each).max() for each in ratios)
    columns = list[rrb.Vertical]()
    with tempfile.TemporaryDirectory() as folder, rr.RecordingStream("residuals") as stream:
        for k, (each, values) in enumerate(zip(found, ratios, strict=True)):
            panels = list[rrb.TimeSeriesView]()
            for i, colour in enumerate(ACCELEROMETERS):
                path = f"{k}/a{i + 1}"
                points = rr.SeriesPoints(colors=colour, markers="circle", marker_sizes=5.0)
                send(stream, f"{path}/value", values[:, i], points)
                bounds = np.tile([-2.0, 2.0], (len(values), 1))
                send(stream, f"{path}/bound", bounds, rr.SeriesLines(colors=[GREY] * 2, widths=[1.0] * 2))
                name = f"E{i + 1}: residual / σ by dwell, with ±2; {each.before.model.sum}"
                panels.append(panel(path, name, len(values), (-reach, reach)))
            columns.append(rrb.Vertical(*panels))
        take(stream, rrb.Horizontal(*columns), Path(folder, "residuals.rrd"), png, (1200, 720))


def draw_sigmas(result: kf_calib.Calibration, png: Path) -> None:
    """log10 of sigma after each orientation: the twelve parameters by kind, and the coefficients of the effect."""
    twelve = np.array([visit.estimate.sigma[:12] for visit in result.visits]) * per_si()
    others = list(result.parameters.values())[12:]
    added = np.array([visit.estimate.effect_sigma for visit in result.visits]) * [each.per_si for each in others]
    with tempfile.TemporaryDirectory() as folder, rr.RecordingStream("sigmas") as stream:
        panels = list[rrb.TimeSeriesView]()
        for k, group in enumerate(GROUPS):
            for symbol in group.symbols:
                style = rr.SeriesLines(names=LABELS[symbol], colors=colour_of(symbol), widths=2.0)
                send(stream, f"{k}/{symbol}", np.log10(twelve[:, paper_parameters.SYMBOLS.index(symbol)]), style)
            unit = shown(group.unit)
            panels.append(
                panel(f"{k}", f"σ of {group.title} by orientation: log₁₀ of {unit.label}", len(twelve), legend=True)
            )
        for each, values, colour in zip(others, added.T, ACCELEROMETERS, strict=True):
            style = rr.SeriesLines(names=each.symbol, colors=colour, widths=2.0)
            send(stream, f"added/{each.symbol}", np.log10(values), style)
        name = f"σ of {result.model.effects[0]} by orientation: log₁₀ of {others[0].shown_unit}"
        panels.append(panel("added", name, len(twelve), legend=True))
        take(stream, rrb.Grid(*panels, grid_columns=2), Path(folder, "sigmas.rrd"), png, (1200, 720))


def send(stream: rr.RecordingStream, path: str, values: Floats, style: rr.SeriesLines | rr.SeriesPoints) -> None:
    """Curves (n,) or (n, k) over the count of orientations from 1; rows that are not finite are left out."""
    rows = values.reshape(len(values), -1)
    keep = np.isfinite(rows).all(axis=1)
    columns = rr.Scalars.columns(scalars=rows[keep].ravel()).partition([rows.shape[1]] * int(keep.sum()))
    index = rr.TimeColumn(ORIENTATION, sequence=np.flatnonzero(keep) + 1)
    rr.send_columns(path, [index], columns, recording=stream)
    stream.log(path, style, static=True)


def panel(
    origin: str, name: str, count: int, around: tuple[float, float] | None = None, legend: bool = False
) -> rrb.TimeSeriesView:
    """Curves over a count from 1 to ``count``, none of their points cut by the frame."""
    start, end = (rr.TimeRangeBoundary.absolute(seq=seq) for seq in (0, count + 1))
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=None if around is None else rrb.ScalarAxis(range=around),
    )


def take(stream: rr.RecordingStream, panels: rrb.Container, rrd: Path, png: Path, size: tuple[int, int]) -> None:
    """Save the panels as a recording, draw it, and reduce its colours."""
    hidden = rrb.TimePanel(state="hidden", timeline=ORIENTATION)
    folded = rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"), hidden
    stream.save(rrd, default_blueprint=rrb.Blueprint(panels, *folded))
    stream.flush()
    stream.disconnect()
    screenshot(rrd, png, size)
    Image.open(png).convert("RGB").quantize(PALETTE).save(png, optimize=True)
    print(f"{png.relative_to(ROOT)}: {png.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
