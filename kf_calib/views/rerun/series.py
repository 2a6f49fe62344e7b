"""What is a curve or a row of points: parameters and their sigmas, innovations, NIS, residuals, gimbal angles.

Rerun draws curves over a timeline, with axes of its own. It has no logarithmic axis: the panels of sigmas, which fall
over decades, end above where they are after a third of the run, and are read in the unit of the parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.filter_history import history_of, nis_band
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Visit
from kf_calib.support import units
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

    def _only(self, rows: NDArray[np.bool_]) -> VisitHistory:
        """Return the same with these rows only."""
        return VisitHistory(self.shown, *(getattr(self, each.name)[rows] for each in fields(self)[1:]))

    def after(self, visits: Sequence[Visit]) -> VisitHistory:
        """What came after these visits; the prior only where there were none."""
        return self._only(self.orientation > (visits[-1].dwell.number if visits else -1))

    @classmethod
    def of(cls, result: Calibration) -> VisitHistory:
        history, shown = history_of(result, within=True), quantities(result.model)
        per_si = np.array([each.per_si for each in shown])
        nominal = np.array([parameter.nominal for parameter in history.parameters])
        whole = np.append(np.diff(history.numbers) > 0, True)
        deviation, sigma = (history.values - nominal) * per_si, history.sigmas * per_si
        return cls(shown, history.elapsed_s, history.numbers, whole, deviation, sigma)


def times(elapsed_s: Floats, orientation: Counts | None = None) -> list[rr.TimeColumn]:
    """Rows on ``bench_time``, and on ``orientation`` where given."""
    nanoseconds = np.round(np.asarray(elapsed_s) * 1e9).astype("timedelta64[ns]")
    bench_time = rr.TimeColumn(BENCH_TIME, duration=nanoseconds)
    return [bench_time] if orientation is None else [bench_time, rr.TimeColumn(ORIENTATION, sequence=orientation)]


def ends(visits: Sequence[Visit]) -> tuple[Floats, Counts]:
    """When each dwell ended, and its number."""
    dwells = [visit.dwell for visit in visits]
    return np.array([dwell.end_s for dwell in dwells]), np.array([dwell.number for dwell in dwells])


def log_parameters(history: VisitHistory, stream: rr.RecordingStream, target: Floats, styled: bool) -> None:
    """Sigma, deviation from nominal, and the deviation less and plus one sigma; ``styled``: how they look was sent.

    target (12,): sigmas that are wanted, in SI, NaN where there is none.
    """
    for k, shown in enumerate(history.shown):
        path, colour, label = shown.path, shown.colour, shown.label
        value, sigma = history.deviation[:, k], history.sigma[:, k]
        _log_curve(stream, f"{path}/sigma", history, sigma)
        _log_curve(stream, f"{path}/deviation", history, value)
        _log_curve(stream, f"{path}/band", history, np.column_stack([value - sigma, value + sigma]))
        if k < len(target) and np.isfinite(target[k]):
            _log_curve(stream, f"{path}/target", history, np.full(len(sigma), target[k] * shown.per_si))
        if styled:
            continue
        named = label if k < 12 else f"{label}, {shown.unit}"
        _style(stream, f"{path}/sigma", rr.SeriesLines(names=named, colors=colour, widths=2.0))
        _style(stream, f"{path}/target", rr.SeriesLines(names=f"target {label}", colors=colour, widths=1.0))
        _style(stream, f"{path}/deviation", rr.SeriesLines(names=label, colors=colour, widths=2.0))
        _style(stream, f"{path}/band", rr.SeriesLines(names=["−σ", "+σ"], colors=[GREY] * 2, widths=[1.0] * 2))


def _log_curve(stream: rr.RecordingStream, path: str, history: VisitHistory, values: Floats) -> None:
    """Complete dwells on both timelines, points within a dwell in bench time only: one point an orientation."""
    whole, elapsed_s = history.whole, history.elapsed_s
    _send(stream, path, elapsed_s[whole], history.orientation[whole], values[whole])
    _send(stream, path, elapsed_s[~whole], None, values[~whole])


def _send(stream: rr.RecordingStream, path: str, elapsed_s: Floats, orientation: Counts | None, values: Floats) -> None:
    """One row of scalars (n,) or (n, k) a time; rows that are not finite are left out."""
    rows = values.reshape(len(elapsed_s), -1) if len(elapsed_s) else np.empty((0, 1))
    keep = np.isfinite(rows).all(axis=1)
    if keep.any():
        columns = rr.Scalars.columns(scalars=rows[keep].ravel()).partition([rows.shape[1]] * int(keep.sum()))
        index = times(elapsed_s[keep], None if orientation is None else orientation[keep])
        rr.send_columns(path, index, columns, recording=stream)


def _style(stream: rr.RecordingStream, path: str, style: rr.SeriesLines | rr.SeriesPoints) -> None:
    stream.log(path, style, static=True)


def log_innovations(visits: Sequence[Visit], stream: rr.RecordingStream, before: int = 0) -> None:
    """Innovation of each dwell and channel with its bounds of 2 sigma, in µg or m/s^2; and in units of its own sigma.

    ``before``: how many dwells were sent before these.
    """
    (elapsed_s, number), count = ends(visits), before + len(visits)
    unit = units.shown("m/s^2")
    innovation = np.array([visit.innovation_mps2 for visit in visits]) * unit.per_si
    sigma = np.array([visit.innovation_sigma_mps2 for visit in visits]) * unit.per_si
    for i, (channel, colour) in enumerate(zip(CHANNELS, ACCELEROMETERS, strict=True)):
        path, bound = f"innovation/{channel}", 2 * sigma[:, i]
        _send(stream, f"{path}/value", elapsed_s, number, innovation[:, i])
        _send(stream, f"{path}/bound", elapsed_s, number, np.column_stack([-bound, bound]))
        _send(stream, f"{path}/in_sigma", elapsed_s, number, innovation[:, i] / sigma[:, i])
        _style(stream, f"{path}/value", _points(channel, colour, count))
        _style(stream, f"{path}/bound", _bounds("−2σ", "+2σ"))
        _style(stream, f"{path}/in_sigma", _points(channel, colour, count))
    known = np.where(np.isfinite(sigma).all(axis=1), 2.0, np.nan)
    _send(stream, "innovation/bound", elapsed_s, number, np.column_stack([-known, known]))
    _style(stream, "innovation/bound", _bounds("−2σ", "+2σ"))


def log_nis(visits: Sequence[Visit], stream: rr.RecordingStream, before: int = 0) -> None:
    """NIS of each dwell that has degrees of freedom, with the middle 95 % of chi-squared; red above it."""
    judged = [visit for visit in visits if visit.dof > 0]
    if not judged:
        return
    elapsed_s, number = ends(judged)
    value = np.array([visit.nis for visit in judged])
    band = nis_band(np.array([visit.dof for visit in judged]))
    high = value > band[:, 1]
    for name, place, colour in (("value", ~high, WHITE), ("above", high, RED)):
        _send(stream, f"nis/{name}", elapsed_s[place], number[place], value[place])
        _style(stream, f"nis/{name}", _points(name, colour, before + len(visits)))
    _send(stream, "nis/band", elapsed_s, number, band)
    _style(stream, "nis/band", _bounds("2.5 %", "97.5 %"))


def predicted(result: Calibration) -> bool:
    """Were most dwells predicted from those before? Panels of innovations and NIS would else stand nearly empty."""
    known = [visit.dof > 0 and bool(np.isfinite(visit.innovation_mps2).all()) for visit in result.visits]
    return 2 * sum(known) >= len(known)


def log_residuals(result: Calibration, stream: rr.RecordingStream) -> None:
    """Residual of each dwell and channel over the sigma of its mean, for runs whose dwells were hardly predicted."""
    elapsed_s, number = ends(result.visits)
    ratios = result.residuals_mps2 / mean_sigmas(result)
    for i, (channel, colour) in enumerate(zip(CHANNELS, ACCELEROMETERS, strict=True)):
        _send(stream, f"residual/{channel}", elapsed_s, number, ratios[:, i])
        _style(stream, f"residual/{channel}", _points(channel, colour, len(ratios)))
    _send(stream, "residual/bound", elapsed_s, number, np.tile([-2.0, 2.0], (len(ratios), 1)))
    _style(stream, "residual/bound", _bounds("−2σ", "+2σ"))


def _points(name: str, colour: Colour, count: int) -> rr.SeriesPoints:
    return rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=3.0 * crowd(count))


def crowd(count: int) -> float:
    """How much smaller marks are drawn where there are many (1 up to a hundred), so that they do not run together."""
    return max(0.4, min(1.0, (100 / count) ** 0.5))


def _bounds(lower: str, upper: str) -> rr.SeriesLines:
    return rr.SeriesLines(names=[lower, upper], colors=[GREY, GREY], widths=[1.0, 1.0])


def log_bench(result: Calibration, stream: rr.RecordingStream, before: int = 0) -> None:
    """The pose of each dwell: gimbal angles in deg, or the quaternion."""
    dwells = [visit.dwell for visit in result.visits[before:]]
    begun = np.array([dwell.start_s for dwell in dwells])
    done, number = ends(result.visits[before:])
    poses = np.array([dwell.recorded_pose for dwell in dwells])
    poses = np.degrees(poses) if result.bench.axes else poses
    for k, (name, angle) in enumerate(zip(pose_names(result), poses.T, strict=True)):
        colour = GIMBALS[k % len(GIMBALS)]
        step = rr.SeriesLines(names=name.replace("_", " "), colors=colour, widths=1.5, interpolation_mode="StepMid")
        _send(stream, f"bench/pose/{name}", done, number, angle)
        _send(stream, f"bench/pose/{name}", begun, None, angle)
        _style(stream, f"bench/pose/{name}", step)


def pose_names(result: Calibration) -> list[str]:
    """Of the gimbals, outer first, with their axes; of the quaternion's parts where there are no gimbals."""
    if not result.bench.axes:
        return ["q_x", "q_y", "q_z", "q_w"]
    axes = result.bench.to_metadata()["axes"].split()
    return [f"{k}_{axis}" for k, axis in enumerate(axes, 1)]
