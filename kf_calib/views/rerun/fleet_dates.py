"""What a fleet shows by date: control charts, sigmas, verdicts by week, and errors of the bench."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.overview import FleetOverview
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, Finding
from kf_calib.fleet.track import Track
from kf_calib.fleet.weeks import Weeks
from kf_calib.support.plain_text import printable
from kf_calib.support.units import shown
from kf_calib.views.rerun.fleet_thinned import thinned
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    GIMBALS,
    GOLD,
    GREY,
    MAUVE,
    PALE,
    RED,
    WHITE,
    Colour,
    colour_of,
    entity,
    label_of,
)
from kf_calib.views.rerun.series import crowd

DATE = "date"
_COLOURS = (ACCELEROMETERS[0], ACCELEROMETERS[2], MAUVE, GOLD, ACCELEROMETERS[1], *PALE)
_CURVES: dict[str, Colour] = dict(
    zip(("orange", "green", "blue"), ACCELEROMETERS, strict=True), gold=GOLD, mauve=MAUVE, white=WHITE
)
_KNOWN = {"consistent": WHITE, "failed": RED, "not judged": GREY, "inconsistent": GIMBALS[2]}
_TOLD = 8  # verdicts with a curve of their own
_LIMITS = (2.0, 3.0)  # sigma of the scatter

Dates = NDArray[np.datetime64]


@dataclass(frozen=True)
class Panel:
    """The errors of one bench by one effect: from parts of the campaign, and from all of it."""

    term: Finding
    bench: str

    @property
    def path(self) -> str:
        return entity("bench", self.term.effect, self.bench or "the bench")

    @property
    def parts(self) -> list[BenchCoefficients]:
        return [each for each in self.term.over_time if each.bench == self.bench]

    @property
    def whole(self) -> list[BenchCoefficients]:
        return [each for each in self.term.benches if each.bench == self.bench]

    @property
    def title(self) -> str:
        """What it is, its unit, and the colour of each coefficient."""
        own = self.parts[0].coefficients
        named = f"{self.term.effect}, {self.bench or 'the bench'}, {shown(own[0].unit).label}".rstrip(", ")
        colours = [f"{label_of(each.symbol)} {colour}" for each, colour in zip(own, _CURVES, strict=False)]
        return printable(f"{named} (2σ): {', '.join(colours)}")


def panels_of(found: FleetOverview) -> list[Panel]:
    """A panel for each error of a bench whose runs have dates."""
    terms = found.pooled.findings if found.pooled else ()
    panels = [Panel(term, bench) for term in terms for bench in dict.fromkeys(each.bench for each in term.over_time)]
    return [panel for panel in panels if found.last is not None and all(each.since for each in panel.parts)]


def log_bench(panel: Panel, found: FleetOverview, stream: rr.RecordingStream) -> None:
    """Coefficients from all runs as a line, which changes at a repair; those from parts as points with 2 sigma."""
    assert found.last is not None
    begins = [datetime.fromisoformat(each.since or "") for each in panel.parts]
    ends = [*begins[1:], max(found.last, begins[-1])]
    changes = [datetime.fromisoformat(each.since) if each.since else begins[0] for each in panel.whole]
    middles = [begin + 0.5 * (end - begin) for begin, end in zip(begins, ends, strict=True)]
    colours = [*_CURVES.values()]
    for k, each in enumerate(panel.parts[0].coefficients):
        path, colour = f"{panel.path}/{entity(each.symbol)}", colours[k % len(colours)]
        per_si, label = shown(each.unit).per_si, label_of(each.symbol)
        values, reach = _coefficients(panel.parts, k, per_si)
        _style(stream, f"{path}/part", rr.SeriesPoints(names=f"{label} of a part", colors=colour, marker_sizes=4.0))
        _send(stream, f"{path}/part", dates_of(middles), values)
        _style(stream, f"{path}/band", _lines(["−2σ", "+2σ"], (*colour, 110), 0.8, "StepAfter"))
        band = np.column_stack([values - reach, values + reach])
        _send(stream, f"{path}/band", dates_of([*begins, ends[-1]]), np.vstack([band, band[-1:]]))
        _style(stream, f"{path}/all", _lines([label], colour, 2.2, "StepAfter"))
        own = _coefficients(panel.whole, k, per_si)[0]
        _send(stream, f"{path}/all", dates_of([*changes, ends[-1]]), np.append(own, own[-1]))


def _coefficients(parts: Sequence[BenchCoefficients], k: int, per_si: float) -> tuple[Floats, Floats]:
    """Return value and 2 sigma of one coefficient in each part, NaN where its runs do not tell."""
    own = [each.coefficients[k] for each in parts]
    values = np.array([np.nan if each.value is None else each.value for each in own])
    return values * per_si, 2.0 * per_si * np.array([np.nan if each.sigma is None else each.sigma for each in own])


def log_weeks(weeks: Weeks, stream: rr.RecordingStream) -> None:
    """How many runs came to what in each week; verdicts that are rare in one curve."""
    colours, curves = iter(_COLOURS), dict[str, NDArray[np.int64]]()
    for name, counts in weeks.counts.items():
        label = name if len(curves) < _TOLD or name in _KNOWN else "other"
        curves[label] = curves.get(label, np.zeros(len(counts), np.int64)) + np.array(counts)
    begins = [datetime.combine(each, time(), UTC) for each in weeks.begins]
    for label, counts in curves.items():
        path, colour = entity("weeks", label), _KNOWN.get(label) or next(colours, MAUVE)
        _style(stream, path, _lines([printable(label)], colour, 2.0, "StepAfter"))
        ends = dates_of([*begins, begins[-1] + timedelta(weeks=1)])
        _send(stream, path, ends, np.append(counts, counts[-1:]).astype(float))


def log_control(track: Track, stream: rr.RecordingStream) -> None:
    """Each run less the mean of its unit, with its own sigma, and limits from the scatter of all."""
    kept = thinned(track) & np.isfinite(track.deviations) & _dated(track)
    per_si, colour, path = shown(track.unit).per_si, colour_of(track.symbol), entity("control", track.symbol)
    if not kept.any():
        return
    dates, values = _dates(track, kept), track.deviations[kept]
    ends, outside = dates[[0, -1]], np.abs(values) > _LIMITS[1] * track.scatter
    size = 3.5 * crowd(int(kept.sum()))
    for name, place, own in (("run", ~outside, colour), ("outside", outside, RED)):
        _style(stream, f"{path}/{name}", rr.SeriesPoints(names=name, colors=own, markers="circle", marker_sizes=size))
        _send(stream, f"{path}/{name}", dates[place], values[place] * per_si)
    sigmas = track.sigmas[kept] * per_si
    _style(stream, f"{path}/sigma", _lines(["−σ of the run", "+σ of the run"], (*colour, 90), 0.7))
    _send(stream, f"{path}/sigma", dates, np.column_stack([-sigmas, sigmas]))
    levels = np.array([sign * limit for limit in _LIMITS for sign in (-1.0, 1.0)])
    names = [f"{level:+.0f} sigma of the scatter".replace("-", "−") for level in levels]
    _style(stream, f"{path}/limits", _lines(names, [GREY, GREY, RED, RED], 1.0))
    _send(stream, f"{path}/limits", ends, np.array([levels * track.scatter * per_si] * 2))
    _log_scatter(track, stream, dates, values, levels, names)


def _log_scatter(
    track: Track, stream: rr.RecordingStream, dates: Dates, values: Floats, levels: Floats, names: Sequence[str]
) -> None:
    """The same in sigma of the scatter, for a chart of all parameters."""
    if track.scatter:
        path, size = entity("scatter", track.symbol), 3.0 * crowd(len(dates))
        points = rr.SeriesPoints(names=label_of(track.symbol), colors=colour_of(track.symbol), marker_sizes=size)
        _style(stream, path, points)
        _send(stream, path, dates, values / track.scatter)
        _style(stream, "scatter/limits", _lines(names, [GREY, GREY, RED, RED], 1.0))
        _send(stream, "scatter/limits", dates[[0, -1]], np.array([levels] * 2))


def log_sigmas(track: Track, stream: rr.RecordingStream) -> None:
    """The sigma that each run gave, and the one that is wanted."""
    kept = thinned(track) & _dated(track)
    per_si, path = shown(track.unit).per_si, entity("sigma", track.symbol)
    if not kept.any():
        return
    dates, size = _dates(track, kept), 3.5 * crowd(int(kept.sum()))
    points = rr.SeriesPoints(names="σ of a run", colors=colour_of(track.symbol), marker_sizes=size)
    _style(stream, f"{path}/run", points)
    _send(stream, f"{path}/run", dates, track.sigmas[kept] * per_si)
    if track.target is not None:
        _style(stream, f"{path}/target", _lines(["target"], WHITE, 1.5))
        _send(stream, f"{path}/target", dates[[0, -1]], np.full(2, track.target * per_si))


def _dated(track: Track) -> NDArray[np.bool_]:
    return np.array([each is not None for each in track.dates])


def _dates(track: Track, kept: NDArray[np.bool_]) -> Dates:
    return dates_of([each for each, here in zip(track.dates, kept, strict=True) if here and each is not None])


def dates_of(moments: Iterable[datetime]) -> Dates:
    """Moments as Rerun takes them: in UTC."""
    plain = [each.astimezone(UTC).replace(tzinfo=None) if each.tzinfo else each for each in moments]
    return np.array(plain, "datetime64[ns]")


def _send(stream: rr.RecordingStream, path: str, dates: Dates, values: Floats) -> None:
    """One row of scalars (n,) or (n, k) a date; rows that are not finite are left out."""
    rows = values.reshape(len(dates), -1) if len(dates) else np.empty((0, 1))
    keep = np.isfinite(rows).all(axis=1)
    if keep.any():
        columns = rr.Scalars.columns(scalars=rows[keep].ravel()).partition([rows.shape[1]] * int(keep.sum()))
        rr.send_columns(path, [rr.TimeColumn(DATE, timestamp=dates[keep])], columns, recording=stream)


def _style(stream: rr.RecordingStream, path: str, style: rr.SeriesLines | rr.SeriesPoints) -> None:
    stream.log(path, style, static=True)


def _lines(
    names: Sequence[str],
    colours: Sequence[Colour] | tuple[int, ...],
    width: float,
    mode: Literal["Linear", "StepAfter"] = "Linear",
) -> rr.SeriesLines:
    """How as many lines look, in one colour or each in its own."""
    own = list(colours) if isinstance(colours, list) else [colours] * len(names)
    return rr.SeriesLines(names=list(names), colors=own, widths=[width] * len(names), interpolation_mode=mode)
