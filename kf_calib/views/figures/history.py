"""The calibrations of one block over time: a control chart of each parameter, as the filter sees it."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from kf_calib.exchange.history import History, ParameterTrack
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.figures.style import ACCELEROMETERS, ALARM, BAND, BEST, GREY, MARKERS, PALE, blank, styled

_WIDE = 4
_AHEAD = 0.5  # of the time from the first to the last calibration, if no later date is asked for
_SIGMAS = 2.0


def history(calibrations: History) -> Figure:
    """A panel a parameter: what each calibration found less the last, with its 2 sigma, on the band within which those
    before it predict it; after the last, the band of the parameter in use, its tolerance, and when it may leave it.
    """
    with styled():
        high = -(-len(calibrations.tracks) // _WIDE)
        figure = blank(13.0, 1.2 + 2.2 * high)
        panels = figure.subplots(high, _WIDE, sharex=True, squeeze=False)
        for track, axes in zip(calibrations.tracks, panels.flat, strict=False):
            _chart(axes, calibrations, track)
        for axes in [*panels.flat][len(calibrations.tracks) :]:
            axes.set_axis_off()
        for axes in panels[-1]:
            axes.tick_params(axis="x", labelrotation=0)
        handle_of = dict[str, Any]()
        for axes in panels.flat:
            handles, labels = axes.get_legend_handles_labels()
            handle_of = dict(zip(labels, handles, strict=True)) | handle_of
        figure.legend([*handle_of.values()], [*handle_of], loc="outside lower left", ncols=6)
    return figure


def _chart(axes: Axes, calibrations: History, track: ParameterTrack) -> None:
    """Draw one parameter."""
    unit = shown(track.unit)
    zero, scale = float(track.values[-1]), unit.per_si
    accelerometer = int(track.symbol[-1]) - 1 if track.symbol[-1] in "123" else 0
    dates = date2num(calibrations.dates)
    predicted, reach = (track.predicted - zero) * scale, _SIGMAS * track.predicted_sigma * scale
    known = np.isfinite(predicted)
    axes.errorbar(dates[known], predicted[known], reach[known], fmt="none", ecolor=PALE, elinewidth=7.0,
                  label="predicted by those before (2σ)")  # fmt: skip
    ahead = np.linspace(0.0, _days_ahead(calibrations), 60)
    value, sigma = track.known_after(ahead)
    middle, wide = (value - zero) * scale, _SIGMAS * sigma * scale
    to_come = dates[-1] + ahead
    axes.plot(to_come, middle, color=BEST, linewidth=1.0, label="expected in use")
    axes.fill_between(to_come, middle - wide, middle + wide, color=BAND, linewidth=0.0, label="its 2σ")
    axes.errorbar(dates, (track.values - zero) * scale, _SIGMAS * track.sigmas * scale, fmt=MARKERS[accelerometer],
                  color=ACCELEROMETERS[accelerometer], elinewidth=0.9, label="found (2σ)", zorder=3)  # fmt: skip
    tolerance = calibrations.tolerances.get(track.symbol)
    if tolerance is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * tolerance * scale, color=ALARM, linewidth=0.9, linestyle="--", label="tolerance")
    else:
        axes.axhline(0.0, color=GREY, linewidth=0.7)
    if calibrations.due is not None and calibrations.due_by == track.symbol:
        axes.axvline(float(date2num(calibrations.due)), label="may leave it", color=ALARM, linewidth=1.2)
    axes.set_title(f"{symbol(track.symbol)}, {unit.label} from the last")
    locator = AutoDateLocator(minticks=3, maxticks=5)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))


def _days_ahead(calibrations: History) -> float:
    """Return for how many days after the last calibration the bands are drawn: to the next one, and a little beyond."""
    span = _AHEAD * float(calibrations.days[-1])
    if calibrations.due is None:
        return span
    return max(span, 1.1 * ((calibrations.due - calibrations.dates[-1]) / timedelta(days=1)))
