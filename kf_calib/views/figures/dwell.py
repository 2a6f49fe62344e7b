"""One dwell reading by reading: readings less what the model says, and their mean with its sigma."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench.streams import Source
from kf_calib.estimation.dwell_readings import DwellReadings, readings_of
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import shown
from kf_calib.views.figures.style import ACCELEROMETERS, BEST, GREY, blank, styled


def dwell(source: Source, result: Calibration, number: int | None = None) -> Figure:
    """Every reading of one dwell less the model's prediction, with their mean and its sigma: the worst dwell, or this.

    source: the recording that was calibrated, which is read once more. Of more than 4000 readings some are drawn.
    """
    with styled():
        figure = blank(11.0, 7.0)
        draw_dwell(figure, readings_of(source, result, number), result.model.sum)
    return figure


def draw_dwell(figure: FigureBase, readings: DwellReadings, model: str) -> None:
    """The same on a part of a figure; model: what the prediction is of, in words."""
    panels = figure.subplots(3, 2, sharex="col", sharey="col", squeeze=False, width_ratios=(2.2, 1.0))
    for i, (wide, narrow) in enumerate(panels):
        _readings(wide, readings, i)
        _mean(narrow, readings, i)
        wide.set_ylabel(f"accelerometer {i + 1}\nreading − model, {shown('m/s^2').label}")
    some = "" if readings.every == 1 else f"; one of {readings.every} readings is drawn"
    panels[0, 0].set_title(f"Dwell {readings.number}, reading by reading, less the model: {model}{some}")
    panels[0, 1].set_title(f"Mean of its {readings.count} readings, ± 1σ and 2σ")
    panels[-1, 0].set_xlabel("time since the first reading of the run, s")
    panels[-1, 1].set_xlabel(f"mean − model, {shown('m/s^2').label}")


def _readings(axes: Axes, readings: DwellReadings, i: int) -> None:
    """Draw the readings of one accelerometer with zero, which is the model, and their mean."""
    per_si = shown("m/s^2").per_si
    axes.plot(readings.time_s, readings.differences_mps2[:, i] * per_si, ".", color=ACCELEROMETERS[i], markersize=2.0,
              alpha=0.55)  # fmt: skip
    axes.axhline(0.0, color=GREY, linewidth=1.0)
    axes.axhline(readings.mean_mps2[i] * per_si, color=BEST, linewidth=1.4, linestyle="--")


def _mean(axes: Axes, readings: DwellReadings, i: int) -> None:
    """Draw the mean of one accelerometer with its sigma on an axis of its own size."""
    unit = shown("m/s^2")
    mean, sigma = readings.mean_mps2[i] * unit.per_si, readings.sigma_mps2[i] * unit.per_si
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.errorbar([mean], [0.0], xerr=[2.0 * sigma], fmt="none", color=ACCELEROMETERS[i], elinewidth=1.0, capsize=4.0)
    axes.errorbar([mean], [0.0], xerr=[sigma], fmt="o", color=ACCELEROMETERS[i], elinewidth=4.0, markersize=8.0)
    times = mean / sigma if sigma > 0.0 else np.nan
    found = f"{mean:+.3g} ± {sigma:.2g} {unit.label}: {times:+.1f} σ"
    axes.annotate(found, (mean, 0.0), (0, 12), textcoords="offset points", ha="center")
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([])
    axes.margins(x=0.35)
