"""How well each orientation of a run fits: innovations and NIS, or residuals where few dwells were predicted.

Entities: ``fit/{innovation,nis,residual}/{lines,points}``, ``fit/frame`` and ``innovations/{frame,curves}``.
"""

from __future__ import annotations

import numpy as np
import rerun as rr

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.support import units
from kf_calib.views.rerun.chart import TOP, Axis, Chart, Ink, frames, thin
from kf_calib.views.rerun.names import ACCELEROMETERS, CHANNELS, GREY, RED, WHITE
from kf_calib.views.rerun.series import Counts, above, ends, nis_band
from kf_calib.views.rerun.sigmas import ROOM

BOUND = 2.0
_WIDE, _TALL = 560.0, 150.0


def predicted(result: Calibration) -> bool:
    """Were most dwells predicted from those before? Panels of innovations and NIS would else stand nearly empty."""
    known = [visit.dof > 0 and bool(np.isfinite(visit.innovation_mps2).all()) for visit in result.visits]
    return 2 * sum(known) >= len(known)


def ratios(result: Calibration) -> Floats:
    """Innovations (D, 3) over their sigma, NaN where there is none; residuals over that of the means where few are."""
    if not predicted(result):
        return result.residuals_mps2 / mean_sigmas(result)
    return np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in result.visits])


def _judged(result: Calibration) -> tuple[Counts, Floats, Floats]:
    """Return number, NIS and its 95 % band of each dwell that has degrees of freedom."""
    visits = [visit for visit in result.visits if visit.dof > 0]
    return ends(visits)[1], np.array([visit.nis for visit in visits]), nis_band(np.array([v.dof for v in visits]))


def fit_charts(result: Calibration) -> list[Chart]:
    """The charts of a run, one below the other."""
    number, own = ends(result.visits)[1], ratios(result)
    reach = 1.08 * max(1.2 * BOUND, float(np.nanmax(np.abs(own))))
    x = Axis.counted(int(number[0]), int(number[-1]), "orientation")
    y = Axis(-reach, reach)
    if not predicted(result):
        return [Chart("fit/residual", x, y, "residuals over σ", (0.0, 0.0), _WIDE, 2.0 * _TALL)]
    _, nis, band = _judged(result)
    high = 1.1 * max(float(band.max()), float(nis.max()))
    bare = Axis.counted(int(number[0]), int(number[-1]), "")
    title = "NIS, with the middle 95 % of χ²; red: above"
    return [Chart("fit/innovation", bare, y, "innovations over σ", (0.0, 0.0), _WIDE, _TALL),
            Chart("fit/nis", x, Axis(0.0, high), title, (0.0, _TALL + TOP + ROOM), _WIDE, _TALL)]  # fmt: skip


def log_fit(result: Calibration, stream: rr.RecordingStream) -> None:
    """Send the charts; the accelerometers of a dwell stand side by side."""
    charts, number, own = fit_charts(result), ends(result.visits)[1].astype(float), ratios(result)
    frames(stream, "fit", charts)
    first, ink, radius = charts[0], Ink(), thin(3.2 if len(number) < 60 else 1.5)
    ink.lines([first.level(each) for each in (-BOUND, BOUND)], GREY, thin(0.8))
    for i, colour in enumerate(ACCELEROMETERS):
        known = np.isfinite(own[:, i])
        ink.points(first.at(number[known] + 0.15 * (i - 1), own[known, i]), colour, radius)
    ink.send(stream, first.path)
    if len(charts) > 1:
        _log_nis(charts[1], result, radius, stream)
        _log_innovations(result, radius, stream)


def innovation_charts(result: Calibration) -> list[Chart]:
    """Innovations of each accelerometer in um/s^2, on the same axes, which show those after a third of the run."""
    number = ends(result.visits)[1]
    late = [visit for visit in result.visits if visit.dwell.number >= number[-1] / 3]
    bounds = np.array([BOUND * visit.innovation_sigma_mps2 for visit in late])
    largest = float(np.nanmax([np.abs([visit.innovation_mps2 for visit in late]), bounds]))
    reach = 1.08 * units.shown("m/s^2").per_si * largest
    return [
        Chart(f"innovations/{channel}",
              Axis.counted(int(number[0]), int(number[-1]), "orientation" if i == 2 else ""), Axis(-reach, reach),
              f"accelerometer {i + 1}: mean of a dwell less its prediction ± 2σ, {units.shown('m/s^2').label}",
              (0.0, i * (240.0 + TOP + ROOM)), 1300.0, 240.0, ACCELEROMETERS[i])
        for i, channel in enumerate(CHANNELS)
    ]  # fmt: skip


def _log_innovations(result: Calibration, radius: float, stream: rr.RecordingStream) -> None:
    charts, ink, x = innovation_charts(result), Ink(), ends(result.visits)[1].astype(float)
    frames(stream, "innovations", charts)
    for i, chart in enumerate(charts):
        per_si = units.shown("m/s^2").per_si
        value = per_si * np.array([visit.innovation_mps2[i] for visit in result.visits])
        bound = per_si * BOUND * np.array([visit.innovation_sigma_mps2[i] for visit in result.visits])
        for side in (-bound, bound):
            ink.lines(chart.strip(x, side), GREY, thin(0.8))
        known = np.abs(value) <= chart.y.high
        ink.points(chart.at(x[known], value[known]), ACCELEROMETERS[i], radius)
    ink.send(stream, "innovations/curves")


def _log_nis(chart: Chart, result: Calibration, radius: float, stream: rr.RecordingStream) -> None:
    (number, nis, band), ink = _judged(result), Ink()
    x, high = number.astype(float), above(nis, band)
    for side in band.T:
        ink.lines(chart.strip(x, side), GREY, thin(0.8))
    for place, colour in ((~high, WHITE), (high, RED)):
        ink.points(chart.at(x[place], nis[place]), colour, radius)
    ink.send(stream, chart.path)
