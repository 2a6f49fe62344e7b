"""The Rerun view of an improvement: how the error falls from step to step.

Timeline ``step``: 0 is the first model. Entities: ``error/{held_out,within_run,noise_alone}`` (rms of residuals),
``log10_p/{model,accepted}``, ``coefficients/SYMBOL/{value,band}``, ``spheres``, ``summary``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, SelectionStep
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support import units
from kf_calib.support.text import printable
from kf_calib.views.console import effect_table
from kf_calib.views.diagnosis import disturbed_dwells
from kf_calib.views.markdown import markdown
from kf_calib.views.rerun.names import (
    GOLD,
    GREY,
    MAUVE,
    RED,
    WHITE,
    Colour,
    curves_panel,
    entity,
    markdown_page,
    rrd_file,
    window,
)
from kf_calib.views.rerun.series import Timelines, bounds, line, send_curve
from kf_calib.views.rerun.spheres import at_step, forever, log_key, log_spheres, spheres

STEP = "step"
_SMALLEST = 1e-300
_LEVEL = 0.01  # p-value above which a model is accepted


@dataclass(frozen=True)
class View:
    """An improvement with what is drawn of it, a row a step."""

    improvement: Improvement

    @property
    def diagnoses(self) -> list[Diagnosis]:
        """The diagnosis of the model of each step."""
        return [self.improvement.start, *(step.diagnosis for step in self.improvement.steps)]

    @property
    def results(self) -> list[Calibration]:
        """The calibration of each step."""
        return [diagnosis.before for diagnosis in self.diagnoses]

    @property
    def errors(self) -> dict[str, tuple[str, Floats, Colour]]:
        """Name and rms error by step in the unit shown, NaN where there is none, by entity."""
        every = self.results
        return {
            "held_out": ("held out", _shown([each.held_out_rms_mps2 for each in every]), WHITE),
            "within_run": ("within the run", _shown([each.residual_rms_mps2 for each in every]), MAUVE),
            "noise_alone": ("noise alone, held out", _shown([self.improvement.floor_mps2] * len(every)), GREY),
        }

    @property
    def log10_p(self) -> Floats:
        """Logarithm of the p-value of each model, at least -300; NaN where there is nothing to judge by."""
        p_values = [np.nan if each.test.p_value is None else each.test.p_value for each in self.diagnoses]
        return np.log10(np.maximum(np.array(p_values), _SMALLEST))

    @property
    def coefficients(self) -> dict[str, list[Parameter | None]]:
        """What each coefficient that was ever in the model is in each step, by symbol."""
        symbols = dict.fromkeys(symbol for each in self.results for symbol in list(each.parameters)[12:])
        return {symbol: [each.parameters.get(symbol) for each in self.results] for symbol in symbols}


def _shown(values_mps2: Sequence[float | None]) -> Floats:
    return units.shown("m/s^2").per_si * np.array([np.nan if each is None else each for each in values_mps2])


def save_improvement_view(improvement: Improvement, path: str | Path) -> Path:
    """Write the view of an improvement to an .rrd file that opens laid out."""
    view = View(improvement)
    times = {STEP: np.arange(len(view.results))}
    with rrd_file(Path(path), _layout(view)) as stream:
        for name, (words, values, colour) in view.errors.items():
            send_curve(stream, f"error/{name}", times, values, *_line_and_marks(words, colour))
        send_curve(stream, "log10_p/model", times, view.log10_p, *_line_and_marks("model", GOLD))
        level = np.full(len(view.log10_p), np.log10(_LEVEL))
        send_curve(stream, "log10_p/accepted", times, level, line("accepted above", RED, 1.0))
        for symbol, values in view.coefficients.items():
            _log_coefficient(stream, entity("coefficients", symbol), times, values)
        sigmas = mean_sigmas(improvement.start.before)
        log_key("spheres", ["in this step"], forever(stream))
        for step, result in enumerate(view.results):
            log = at_step(stream, STEP, step)
            marked = disturbed_dwells(view.diagnoses[step])
            log_spheres(result, result.residuals_mps2 / sigmas, "spheres", 0, stream, log, marked)
            log("summary", markdown_page(_summary(view, step)))
    return Path(path)


def _line_and_marks(name: str, colour: Colour) -> tuple[rr.SeriesLines, rr.SeriesPoints]:
    return line(name, colour), rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=4.0)


def _log_coefficient(
    stream: rr.RecordingStream, path: str, steps: Timelines, values: Sequence[Parameter | None]
) -> None:
    """Send what a coefficient is in each step that has it, less and plus its sigma."""
    known = [
        np.array([parameter.value, parameter.sigma]) * units.shown(parameter).per_si
        if parameter is not None and parameter.value is not None and parameter.sigma is not None
        else np.full(2, np.nan)
        for parameter in values
    ]
    value, sigma = np.array(known).T
    send_curve(stream, f"{path}/value", steps, value, *_line_and_marks("value", MAUVE))
    send_curve(stream, f"{path}/band", steps, np.column_stack([value - sigma, value + sigma]), bounds("−σ", "+σ"))


def _summary(view: View, number: int) -> str:
    """What one step did, its model, and in the last one why it ends."""
    diagnosis, result, steps = view.diagnoses[number], view.results[number], view.improvement.steps
    blocks = [f"**Step {number}**: {_done(steps[number - 1])}" if number else "**Step 0**: the first model"]
    blocks.append(f"Model: {result.model.sum}; p {format_p(diagnosis.test.p_value)}")
    errors = [f"{words} {units.significant(values[number], zeros=True)}" for words, values, _ in view.errors.values()]
    blocks.append(f"Error, {units.shown('m/s^2').label}: {'; '.join(errors)}")
    if result.model.effects:
        blocks.append(markdown(effect_table(result)))
    if number == len(steps):
        blocks.append(f"**It ends here.** {view.improvement.reason}")
    else:
        blocks.append(diagnosis.verdict)
    return "\n\n".join([*blocks, *(steps[number - 1].remarks if number else ())]) + "\n"


def _done(step: SelectionStep) -> str:
    share = "" if step.probability is None else f", which was missing with {format_probability(step.probability)}"
    added = [f"{step.added} added{share}"] if step.added else []
    return "; ".join([*added, *(f"{each.name} taken out (p {format_p(each.p_value)})" for each in step.dropped)])


def _layout(view: View) -> rrb.Blueprint:
    errors = [values for _, values, _ in view.errors.values()]
    top, steps = 1.08 * float(np.nanmax(errors)), len(view.improvement.steps)
    first = rrb.Horizontal(
        rrb.Vertical(
            _series("error", f"rms error, {units.shown('m/s^2').label}", steps, (0.0, top)),
            _series("log10_p", "log₁₀ p, accepted above −2", steps),
        ),
        spheres("spheres", 1),
        rrb.TextDocumentView(origin="summary", name="this step"),
        column_shares=[4, 3.4, 4],
        name="The error falls" if view.improvement.steps else "The error of the model",
    )
    panels = [
        _series(entity("coefficients", symbol), printable(f"{symbol} ± σ, {units.shown(known[0]).label}"), steps)
        for symbol, values in view.coefficients.items()
        if (known := [each for each in values if each is not None])
    ]
    tabs = [first, *([rrb.Grid(*panels, grid_columns=3, name="Coefficients")] if panels else [])]
    return window(rrb.Tabs(*tabs), STEP, "following")


def _series(path: str, name: str, steps: int, reach: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    """The curves below a path over the steps, with room beside the first and the last; reach: of those that fall."""
    first, last = (rr.TimeRangeBoundary.absolute(seq=number) for number in (-1, steps + 1))
    axis_x = rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))
    corner = rrb.Corner2D.RightTop if reach else rrb.Corner2D.RightBottom
    return curves_panel([f"{path}/**"], name, axis_x, corner, reach)
