"""Means of dwells over their sigma against a quantity: a chart a channel, one below the other.

Rerun draws curves over a timeline and has no scatter plot, so that these charts have axes of their own in a 2-D view.
A unit of length is about a pixel of a window of 1600 x 1000.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.views.rerun.names import ACCELEROMETERS, CHANNELS, GOLD, GREY, MAUVE, Colour, thin
from kf_calib.views.rerun.spheres import Log

_WIDTH, _HEIGHT, _PITCH = 450.0, 220.0, 300.0
_LEFT, _ABOVE = 50.0, 26.0  # room for the numbers and the title of a chart
_BOUND = 2.0  # sigma at which a level line is drawn


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A chart, the one of a place from the top (0, 1, 2): a quantity across, ratios to sigma from -reach to reach.

    x: the quantity (D,) of each dwell, in the unit in which it is drawn; low, high: its range in all charts.
    """

    place: int
    title: str
    colour: Colour
    x: Floats
    low: float
    high: float
    reach: float

    @property
    def path(self) -> str:
        """Its entity."""
        return f"driver/{CHANNELS[self.place]}"

    @property
    def _ends(self) -> tuple[float, float]:
        """The range, with some room."""
        margin = 0.06 * (self.high - self.low)
        return self.low - margin, self.high + margin

    def at(self, x: Floats, ratios: Floats) -> Floats:
        """Places (n, 2) in the view."""
        low, high = self._ends
        down = self.place * _PITCH + 0.5 * _HEIGHT * (1.0 - np.asarray(ratios) / self.reach)
        return np.column_stack([_WIDTH * (np.asarray(x) - low) / (high - low), down])

    def log_frame(self, log: Log) -> None:
        """Send axes, numbers at them, and lines at 0 and +-2 sigma."""
        ends = np.array(self._ends)
        levels = [self.at(ends, np.full(2, ratio)) for ratio in (-self.reach, -_BOUND, 0.0, _BOUND)]
        upright = self.at(ends[[0, 0]], np.array([-self.reach, self.reach]))
        lines = rr.LineStrips2D([*levels, upright], colors=GREY, radii=[thin(each) for each in (1, 0.4, 0.9, 0.4, 1)])
        log(f"{self.path}/frame", lines)
        across, upward = round_numbers(*self._ends, 8), round_numbers(-self.reach, self.reach, 8)
        places = [*(self.at(np.array([x]), np.array([-self.reach]))[0] + (0.0, 4.0) for x in across),
                  *(self.at(ends[:1], np.array([y]))[0] - (24.0, 9.5) for y in upward),
                  (0.5 * _WIDTH, self.place * _PITCH - _ABOVE)]  # fmt: skip
        texts = [*(f"{value:.6g}".replace("-", "−") for value in (*across, *upward)), self.title]
        colours: list[Colour] = [GREY] * (len(texts) - 1) + [self.colour]
        labels = rr.Points2D(places, labels=texts, colors=colours, radii=0.0, show_labels=True)
        log(f"{self.path}/numbers", labels)

    def points(self, ratios: Floats) -> rr.Points2D:
        """A point (D,) a dwell."""
        radius = thin(3.6 if len(ratios) < 60 else 1.8)
        known = np.isfinite(ratios)
        return rr.Points2D(self.at(self.x[known], ratios[known]), colors=self.colour, radii=radius, draw_order=5.0)


def charts_of(values: Floats, titles: Sequence[str], ratios: Floats) -> list[Chart]:
    """A chart a column of a quantity (D, C), in the unit in which it is drawn, on the same axes, which hold all of
    these ratios (D, C)."""
    reach = 1.08 * max(1.25 * _BOUND, float(np.nanmax(np.abs(ratios))))
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    colours = ACCELEROMETERS if len(titles) == len(ACCELEROMETERS) else [MAUVE] * len(titles)
    return [
        Chart(place=k, title=title, colour=colours[k], x=values[:, k], low=low, high=high, reach=reach)
        for k, title in enumerate(titles)
    ]


def clear(log: Log, places: range) -> None:
    """Take away what charts at these places have shown."""
    for place in places:
        log(f"driver/{CHANNELS[place]}", rr.Clear(recursive=True))


def heading(text: str) -> rr.Points2D:
    """What stands above the charts."""
    place = (0.5 * _WIDTH, -2.4 * _ABOVE)
    return rr.Points2D([place], labels=[text], radii=0.0, colors=GOLD, show_labels=True)


def charts_view(name: str) -> rrb.Spatial2DView:
    """The view that holds the three charts."""
    bounds = rrb.VisualBounds2D(x_range=[-_LEFT, _WIDTH + 20.0], y_range=[-3.0 * _ABOVE, 3.0 * _PITCH - _ABOVE])
    return rrb.Spatial2DView(origin="driver", name=name, visual_bounds=bounds)


def round_numbers(low: float, high: float, at_most: int) -> Floats:
    """Multiples of 1, 2 or 5 times a power of ten between two numbers."""
    decade = 10.0 ** math.floor(math.log10((high - low) / at_most))
    step = next(lead * decade for lead in (1.0, 2.0, 5.0, 10.0) if (high - low) / (lead * decade) <= at_most)
    return step * np.arange(math.ceil(low / step), math.floor(high / step) + 1, dtype=float)
