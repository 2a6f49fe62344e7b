"""The Rerun view of an improvement: how the error falls from step to step.

Timeline ``step``: 0 is the first model. Entities: the charts ``errors`` and ``coefficients/NUMBER``;
``explorer/CHANNEL``, residuals against what those of the first model go with; ``spheres``; ``summary``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, SelectionStep
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support import units
from kf_calib.support.plain_text import printable
from kf_calib.views.rerun.chart import LEFT, RIGHT, TOP, Axis, Chart, frames, sheet, thin, write
from kf_calib.views.rerun.explorer import (
    at_step,
    bounds,
    drawn_values,
    forever,
    log_spheres,
    panel,
    points,
    reach_of,
    say,
    spheres,
    title_of,
)
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.names import CHANNELS, GOLD, GREY, MAUVE, RED, WHITE, Colour
from kf_calib.views.rerun.sigmas import ROOM

STEP = "step"
_SMALLEST = 1e-300
_LEVEL = 0.01
_SIZE = (430.0, 210.0)
_TALL = 325.0


@dataclass(frozen=True)
class View:
    """An improvement with what is drawn of it."""

    state: Improvement
    found: tuple[Diagnosis, ...]
    ratios: tuple[Floats, ...]
    drivers: tuple[Driver, ...]

    @classmethod
    def of(cls, state: Improvement) -> View:
        found = (state.start, *(step.found for step in state.steps))
        ratios = tuple(each.before.residuals_mps2 / mean_sigmas(state.start.before) for each in found)
        return cls(state, found, ratios, tuple(state.start.drivers))

    @property
    def results(self) -> list[Calibration]:
        """The calibration of each step."""
        return [each.before for each in self.found]

    @property
    def across(self) -> Axis:
        """The axis of the steps."""
        return Axis.counted(0, max(len(self.found) - 1, 1), "step")

    @property
    def errors(self) -> dict[str, tuple[Floats, Colour]]:
        """Errors by step in um/s^2, NaN where there is none."""
        held = [each.held_out_rms_mps2 for each in self.results]
        floor = [each.held_out_floor_mps2 for each in self.results]
        inside = [each.residual_rms_mps2 for each in self.results]
        return {"held out": (_numbers(held), WHITE), "within the run": (_numbers(inside), MAUVE),
                "noise alone, held out": (_numbers(floor), GREY)}  # fmt: skip

    @property
    def p_values(self) -> Floats:
        """The p-value of each model, not below what is drawn; NaN where there is nothing to judge by."""
        p_values = [np.nan if each.test.p_value is None else each.test.p_value for each in self.found]
        return np.maximum(np.array(p_values), _SMALLEST)

    @property
    def coefficients(self) -> list[tuple[str, list[Parameter | None]]]:
        """Symbol of each coefficient that was ever in the model, and what it is in each step."""
        symbols = dict.fromkeys(symbol for each in self.results for symbol in list(each.parameters)[12:])
        return [(symbol, [each.parameters.get(symbol) for each in self.results]) for symbol in symbols]


def _numbers(values_mps2: Sequence[float | None]) -> Floats:
    return np.array([np.nan if value is None else value * units.shown("m/s^2").per_si for value in values_mps2])


def save(state: Improvement, path: Path) -> Path:
    """Write the view of an improvement to an .rrd file that opens laid out, at the last step."""
    view = View.of(state)
    with rrd_file(path, _layout(view)) as stream:
        _log_errors(view, stream)
        _log_chance(view, stream)
        frames(stream, "coefficients", _coefficient_charts(view))
        for chart, (_, values) in zip(_coefficient_charts(view), view.coefficients, strict=True):
            _log_coefficient(chart, values, stream)
        _log_steps(view, stream)
    return path


def _place(path: str, y: Axis, title: str, row: int, x: Axis) -> Chart:
    """A chart of the left column."""
    return Chart(path, x, y, title, (0.0, row * (_TALL + TOP + ROOM)), _SIZE[0], _TALL)


def _error_chart(view: View) -> Chart:
    values = np.concatenate([own for own, _ in view.errors.values()])
    return _place("errors", Axis.around(values, log=True), f"rms error, {units.shown('m/s^2').label}", 0, view.across)


def _chance_chart(view: View) -> Chart:
    low = np.nanmin(view.p_values, initial=_LEVEL)
    axis = Axis(float(max(low / 10.0, _SMALLEST / 10.0)), 2.0, log=True)
    return _place("errors/p", axis, "p: noise alone would leave as much; accepted above 0.01", 1, view.across)


def _log_errors(view: View, stream: rr.RecordingStream) -> None:
    """Held-out and in-sample error by step, and what noise alone would give."""
    chart, x = _error_chart(view), np.arange(float(len(view.found)))
    frames(stream, "errors", [chart, _chance_chart(view)])
    for k, (name, (values, colour)) in enumerate(view.errors.items()):
        path = f"errors/{name.replace(' ', '_').replace(',', '')}"
        _curve(chart, path, x, values, colour, stream)
        place = chart.corner[0] + chart.width - 90.0, chart.corner[1] + 4.0 + 25.0 * k
        write(stream, f"{path}/name", [(place, f"{name} {values[-1]:.3g}")], colour)
    _log_now(chart, view, stream)


def _log_chance(view: View, stream: rr.RecordingStream) -> None:
    chart, x = _chance_chart(view), np.arange(float(len(view.found)))
    level = rr.LineStrips2D([chart.level(_LEVEL)], colors=RED, radii=thin(0.8))
    stream.log("errors/p/level", level, static=True)
    _curve(chart, "errors/p/value", x, view.p_values, GOLD, stream)
    texts = [(place - np.array([0.0, 26.0 if up else -4.0]), f"p {format_p(each.test.p_value)}")
             for place, each, up in zip(chart.at(x, np.nan_to_num(view.p_values, nan=1.0)), view.found,
                                        view.p_values < 1e-3, strict=True)]  # fmt: skip
    write(stream, "errors/p/told", texts, GOLD)
    _log_now(chart, view, stream)


def _curve(chart: Chart, path: str, x: Floats, y: Floats, colour: Colour, stream: rr.RecordingStream) -> None:
    """Send a curve with its points."""
    stream.log(f"{path}/line", rr.LineStrips2D(chart.strip(x, y), colors=[colour], radii=thin(1.2)), static=True)
    known = np.isfinite(y)
    places = chart.at(x[known], y[known])
    stream.log(f"{path}/points", rr.Points2D(places, colors=colour, radii=thin(4.0)), static=True)


def _log_now(chart: Chart, view: View, stream: rr.RecordingStream) -> None:
    """An upright line at the step of the timeline."""
    for number in range(len(view.found)):
        line = rr.LineStrips2D([chart.upright(float(number))], colors=(*GOLD, 90), radii=thin(1.0))
        at_step(stream, STEP, number)(f"{chart.path}/now", line)


def _coefficient_charts(view: View) -> list[Chart]:
    """A chart of the value and 1 sigma of each coefficient, three a row."""
    out = list[Chart]()
    for k, (symbol, values) in enumerate(view.coefficients):
        row, column = divmod(k, 3)
        known = [each for each in values if each is not None and each.value is not None and each.sigma is not None]
        ends = [(each.value or 0.0) + sign * (each.sigma or 0.0) for each in known for sign in (-1.0, 1.0)]
        own = next(each for each in values if each is not None)
        axis = Axis.around(np.array([0.0, *ends]) * units.shown(own).per_si)
        corner = (column * (300.0 + LEFT + RIGHT), row * (200.0 + TOP + ROOM))
        title = printable(f"{symbol} ± σ, {units.shown(own).label}")
        out.append(Chart(f"coefficients/{k}", view.across, axis, title, corner, 300.0, 200.0))
    return out


def _log_coefficient(chart: Chart, values: list[Parameter | None], stream: rr.RecordingStream) -> None:
    stream.log(f"{chart.path}/zero", rr.LineStrips2D([chart.level(0.0)], colors=GREY, radii=thin(0.8)), static=True)
    known = [(step, each.value, each.sigma, units.shown(each).per_si) for step, each in enumerate(values)
             if each is not None and each.value is not None and each.sigma is not None]  # fmt: skip
    x, value, sigma, per_si = np.array(known, float).reshape(-1, 4).T
    value, sigma = value * per_si, sigma * per_si
    bars = [chart.at(np.array([a, a]), np.array([b - c, b + c])) for a, b, c in zip(x, value, sigma, strict=True)]
    stream.log(f"{chart.path}/sigma", rr.LineStrips2D(bars, colors=[MAUVE] * len(bars), radii=thin(1.2)), static=True)
    points = rr.Points2D(chart.at(x, value), colors=MAUVE, radii=thin(4.0))
    stream.log(f"{chart.path}/value", points, static=True)


def _explorer(view: View) -> list[Chart]:
    """Residuals of each accelerometer, on the same axes in all steps."""
    driver, reach = view.drivers[0], reach_of(view.ratios)
    return [panel(f"explorer/{channel}", drawn_values(driver), title_of(driver) if i == 2 else "", reach,
                  f"accelerometer {i + 1}: residual / σ", (i, 0), _SIZE, i)
            for i, channel in enumerate(CHANNELS)]  # fmt: skip


def _log_steps(view: View, stream: rr.RecordingStream) -> None:
    """Residuals, spheres and words of each step."""
    charts = _explorer(view) if view.drivers else []
    frames(stream, "explorer", charts)
    for chart in charts:
        bounds(chart, forever(stream))
    for i, chart in enumerate(charts):
        first = chart.at(drawn_values(view.drivers[0])[:, i], view.ratios[0][:, i])
        stream.log(f"{chart.path}/first", rr.Points2D(first, colors=GREY, radii=thin(2.2)), static=True)
    if not charts:
        say(stream, "explorer/none", "Nothing that was recorded varies in this run.")
    for number, (result, ratios) in enumerate(zip(view.results, view.ratios, strict=True)):
        log = at_step(stream, STEP, number)
        for i, chart in enumerate(charts):
            points(chart, drawn_values(view.drivers[0])[:, i], ratios[:, i], log, i)
        log_spheres(result, ratios, "spheres", 0, stream, log)
        log("summary", rr.TextDocument(printable(_summary(view, number)), media_type=rr.MediaType.MARKDOWN))


def _summary(view: View, number: int) -> str:
    """What one step did, its model, and in the last one why it ends."""
    found, result = view.found[number], view.results[number]
    blocks = [f"**Step {number}**: {_done(view.state.steps[number - 1])}" if number else "**Step 0**: the first model"]
    blocks.append(f"Model: {result.model.sum}; p {format_p(found.test.p_value)}")
    rows = [
        f"| {symbol} | {_value(each)} | {units.shown(each).label} |"
        for symbol, each in list(result.parameters.items())[12:]
    ]
    if rows:
        blocks.append("\n".join(["| coefficient | value ± σ | |", "|:--|--:|:--|", *rows]))
    if number == len(view.found) - 1:
        blocks.append(f"**It ends here.** {view.state.reason}")
    else:
        blocks.append(found.verdict)
    return "\n\n".join([*blocks, *(view.state.steps[number - 1].remarks if number else ())]) + "\n"


def _done(step: SelectionStep) -> str:
    share = "" if step.probability is None else f", which was missing with {format_probability(step.probability)}"
    added = [f"{step.added} added{share}"] if step.added else []
    return "; ".join([*added, *(f"{each.name} taken out (p {format_p(each.p_value)})" for each in step.dropped)])


def _value(each: Parameter) -> str:
    if each.value is None or each.sigma is None:
        return "not determined"
    unit = units.shown(each)
    return f"{each.value * unit.per_si:.3g} ± {each.sigma * unit.per_si:.2g}"


def _layout(view: View) -> rrb.Blueprint:
    named = view.drivers[0].words if view.drivers else "nothing varies"
    explorer = _explorer(view) if view.drivers else [Chart("explorer", Axis(0.0, 1.0), Axis(0.0, 1.0))]
    first = rrb.Horizontal(
        sheet("errors", "the error by step", [_error_chart(view), _chance_chart(view)]),
        sheet("explorer", f"residuals (grey: first model) against the {named}", explorer),
        rrb.Vertical(spheres("spheres", 1), rrb.TextDocumentView(origin="summary", name="this step"),
                     row_shares=[2, 3]),
        column_shares=[4, 4, 4], name="The error falls" if view.state.steps else "The error of the model",
    )  # fmt: skip
    charts = _coefficient_charts(view)
    tabs = [first, *([sheet("coefficients", "Coefficients", charts)] if charts else [])]
    return rrb.Blueprint(
        rrb.Tabs(*tabs),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="following"),
    )
