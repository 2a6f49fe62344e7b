"""Each parameter over the units of a fleet: runs, the mean of each unit, the population, and who lies outside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.fleet.overview import FleetOverview
from kf_calib.fleet.track import Track
from kf_calib.support.plain_text import printable
from kf_calib.support.units import shown
from kf_calib.views.fleet_words import short_name
from kf_calib.views.rerun.chart import LEFT, RIGHT, TOP, Axis, Chart, Ink, thin
from kf_calib.views.rerun.fleet_thinned import OUTLIER, thinned, thinned_units
from kf_calib.views.rerun.names import GREY, RED, colour_of, label_of
from kf_calib.views.rerun.series import crowd
from kf_calib.views.rerun.sigmas import ROOM

UNITS = "units"
_WIDE = 4
_SIZE = (300.0, 180.0)
_NAMED = 4  # outliers with a name in a chart


def charts_of(found: FleetOverview) -> list[Chart]:
    """A chart a parameter, in units less its nominal value, on the same axis of units."""
    out = list[Chart]()
    for k, track in enumerate(found.tracks):
        unit = shown(track.unit)
        reach = [track.mean - 2.0 * track.spread, track.mean + 2.0 * track.spread]
        y = Axis.around((np.append(track.values, reach) - track.nominal) * unit.per_si)
        row, column = divmod(k, _WIDE)
        across = Axis.counted(1, max(len(found.units), 2), "unit" if k + _WIDE >= len(found.tracks) else "")
        corner = (column * (_SIZE[0] + LEFT + RIGHT), row * (_SIZE[1] + TOP + ROOM))
        title = printable(f"{label_of(track.symbol)}, {unit.label}".rstrip(", "))
        out.append(Chart(f"{UNITS}/{track.symbol}", across, y, title, corner, *_SIZE, colour_of(track.symbol)))
    return out


def draw(track: Track, names: Sequence[str], chart: Chart, ink: Ink) -> None:
    """Draw one parameter: the band of the population, runs pale, means of units, outliers with a ring and a name."""
    ink.frame(chart)
    per_si, colour, runs = shown(track.unit).per_si, colour_of(track.symbol), thinned(track)
    for spreads, width in ((-2.0, 0.6), (0.0, 1.0), (2.0, 0.6)):
        level = (track.mean + spreads * track.spread - track.nominal) * per_si
        ink.lines([chart.level(float(level))], GREY, thin(width))
    values = (track.values[runs] - track.nominal) * per_si
    pale = thin(2.0 * crowd(int(runs.sum())))
    ink.points(chart.at(track.places[runs].astype(float) + 1.0, values), (*colour, 90), pale)
    means, outside = (track.units - track.nominal) * per_si, track.chances < OUTLIER
    number = np.arange(1.0, len(means) + 1.0)
    inside = thinned_units(track) & ~outside & np.isfinite(means)
    ink.points(chart.at(number[inside], means[inside]), colour, thin(3.0 * crowd(len(means))))
    ink.points(chart.at(number[outside], means[outside]), RED, thin(3.6))
    for k in [int(k) for k in np.argsort(track.chances) if outside[k]][:_NAMED]:
        ink.write(_place(chart, number[k], means[k]), printable(short_name(names[k])), RED)


def _place(chart: Chart, number: float, value: float) -> tuple[float, float]:
    """Return where a name stands: above its point, or below where that is near the top."""
    x, y = chart.at(np.array([number]), np.array([value]))[0].tolist()
    return x, y + 4.0 if y < chart.corner[1] + 0.5 * chart.height else y - 26.0
