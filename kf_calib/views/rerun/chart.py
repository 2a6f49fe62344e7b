"""Charts in Rerun's 2-D views, with axes of their own: by orientation or by a quantity of the bench, not by time.

Rerun draws curves over time only, and prints no logarithmic axis. A chart is a frame with ticks, grid and titles, and
places for what is drawn in it. Several charts may stand in one view, which is called a sheet. A unit of length in a
sheet is about a pixel of a window of 1600 x 1000.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.views.rerun.names import GREY, WHITE, Colour

Rgba = tuple[int, ...]
Place = tuple[float, float]
GRID: Colour = (44, 46, 50)
LABEL_HEIGHT = 19.0
"""Of a label, which hangs below its point."""
LEFT, RIGHT, TOP, BOTTOM = 66.0, 16.0, 38.0, 40.0
"""Room around a chart for its ticks and titles."""
_STEPS = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class Axis:
    """The range of an axis, linear or logarithmic, and what is printed at it."""

    low: float
    high: float
    title: str = ""
    log: bool = False
    whole: bool = False  # numbers of orientations or of steps

    @classmethod
    def around(cls, values: Floats, title: str = "", log: bool = False, room: float = 0.06) -> Axis:
        """The axis that holds all values that are finite, with some room beside them."""
        known = values[np.isfinite(values) & ((values > 0.0) | (not log))]
        if not known.size:
            return cls(0.1 if log else -1.0, 1.0, title, log)
        low, high = (math.log10(known.min()), math.log10(known.max())) if log else (known.min(), known.max())
        least = 0.3 if log else 1e-6 * max(abs(low), abs(high), 1e-300)
        spare = max(room * (high - low), 0.5 * (least - (high - low)), 0.0)
        low, high = low - spare, high + spare
        return cls(10.0**low, 10.0**high, title, log) if log else cls(float(low), float(high), title)

    @classmethod
    def counted(cls, first: int, last: int, title: str) -> Axis:
        """The axis of the numbers of orientations or steps."""
        return cls(first - 0.5, last + 0.5, title, whole=True)

    def share(self, values: Floats) -> Floats:
        """How far along the axis values lie, 0 to 1; those beyond it at its ends."""
        values = np.asarray(values, float)
        if self.log:
            low, high = math.log10(self.low), math.log10(self.high)
            values = np.log10(np.maximum(values, 1e-320))
        else:
            low, high = self.low, self.high
        return np.clip((values - low) / (high - low), 0.0, 1.0)

    def ticks(self, at_most: int) -> list[tuple[float, str]]:
        """Round values in the range, and how they are printed."""
        if self.log:
            return [(value, number(value)) for value in self._decades(at_most)]
        values = self._multiples(at_most)
        step = min((b - a for a, b in itertools.pairwise(values)), default=1.0)
        return [(value, number(value, step)) for value in values]

    def _multiples(self, at_most: int) -> list[float]:
        """Return the multiples of a round step in the range."""
        least = (self.high - self.low) / at_most
        decade = 10.0 ** math.floor(math.log10(least))
        step = next(each * decade for each in _STEPS if each * decade >= least * (1 - 1e-9))
        step = max(step, 1.0) if self.whole else step
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [float(f"{k * step:.12g}") for k in range(first, last + 1)]

    def _decades(self, at_most: int) -> list[float]:
        """Return powers of ten in the range, each so many where they are many; with 2 and 5 times them where few."""
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        for lead in ((1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
            values = [each * 10.0**k for k in range(first, last + 1) for each in lead]
            values = [value for value in values if self.low <= value <= self.high]
            if len(values) <= at_most:
                return values
        every = math.ceil((last - first) / at_most)
        return [10.0**k for k in range(first, last + 1) if k % every == 0]


def number(value: float, step: float = 0.0) -> str:
    """A value of a tick: plain digits where they are few, else a power of ten; ``step``: to the next tick."""
    if step >= 1e-4 and abs(value) < 1e7:
        return f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}".replace("-", "−")
    if step:
        return f"{value:.12g}".replace("-", "−")
    if value == 0.0 or 1e-3 <= abs(value) < 1e5:
        return np.format_float_positional(float(f"{value:.3g}"), trim="-").replace("-", "−")
    return ("−" if value < 0.0 else "") + power(abs(value))


def power(factor: float) -> str:
    """``5·10⁴`` for 5e4; factors from 1 to 1000 as they are."""
    if 1 <= factor < 1000:
        return f"{factor:g}"
    exponent = round(math.floor(math.log10(factor) + 1e-9))
    digits = f"10{exponent}".translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))[2:]
    lead = factor / 10.0**exponent
    return f"10{digits}" if round(lead) == 1 else f"{lead:.0f}·10{digits}"


@dataclass(frozen=True)
class Chart:
    """A chart of a sheet: its entity, the corner of its frame, the size of its frame, and its axes."""

    path: str
    x: Axis
    y: Axis
    title: str = ""
    corner: tuple[float, float] = (0.0, 0.0)
    width: float = 520.0
    height: float = 160.0
    colour: Colour = WHITE

    def at(self, x: Floats, y: Floats) -> Floats:
        """Places (n, 2) in the sheet."""
        across = self.corner[0] + self.width * self.x.share(x)
        return np.column_stack([across, self.corner[1] + self.height * (1.0 - self.y.share(y))])

    def strip(self, x: Floats, y: Floats) -> list[Floats]:
        """The places of a curve; in parts where values are not finite, none where there are none."""
        known = np.isfinite(x) & np.isfinite(y)
        parts = np.split(self.at(np.where(known, x, 1.0), np.where(known, y, 1.0)), np.flatnonzero(np.diff(known)) + 1)
        return [part for part, own in zip(parts, np.split(known, np.flatnonzero(np.diff(known)) + 1), strict=True)
                if own[0]]  # fmt: skip

    def level(self, y: float) -> Floats:
        """The ends (2, 2) of a line across the chart."""
        return self.at(np.array([self.x.low, self.x.high]), np.array([y, y]))

    def upright(self, x: float) -> Floats:
        """The ends (2, 2) of a line from the bottom of the chart to its top."""
        return self.at(np.array([x, x]), np.array([self.y.low, self.y.high]))

    def bars(self, x: Floats, y: Floats, foot: float) -> list[Floats]:
        """Upright lines from ``foot`` to each value that is finite."""
        known = np.isfinite(y)
        low = self.at(x[known], np.full(int(known.sum()), foot))
        return [np.array(ends) for ends in zip(low, self.at(x[known], y[known]), strict=True)]


@dataclass
class Ink:
    """What is drawn on the charts of a sheet, gathered so that it is sent as a few entities: each has a cost."""

    strips: list[Floats] = field(default_factory=list[Floats])
    of_strips: list[tuple[Rgba, float]] = field(default_factory=list[tuple[Rgba, float]])
    places: list[Floats] = field(default_factory=list[Floats])
    of_places: list[tuple[Rgba, float]] = field(default_factory=list[tuple[Rgba, float]])
    texts: list[tuple[Place, str, Colour]] = field(default_factory=list[tuple[Place, str, Colour]])

    def lines(self, strips: Sequence[Floats], colour: Rgba, radius: float) -> None:
        """Draw lines through places (n, 2)."""
        self.strips += strips
        self.of_strips += [(colour, radius)] * len(strips)

    def points(self, places: Floats, colour: Rgba, radius: float) -> None:
        """Draw points at places (n, 2)."""
        self.places.append(places)
        self.of_places += [(colour, radius)] * len(places)

    def write(self, place: Place, text: str, colour: Colour) -> None:
        """Write a text, centred below a place."""
        self.texts += [(place, text, colour)] if text else []

    def frame(self, chart: Chart) -> None:
        """Draw frame, grid, ticks and titles of a chart."""
        (left, top), right, bottom = chart.corner, chart.corner[0] + chart.width, chart.corner[1] + chart.height
        across = chart.x.ticks(max(2, int(chart.width / 52)))
        upward = chart.y.ticks(max(2, int(chart.height / 34)))
        self.lines([chart.upright(value) for value, _ in across] + [chart.level(value) for value, _ in upward], GRID,
                   thin(0.4))  # fmt: skip
        self.lines([np.array([[left, top], [left, bottom], [right, bottom]])], GREY, thin(0.4))
        for value, text in across:
            self.write((float(chart.upright(value)[0, 0]), bottom + 4.0), text, GREY)
        for value, text in upward:
            place = left - 14.0 - 4.2 * len(text), float(chart.level(value)[0, 1]) - LABEL_HEIGHT / 2
            self.write(place, text, GREY)
        middle = left + chart.width / 2
        self.write((middle, top - LABEL_HEIGHT - 8.0), chart.title, chart.colour)
        self.write((middle, bottom + LABEL_HEIGHT + 3.0), chart.x.title, GREY)

    def send(self, stream: rr.RecordingStream, path: str, order: float = 0.0) -> None:
        """Send all that was drawn, for all times."""
        if self.strips:
            colours, radii = zip(*self.of_strips, strict=True)
            lines = rr.LineStrips2D(self.strips, colors=colours, radii=radii, draw_order=order)
            stream.log(f"{path}/lines", lines, static=True)
        if self.places:
            colours, radii = zip(*self.of_places, strict=True) if self.of_places else ((), ())
            points = rr.Points2D(np.concatenate(self.places), colors=colours, radii=radii, draw_order=order + 1.0)
            stream.log(f"{path}/points", points, static=True)
        if self.texts:
            places, texts, own = zip(*self.texts, strict=True)
            labels = rr.Points2D(places, labels=texts, colors=own, radii=0.0, show_labels=True)
            stream.log(f"{path}/texts", labels, static=True)


def frames(stream: rr.RecordingStream, path: str, charts: Sequence[Chart]) -> None:
    """Send the frames of all charts of a sheet."""
    ink = Ink()
    for chart in charts:
        ink.frame(chart)
    ink.send(stream, f"{path}/frame", -10.0)


def write(stream: rr.RecordingStream, path: str, texts: Sequence[tuple[object, str]], colour: Colour) -> None:
    """Write texts, each centred below a place; none takes away what was there."""
    points = rr.Points2D(np.array([place for place, _ in texts], float).reshape(-1, 2), radii=0.0, colors=[colour],
                         labels=[text for _, text in texts], show_labels=True)  # fmt: skip
    stream.log(path, points, static=True)


def thin(pixels: float) -> float:
    """A radius in pixels of the screen, whatever the zoom: Rerun takes negative radii for such."""
    return -pixels


def sheet(origin: str, name: str, charts: Sequence[Chart], above: float = 0.0) -> rrb.Spatial2DView:
    """The view of a sheet that holds all charts, with more room above them."""
    left = min(chart.corner[0] for chart in charts) - LEFT
    right = max(chart.corner[0] + chart.width for chart in charts) + RIGHT
    top = min(chart.corner[1] for chart in charts) - TOP - above
    bottom = max(chart.corner[1] + chart.height for chart in charts) + BOTTOM + 18.0
    return rrb.Spatial2DView(
        origin=origin, name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom]),
    )  # fmt: skip
