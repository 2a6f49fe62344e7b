"""The Rerun view of a diagnosis: residuals on spheres, what explanations leave there, and the shape of each.

Timeline ``explanation``: 1 is the best, then the others by rank. Entities: ``spheres/{before,left}``,
``driver/CHANNEL/{frame,numbers,residuals,curve}``, ``summary``. Residuals are over the sigma of the means of dwells.

Rerun draws curves over a timeline and has no scatter plot, so that the charts of the shapes (means of dwells over their
sigma against a quantity, a channel below the other) have axes of their own in a 2-D view. A unit of length is about a
pixel of a window of 1600 x 1000.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import EffectShape
from kf_calib.diagnosis.hypothesis_table import LISTED, HypothesisTable
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.support.text import printable
from kf_calib.views.console import p_cell
from kf_calib.views.diagnosis import advice_sentence, disturbed_dwells, name_of, share_in_words, verdict
from kf_calib.views.markdown import literal, markdown
from kf_calib.views.notation import unit_across
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    CHANNELS,
    DARK,
    GOLD,
    GREY,
    MAUVE,
    Colour,
    markdown_page,
    rrd_file,
    thin,
    window,
)
from kf_calib.views.rerun.spheres import Log, at_step, forever, log_key, log_spheres, spheres
from kf_calib.views.terminal import ConsoleTable, table

EXPLANATION = "explanation"
_MOST = 5  # explanations


def save_diagnosis_view(diagnosis: Diagnosis, path: str | Path) -> Path:
    """Write the view of a diagnosis to an .rrd file that opens laid out, at the best explanation."""
    before, explanations = diagnosis.before, diagnosis.explanations[:_MOST]
    ratios = before.residuals_mps2 / mean_sigmas(before)
    with rrd_file(Path(path), _layout(diagnosis)) as stream:
        log_spheres(before, ratios, "spheres/before", 0, stream, forever(stream), disturbed_dwells(diagnosis))
        log_key("spheres", ["as measured", *(["left over"] if explanations else [])], forever(stream))
        if diagnosis.drivers and not explanations:
            _log_residuals(diagnosis.drivers[0], ratios, forever(stream))
        for rank, explanation in enumerate(explanations, 1):
            log = at_step(stream, EXPLANATION, rank)
            for shape in explanation.shapes[:1]:
                _log_shape(shape, log)
            log_spheres(before, explanation.unexplained_ratios, "spheres/left", 1, stream, log)
        stream.log("summary", markdown_page(_summary(diagnosis)), static=True)
    return Path(path)


def _log_residuals(driver: Driver, ratios: Floats, log: Log) -> None:
    """Send the residuals over their sigma against the quantity that they go with most."""
    unit = unit_across(driver)
    titles = [f"accelerometer {i}: residual / σ" for i in (1, 2, 3)]
    for k, chart in enumerate(charts_of(driver.values * unit.per_si, titles, ratios)):
        chart.log_frame(log)
        log(f"{chart.path}/residuals", chart.points(ratios[:, k]))
    log("driver/heading", heading(printable(f"residuals against the {driver.words}, {unit.label}")))


def _log_shape(shape: EffectShape, log: Log) -> None:
    """Send what an effect must explain of the readings, and what it adds as a curve with its 1 sigma.

    Where it does not go with its quantity alone there is a dash a dwell instead of the curve.
    """
    unit = unit_across(shape)
    ratios = shape.readings / shape.sigma
    charts = charts_of(shape.values * unit.per_si, [f"{channel}, σ" for channel in shape.channels], ratios)
    for channel in CHANNELS[len(charts) :]:  # of what was shown before
        log(f"driver/{channel}", rr.Clear(recursive=True))
    for k, chart in enumerate(charts):
        chart.log_frame(log)
        log(f"{chart.path}/residuals", chart.points(ratios[:, k]))
        log(f"{chart.path}/curve", _curve(shape, chart, unit.per_si))
    said = f"{shape.effect}, against {shape.words}, {unit.label}"
    log("driver/heading", heading(printable(said)))


def _curve(shape: EffectShape, chart: Chart, per_si: float) -> rr.LineStrips2D:
    """Return what an effect adds: a curve, and the same less and plus 1 sigma; or a dash a dwell."""
    k = chart.place
    sigma = float(np.nanmedian(shape.sigma[:, k]))
    if shape.is_curve:
        at, middle, spread = shape.curve(k)
        strips = [chart.at(at * per_si, line / sigma) for line in (middle, middle - spread, middle + spread)]
        radii = [thin(1.4), thin(0.5), thin(0.5)]
    else:
        places = chart.at(chart.x, shape.component[:, k] / shape.sigma[:, k])
        strips = [place + np.array([[-6.0, 0.0], [6.0, 0.0]]) for place in places if np.isfinite(place).all()]
        radii = [thin(1.1)] * len(strips)
    return rr.LineStrips2D(strips, colors=[GOLD] * len(strips), radii=radii)


def _summary(diagnosis: Diagnosis) -> str:
    """The verdict, the next orientation, the explanations by rank, and the quantities by what they explain."""
    blocks = [f"**{literal(verdict(diagnosis))}**"]
    if diagnosis.table is not None:
        blocks.append(markdown(_probabilities(diagnosis.table)))
    if diagnosis.next_orientation is not None:
        head, _, advice = advice_sentence(*diagnosis.next_orientation).partition(":")
        blocks.append(f"**{head}**:{advice}")
    if explanations := diagnosis.explanations[:_MOST]:
        rows = [
            (f"{k} {each.name}", "yes" if each.fits else "no", p_cell(each.after.consistency.p_value))
            for k, each in enumerate(explanations, 1)
        ]
        blocks.append(markdown(table("", ("explanation", "fits", "p with it"), rows)))
        blocks.append("Move the cursor of the timeline *explanation* to see what each leaves.")
    if diagnosis.drivers:
        shares = [(each.words, share_in_words(each)) for each in diagnosis.drivers]
        blocks.append(markdown(table("", ("quantity", "goes with"), shares)))
    return "\n\n".join(blocks) + "\n"


def _probabilities(hypotheses: HypothesisTable) -> ConsoleTable:
    """Families and explanations with their probabilities, the likeliest first, without the unlikely."""
    families = [(format_probability(share), name) for name, share in hypotheses.families.items() if share >= LISTED]
    explanations = [(format_probability(row.probability), name_of(row)) for row in hypotheses.listed]
    return table("", (">probability", "it may be"), [*families, ("", ""), *explanations])


def _layout(diagnosis: Diagnosis) -> rrb.Blueprint:
    name = "what the effect must explain" if diagnosis.explanations else "what residuals go with"
    bounds = rrb.VisualBounds2D(x_range=[-_LEFT, _WIDTH + 20.0], y_range=[-3.0 * _ABOVE, 3.0 * _PITCH - _ABOVE])
    view = rrb.Spatial2DView(origin="driver", name=name, visual_bounds=bounds, background=DARK)
    charts = [view] if diagnosis.drivers else []
    beside = rrb.Horizontal(
        spheres("spheres", 2 if diagnosis.explanations else 1),
        *charts,
        rrb.TextDocumentView(origin="summary", name="verdict"),
        column_shares=[5, *(4.4 for _ in charts), 3.8],
    )
    return window(beside, EXPLANATION, "paused")


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


def heading(text: str) -> rr.Points2D:
    """What stands above the charts."""
    place = (0.5 * _WIDTH, -2.4 * _ABOVE)
    return rr.Points2D([place], labels=[text], radii=0.0, colors=GOLD, show_labels=True)


def round_numbers(low: float, high: float, at_most: int) -> Floats:
    """Multiples of 1, 2 or 5 times a power of ten between two numbers."""
    decade = 10.0 ** math.floor(math.log10((high - low) / at_most))
    step = next(lead * decade for lead in (1.0, 2.0, 5.0, 10.0) if (high - low) / (lead * decade) <= at_most)
    return step * np.arange(math.ceil(low / step), math.floor(high / step) + 1, dtype=float)
