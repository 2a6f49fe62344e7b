"""Residuals over their sigma against the quantity that they go with: a chart an accelerometer, one below the other.

Rerun draws curves over a timeline and has no scatter plot, so that these charts have axes of their own in a 2-D view.
A unit of length is about a pixel of a window of 1600 x 1000.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.support.units import Unit, shown_whole
from kf_calib.views.rerun.names import ACCELEROMETERS, CHANNELS, GOLD, GREY, Colour, thin

_WIDTH, _HEIGHT, _PITCH = 450.0, 220.0, 300.0
_LEFT, _ABOVE = 50.0, 26.0  # room for the numbers and the title of a chart
_BOUND = 2.0  # sigma at which a level line is drawn


def unit_of(driver: Driver) -> Unit:
    """The unit in which a driver is drawn."""
    return shown_whole(driver.unit, float(np.abs(driver.values).max()))


@dataclass(frozen=True)
class DriverChart:
    """The chart of one accelerometer: ``driver`` across, ratios of residuals to their sigma from -reach to reach."""

    driver: Driver
    accelerometer: int
    reach: float

    @property
    def path(self) -> str:
        """Its entity."""
        return f"driver/{CHANNELS[self.accelerometer]}"

    @property
    def x(self) -> Floats:
        """The driver (D,) of each dwell, in the unit in which it is drawn."""
        return self.driver.values[:, self.accelerometer] * unit_of(self.driver).per_si

    @property
    def _ends(self) -> tuple[float, float]:
        """The range of all accelerometers, with some room."""
        values = self.driver.values * unit_of(self.driver).per_si
        margin = 0.06 * float(np.ptp(values))
        return float(values.min()) - margin, float(values.max()) + margin

    def at(self, x: Floats, ratios: Floats) -> Floats:
        """Places (n, 2) in the view."""
        low, high = self._ends
        down = self.accelerometer * _PITCH + 0.5 * _HEIGHT * (1.0 - np.asarray(ratios) / self.reach)
        return np.column_stack([_WIDTH * (np.asarray(x) - low) / (high - low), down])

    def log_frame(self, stream: rr.RecordingStream) -> None:
        """Send axes, numbers at them, and lines at 0 and +-2 sigma, for all times."""
        ends = np.array(self._ends)
        levels = [self.at(ends, np.full(2, ratio)) for ratio in (-self.reach, -_BOUND, 0.0, _BOUND)]
        upright = self.at(ends[[0, 0]], np.array([-self.reach, self.reach]))
        lines = rr.LineStrips2D([*levels, upright], colors=GREY, radii=[thin(each) for each in (1, 0.4, 0.9, 0.4, 1)])
        stream.log(f"{self.path}/frame", lines, static=True)
        across, upward = round_numbers(*self._ends, 8), round_numbers(-self.reach, self.reach, 8)
        places = [*(self.at(np.array([x]), np.array([-self.reach]))[0] + (0.0, 4.0) for x in across),
                  *(self.at(ends[:1], np.array([y]))[0] - (24.0, 9.5) for y in upward),
                  (0.5 * _WIDTH, self.accelerometer * _PITCH - _ABOVE)]  # fmt: skip
        title = f"accelerometer {self.accelerometer + 1}: residual / σ"
        texts = [*(f"{value:.6g}".replace("-", "−") for value in (*across, *upward)), title]
        colours: list[Colour] = [GREY] * (len(texts) - 1) + [ACCELEROMETERS[self.accelerometer]]
        labels = rr.Points2D(places, labels=texts, colors=colours, radii=0.0, show_labels=True)
        stream.log(f"{self.path}/numbers", labels, static=True)

    def points(self, ratios: Floats) -> rr.Points2D:
        """A point (D,) a dwell."""
        radius = thin(3.6 if len(ratios) < 60 else 1.8)
        return rr.Points2D(
            self.at(self.x, ratios), colors=ACCELEROMETERS[self.accelerometer], radii=radius, draw_order=5.0
        )


def charts_of(driver: Driver, ratios: list[Floats]) -> list[DriverChart]:
    """A chart an accelerometer, on the same axes, which hold all of these ratios."""
    reach = 1.08 * max(1.25 * _BOUND, *(float(np.abs(each).max()) for each in ratios))
    return [DriverChart(driver, i, reach) for i in range(3)]


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
