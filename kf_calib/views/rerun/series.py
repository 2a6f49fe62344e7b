"""What is a curve or a row of points: parameters and their sigmas, innovations, NIS, residuals, gimbal angles.

Rerun draws curves over a timeline, with axes of its own. It has no logarithmic axis: the panels of sigmas, which fall
over decades, end above where they are after a third of the run, and are read in the unit of the parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.filter_history import history_of, nis_band
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Visit
from kf_calib.support import units
from kf_calib.views.notation import gimbal_names
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    BENCH_TIME,
    CHANNELS,
    GIMBALS,
    GREY,
    ORIENTATION,
    RED,
    WHITE,
    Colour,
    DrawnParameter,
    quantities,
)

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class VisitHistory:
    """What is estimated along the run, in shown units: deviation from nominal and sigma (n, 12 + q).

    NaN where not determined. ``shown``: what the columns are, the q coefficients of effects last. ``orientation`` (n,)
    is the number of the dwell, a stated prior has 0; ``whole`` (n,) tells the rows at which a dwell is complete.
    """

    shown: tuple[DrawnParameter, ...]
    elapsed_s: Floats
    orientation: Counts
    whole: NDArray[np.bool_]
    deviation: Floats
    sigma: Floats

    def late_range(self, k: int) -> tuple[float, float] | None:
        """The range of the bands of the run's last two thirds, of one column: the first are a thousand times wider."""
        late = np.isfinite(self.sigma[:, k]) & (self.orientation >= self.orientation[-1] / 3)
        value, sigma = self.deviation[late, k], self.sigma[late, k]
        if not len(value):
            return None
        low, high = float((value - sigma).min()), float((value + sigma).max())
        margin = max(0.1 * (high - low), 1e-9 * max(abs(low), abs(high)), 1e-12)
        return low - margin, high + margin

    def sigma_range(self, columns: Sequence[int]) -> tuple[float, float] | None:
        """From 0 to above the sigmas of these columns in the run's last two thirds, and to a power of ten, the only
        numbers that a low axis has; None where none is determined."""
        late = self.sigma[self.orientation >= self.orientation[-1] / 3][:, list(columns)]
        if not np.isfinite(late).any():
            return None
        top = 1.15 * float(np.nanmax(late))
        power = 10.0 ** np.ceil(np.log10(top))
        return 0.0, float(max(top, 1.05 * power if top > 0.6 * power else 0.0))

    def after(self, visits: Sequence[Visit]) -> VisitHistory:
        """What came after these visits; the prior only where there were none."""
        rows = self.orientation > (visits[-1].dwell.number if visits else -1)
        return VisitHistory(self.shown, *(getattr(self, each.name)[rows] for each in fields(self)[1:]))

    @classmethod
    def of(cls, result: Calibration) -> VisitHistory:
        history, shown = history_of(result, within=True), quantities(result.model)
        per_si = np.array([each.per_si for each in shown])
        nominal = np.array([parameter.nominal for parameter in history.parameters])
        whole = np.append(np.diff(history.numbers) > 0, True)
        deviation, sigma = (history.values - nominal) * per_si, history.sigmas * per_si
        return cls(shown, history.elapsed_s, history.numbers, whole, deviation, sigma)


Timelines = Mapping[str, Floats | Counts]
"""Timelines with when each row is: s on ``bench_time``, else numbers."""


def columns_of(times: Timelines) -> list[rr.TimeColumn]:
    """The same as Rerun takes them."""
    return [
        rr.TimeColumn(name, duration=np.round(when * 1e9).astype("timedelta64[ns]"))
        if name == BENCH_TIME
        else rr.TimeColumn(name, sequence=when)
        for name, when in times.items()
    ]


def ends(visits: Sequence[Visit]) -> dict[str, Floats | Counts]:
    """When each dwell ended, and its number."""
    dwells = [visit.dwell for visit in visits]
    return {BENCH_TIME: np.array([dwell.end_s for dwell in dwells]),
            ORIENTATION: np.array([dwell.number for dwell in dwells])}  # fmt: skip


def begins(visits: Sequence[Visit]) -> dict[str, Floats | Counts]:
    """When each dwell began."""
    return {BENCH_TIME: np.array([visit.dwell.start_s for visit in visits])}


def send_curve(
    stream: rr.RecordingStream, path: str, times: Timelines, values: Floats, *styles: rr.SeriesLines | rr.SeriesPoints
) -> None:
    """Send a row of scalars (n,) or (n, k) a time, and how they look; rows that are not finite are left out."""
    for style in styles:
        stream.log(path, style, static=True)
    rows = values.reshape(len(values), -1) if len(values) else np.empty((0, 1))
    keep = np.isfinite(rows).all(axis=1)
    if keep.any():
        columns = rr.Scalars.columns(scalars=rows[keep].ravel()).partition([rows.shape[1]] * int(keep.sum()))
        kept = {name: when[keep] for name, when in times.items()}
        rr.send_columns(path, columns_of(kept), columns, recording=stream)


def line(name: str, colour: Colour, width: float = 2.0) -> rr.SeriesLines:
    """How a curve looks."""
    return rr.SeriesLines(names=name, colors=colour, widths=width)


def bounds(lower: str, upper: str) -> rr.SeriesLines:
    """How the two ends of a band look."""
    return rr.SeriesLines(names=[lower, upper], colors=[GREY, GREY], widths=[1.0, 1.0])


