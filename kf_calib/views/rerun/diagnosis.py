"""The Rerun view of a diagnosis: what the residuals go with, what explanations predict of them, and what is left.

Timeline ``explanation``: 1 is the best, then the others by rank. Entities: ``explorer/{before,effect,left}/CHANNEL``,
``drivers/SYMBOL/{0,1}``, ``spheres/{before,left}``, ``summary``. Residuals are over the sigma of the means of dwells.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.hypothesis_table import TOLD, Table
from kf_calib.diagnosis.residual_drivers import Driver, is_function_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import format_p
from kf_calib.support.plain_text import printable
from kf_calib.views.diagnosis import name_of, verdict
from kf_calib.views.rerun.chart import Axis, Chart, frames, sheet, thin, write
from kf_calib.views.rerun.explorer import (
    Log,
    at_step,
    bounds,
    drawn_values,
    driver_charts,
    forever,
    log_spheres,
    of_share,
    panel,
    points,
    reach_of,
    say,
    spheres,
    title_of,
)
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.names import CHANNELS, GOLD, MAUVE, WHITE

EXPLANATION = "explanation"
_MOST = 5  # explanations
_DRIVERS = 8
_SIZE = (236.0, 210.0)


class View:
    """A diagnosis with what is drawn of it, computed once."""

    def __init__(self, found: Diagnosis) -> None:
        self.found, self.drivers = found, found.drivers
        self.explanations = found.explanations[:_MOST]
        self.sigmas = mean_sigmas(found.before)

    @cached_property
    def before(self) -> Floats:
        """Residuals (D, 3) over their sigma."""
        return self.found.before.residuals_mps2 / self.sigmas

    def effect(self, each: Explanation) -> Floats:
        """What an explanation adds to the readings, and the readings less all else (2, D, 3), over sigma."""
        own = each.contribution_mps2
        return np.array([own, own + each.left_mps2]) / self.sigmas

    def charts(self, driver: Driver) -> dict[str, list[Chart]]:
        """The charts of the explorer by column, an accelerometer a row."""
        reach = reach_of([self.before, *(each.left_ratios for each in self.explanations)])
        wide = reach_of([self.effect(each) for each in self.explanations] or [self.before])
        columns = ["before", *(["effect", "left"] if self.explanations else [])]
        size = _SIZE if self.explanations else (760.0, 210.0)
        out = dict[str, list[Chart]]()
        for column, name in enumerate(columns):
            out[name] = []
            for i, channel in enumerate(CHANNELS):
                title = f"accelerometer {i + 1}: residual / σ" if name == "before" else ""
                below, own = title_of(driver) if i == 2 else "", wide if name == "effect" else reach
                path, place = f"explorer/{name}/{channel}", (i, column)
                out[name].append(panel(path, drawn_values(driver), below, own, title, place, size, i))
        return out


def save(found: Diagnosis, path: Path) -> Path:
    """Write the view of a diagnosis to an .rrd file that opens laid out, at the best explanation."""
    view = View(found)
    with rrd_file(path, _layout(view)) as stream:
        _log_explorer(view, stream)
        _log_drivers(view, stream)
        log_spheres(found.before, view.before, "spheres/before", 0, stream, forever(stream))
        for rank, each in _ranked(view):
            log_spheres(found.before, each.left_ratios, "spheres/left", 1, stream, at_step(stream, EXPLANATION, rank))
        text = rr.TextDocument(printable(_summary(view)), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", text, static=True)
    return path


def _ranked(view: View) -> list[tuple[int, Explanation]]:
    """Return the explanations with their ranks."""
    return list(enumerate(view.explanations, 1))


def _log_explorer(view: View, stream: rr.RecordingStream) -> None:
    """Residuals with what the best explanation and the runner-up predict of them; the effect itself; what it leaves."""
    if not view.drivers:
        return say(stream, "explorer/none", "Nothing that was recorded varies in this run.")
    driver = view.drivers[0]
    charts, x, standing = view.charts(driver), drawn_values(driver), forever(stream)
    everything = [each for column in charts.values() for each in column]
    frames(stream, "explorer", everything)
    for chart in everything:
        bounds(chart, standing)
    for i, chart in enumerate(charts["before"]):
        points(chart, x[:, i], view.before[:, i], standing, i)
        for name, each, colour in zip(("best", "second"), view.explanations, (WHITE, MAUVE), strict=False):
            _dashes(chart, name, x[:, i], (each.predicted_mps2 / view.sigmas)[:, i], standing, colour)
    for rank, each in _ranked(view):
        _log_explanation(view, charts, driver, each, at_step(stream, EXPLANATION, rank))
    for k, (each, colour) in enumerate(zip(view.explanations, (WHITE, MAUVE), strict=False)):
        place = charts["before"][0].corner[0] + 0.5 * _SIZE[0], -52.0 - 26.0 * k
        write(stream, f"explorer/legend/{k}", [(place, printable(f"dashes: predicted by {each.name}"))], colour)


def _log_explanation(view: View, charts: dict[str, list[Chart]], driver: Driver, each: Explanation, log: Log) -> None:
    """One explanation: the effect as a curve with its 1 sigma where it goes with this driver alone, and the rest."""
    x, (own, readings) = drawn_values(driver), view.effect(each)
    spread = each.contribution_sigma_mps2 / view.sigmas
    alone = is_function_of(each.contribution_mps2, driver)
    for i, (effect, left) in enumerate(zip(charts["effect"], charts["left"], strict=True)):
        points(effect, x[:, i], readings[:, i], log, i)
        points(left, x[:, i], each.left_ratios[:, i], log, i)
        order = np.argsort(x[:, i])
        lines = [own[:, i], own[:, i] - spread[:, i], own[:, i] + spread[:, i]]
        strips = [effect.at(x[order, i], line[order]) for line in lines] if alone else []
        radii = [thin(1.4), thin(0.5), thin(0.5)][: len(strips)]
        log(f"{effect.path}/curve", rr.LineStrips2D(strips, colors=[GOLD] * len(strips), radii=radii))
        _dashes(effect, "dashes", x[:, i], own[:, i] if not alone else np.full(len(x), np.nan), log, GOLD)
    words = [f"readings less all but {each.name}", f"what {each.name} leaves"]
    places = [(own[0].corner[0] + 0.5 * own[0].width, -27.0) for own in (charts["effect"], charts["left"])]
    titles = rr.Points2D(places, labels=[printable(text) for text in words], radii=0.0, colors=GOLD, show_labels=True)
    log("explorer/titles", titles)


def _dashes(chart: Chart, name: str, x: Floats, y: Floats, log: Log, colour: tuple[int, int, int]) -> None:
    """Send a short level line at each value that is finite."""
    middle = chart.at(x, np.nan_to_num(y))[np.isfinite(y)]
    strips = [place + np.array([[-6.0, 0.0], [6.0, 0.0]]) for place in middle]
    log(f"{chart.path}/{name}", rr.LineStrips2D(strips, colors=[colour] * len(strips), radii=thin(1.1)))


def _log_drivers(view: View, stream: rr.RecordingStream) -> None:
    """Residuals of all accelerometers against everything that varies, and below what an explanation leaves."""
    drivers = view.drivers[:_DRIVERS]
    frames(stream, "drivers", [chart for charts in _driver_charts(view) for chart in charts])
    for driver, charts in zip(drivers, _driver_charts(view), strict=True):
        for chart in charts:
            bounds(chart, forever(stream))
        points(charts[0], drawn_values(driver), view.before, forever(stream))
        for rank, each in _ranked(view):
            points(charts[1], drawn_values(driver), each.left_ratios, at_step(stream, EXPLANATION, rank))


def _driver_charts(view: View) -> list[list[Chart]]:
    reach = reach_of([view.before, *(each.left_ratios for each in view.explanations)])
    return driver_charts(view.drivers[:_DRIVERS], reach, 2 if view.explanations else 1)


def _summary(view: View) -> str:
    """The verdict, the next orientation, the explanations by rank, and the quantities by what they explain."""
    found = view.found
    blocks = [f"**{verdict(found)}**"]
    if found.table is not None:
        blocks.append(_probabilities(found.table))
    if found.next_orientation is not None:
        advice, why = found.next_orientation
        angles = ", ".join(f"{angle:.4g}" for angle in advice.gimbal_deg)
        blocks.append(f"**Next orientation**: gimbals at {angles} deg: {why}.")
    if view.explanations:
        rows = [
            f"| {rank} | {each.name} | {'yes' if each.fits else 'no'} | {_p(each)} |" for rank, each in _ranked(view)
        ]
        blocks.append("\n".join(["| explanation | adds | fits | p of the model with it |", "|:--|:--|:--|:--|", *rows]))
        blocks.append("Move the cursor of the timeline *explanation* to see what each leaves.")
    if view.drivers:
        rows = [f"| {each.words} | {of_share(each)} | p {format_p(each.p_value)} |" for each in view.drivers]
        blocks.append("\n".join(["| quantity | goes with | |", "|:--|:--|:--|", *rows]))
    return "\n\n".join(blocks) + "\n"


def _probabilities(table: Table) -> str:
    """Families and explanations with their probabilities, the likeliest first, without the unlikely."""
    families = [(name, share) for name, share in table.families.items() if share >= TOLD]
    rows = [*families, ("", None), *((name_of(row), row.probability) for row in table.told)]
    lines = ["| | |" if share is None else f"| {name} | {format_probability(share)} |" for name, share in rows]
    return "\n".join(["| it may be | probability |", "|:--|--:|", *lines])


def _p(each: Explanation) -> str:
    return format_p(each.after.consistency.p_value).removeprefix("= ")


def _layout(view: View) -> rrb.Blueprint:
    charts = [chart for column in view.charts(view.drivers[0]).values() for chart in column] if view.drivers else [
        Chart("explorer", Axis(0.0, 1.0), Axis(0.0, 1.0))]  # fmt: skip
    drivers = [chart for column in _driver_charts(view) for chart in column]
    named = view.drivers[0].words if view.drivers else "nothing varies"
    fails = view.found.test.consistent is False
    first = rrb.Horizontal(
        sheet("explorer", f"{view.found.before.model.sum}: residuals over σ against the {named}", charts, above=64.0),
        rrb.Vertical(spheres("spheres", 2 if view.explanations else 1),
                     rrb.TextDocumentView(origin="summary", name="verdict"), row_shares=[5, 5]),
        column_shares=[6, 4], name="Where the model fails" if fails else "What the model leaves",
    )  # fmt: skip
    tabs: Sequence[rrb.View | rrb.Container] = [first]
    tabs = [*tabs, sheet("drivers", "All that varies", drivers)] if drivers else tabs
    return rrb.Blueprint(
        rrb.Tabs(*tabs),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=EXPLANATION, play_state="paused"),
    )