def log_parameters(history: VisitHistory, stream: rr.RecordingStream, target: Floats, styled: bool) -> None:
    """Sigma, deviation from nominal, and the deviation less and plus one sigma; ``styled``: how they look was sent.

    Complete dwells are on both timelines, points within them in bench time only: one point an orientation. target
    (12,): sigmas that are wanted, in SI, NaN where there is none.
    """
    whole = history.whole
    of_dwells = {BENCH_TIME: history.elapsed_s[whole], ORIENTATION: history.orientation[whole]}
    within = {BENCH_TIME: history.elapsed_s[~whole]}
    for k, shown in enumerate(history.shown):
        value, sigma = history.deviation[:, k], history.sigma[:, k]
        wanted = target[k] * shown.per_si if k < len(target) else np.nan
        named = shown.label if k < len(target) else f"{shown.label}, {shown.unit}"
        for name, values, style in (
            ("sigma", sigma, line(named, shown.colour)),
            ("deviation", value, line(shown.label, shown.colour)),
            ("band", np.column_stack([value - sigma, value + sigma]), bounds("−σ", "+σ")),
            ("target", np.full(len(sigma), wanted), line(f"target {shown.label}", shown.colour, 1.0)),
        ):
            send_curve(stream, f"{shown.path}/{name}", of_dwells, values[whole], *([] if styled else [style]))
            send_curve(stream, f"{shown.path}/{name}", within, values[~whole])


def log_innovations(visits: Sequence[Visit], stream: rr.RecordingStream, before: int = 0) -> None:
    """Innovation of each dwell and channel with its bounds of 2 sigma, in µg or m/s^2; and in units of its own sigma.

    ``before``: how many dwells were sent before these.
    """
    times, count = ends(visits), before + len(visits)
    unit = units.shown("m/s^2")
    innovation = np.array([visit.innovation_mps2 for visit in visits]) * unit.per_si
    sigma = np.array([visit.innovation_sigma_mps2 for visit in visits]) * unit.per_si
    for i, (channel, colour) in enumerate(zip(CHANNELS, ACCELEROMETERS, strict=True)):
        path, bound, points = f"innovation/{channel}", 2 * sigma[:, i], _points(channel, colour, count)
        send_curve(stream, f"{path}/value", times, innovation[:, i], points)
        send_curve(stream, f"{path}/bound", times, np.column_stack([-bound, bound]), bounds("−2σ", "+2σ"))
        send_curve(stream, f"{path}/in_sigma", times, innovation[:, i] / sigma[:, i], points)
    known = np.where(np.isfinite(sigma).all(axis=1), 2.0, np.nan)
    send_curve(stream, "innovation/bound", times, np.column_stack([-known, known]), bounds("−2σ", "+2σ"))


def log_nis(visits: Sequence[Visit], stream: rr.RecordingStream, before: int = 0) -> None:
    """NIS of each dwell that has degrees of freedom, with the middle 95 % of chi-squared; red above it."""
    judged = [visit for visit in visits if visit.dof > 0]
    if not judged:
        return
    times, value = ends(judged), np.array([visit.nis for visit in judged])
    band = nis_band(np.array([visit.dof for visit in judged]))
    high = value > band[:, 1]
    for name, place, colour in (("value", ~high, WHITE), ("above", high, RED)):
        points = _points(name, colour, before + len(visits))
        send_curve(stream, f"nis/{name}", times, np.where(place, value, np.nan), points)
    send_curve(stream, "nis/band", times, band, bounds("2.5 %", "97.5 %"))


def predicted(result: Calibration) -> bool:
    """Were most dwells predicted from those before? Panels of innovations and NIS would else stand nearly empty."""
    known = [visit.dof > 0 and bool(np.isfinite(visit.innovation_mps2).all()) for visit in result.visits]
    return 2 * sum(known) >= len(known)


def log_residuals(result: Calibration, stream: rr.RecordingStream) -> None:
    """Residual of each dwell and channel over the sigma of its mean, for runs whose dwells were hardly predicted."""
    times, ratios = ends(result.visits), result.residuals_mps2 / mean_sigmas(result)
    for i, (channel, colour) in enumerate(zip(CHANNELS, ACCELEROMETERS, strict=True)):
        send_curve(stream, f"residual/{channel}", times, ratios[:, i], _points(channel, colour, len(ratios)))
    level = np.tile([-2.0, 2.0], (len(ratios), 1))
    send_curve(stream, "residual/bound", times, level, bounds("−2σ", "+2σ"))


def _points(name: str, colour: Colour, count: int) -> rr.SeriesPoints:
    return rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=3.0 * crowd(count))


def crowd(count: int) -> float:
    """How much smaller marks are drawn where there are many (1 up to a hundred), so that they do not run together."""
    return max(0.4, min(1.0, (100 / count) ** 0.5))


def log_bench(result: Calibration, stream: rr.RecordingStream, before: int = 0) -> None:
    """The pose of each dwell: gimbal angles in deg, or the quaternion."""
    visits = result.visits[before:]
    poses = np.array([visit.dwell.recorded_pose for visit in visits])
    poses = np.degrees(poses) if result.bench.axes else poses
    names = gimbal_names(result.bench) if result.bench.axes else ["q_x", "q_y", "q_z", "q_w"]
    for k, (name, angle) in enumerate(zip(names, poses.T, strict=True)):
        colour, path = GIMBALS[k % len(GIMBALS)], f"bench/pose/{name}"
        step = rr.SeriesLines(names=name.replace("_", " "), colors=colour, widths=1.5, interpolation_mode="StepMid")
        send_curve(stream, path, ends(visits), angle, step)
        send_curve(stream, path, begins(visits), angle)
