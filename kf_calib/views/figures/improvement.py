"""The error falls: errors, p-values and coefficients over the steps of an improvement, and the residuals of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import Driver, unexplained_mps2, unexplained_rms_mps2
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, SelectionStep
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.figures.residuals import driver_axis, driver_to_show
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    BEST,
    GREY,
    MARKERS,
    RUNNER_UP,
    blank,
    label_axis,
    letter,
    say,
    styled,
    wrapped,
)

_COLUMNS = 5  # models whose residuals are drawn
_COEFFICIENTS, _WIDE = 6, 3  # panels of coefficients, and in a row
_NAME = 22


@dataclass(frozen=True)
class _Point:
    """A model on the axis of steps: what it is, its calibration, its p-value, and whether it is the user's to take."""

    label: str
    result: Calibration
    p_value: float | None
    kind: str = "step"  # or "undone", "either"


def improvement(state: Improvement) -> Figure:
    """Held-out and in-sample error against the noise floor over the steps, and the coefficients as they join.

    An undone step is drawn with a cross, beside the line; effects among which the run cannot decide follow the last
    step. Below the errors stands the p-value of the run with each model.
    """
    with styled():
        rows = -(-min(len(_effects(_points(state))), _COEFFICIENTS) // _WIDE)
        figure = blank(11.0, 7.0 + 2.0 * max(rows - 1, 0))
        draw_improvement(figure, state)
    return figure


def draw_improvement(figure: FigureBase, state: Improvement) -> None:
    """The same on a part of a figure."""
    points = _points(state)
    if not any(each.result.consistency.dof for each in points):
        return say(figure, "The parameters take up every mean reading of this run: there is no error to be seen.")
    floor, effects = state.floor_mps2, _effects(points)
    if effects:
        rows = -(-min(len(effects), _COEFFICIENTS) // _WIDE)
        halves: Any = figure.subfigures(2, 1, height_ratios=(1.25, float(rows)))
        _errors(halves[0].subplots(), points, floor)
        _coefficients(halves[1], points, effects)
    else:
        axes = figure.subplots()
        _errors(axes, points, floor)
        axes.set_title(f"{axes.get_title('left')}\n{wrapped(f'No effect was added. {state.reason}', 130)}")


def _effects(points: Sequence[_Point]) -> list[str]:
    """Return the names of all effects in the models."""
    return list(dict.fromkeys(str(effect) for each in points for effect in each.result.model.effects))


def _points(state: Improvement) -> list[_Point]:
    """Return the models from the first to the last, undone ones where they stood, then those that are equally good."""
    points = [_Point("start", state.start.before, state.start.test.p_value)]
    for step in state.history:
        points.append(
            _Point(_label(step), step.result, step.diagnosis.test.p_value, "undone" if step.undone else "step")
        )
    others = [each for each in state.alternatives if each.result is not state.result]
    word = "+" if len(others) == len(state.alternatives) else "or"
    return [*points, *(_Point(f"{word} {each.name}?", each.result, None, "either") for each in others)]


def _label(step: SelectionStep) -> str:
    """Return what a step added and took out."""
    said = [f"+ {step.added}"] if step.added else []
    said += [f"− {each.name}" for each in step.dropped]
    return ", ".join(said) + (" (undone)" if step.undone else "")


def _errors(axes: Axes, points: Sequence[_Point], floor_mps2: float | None) -> None:
    """Draw the errors of all models over the noise floor of the last, and the p-value of the run below each."""
    places, kept = np.arange(len(points)), np.array([each.kind == "step" for each in points])
    held_out = _in_unit([each.result.held_out_rms_mps2 for each in points])
    fitted = _in_unit([unexplained_rms_mps2(each.result) for each in points])
    floor = _in_unit([floor_mps2])
    if floor_mps2:
        axes.axhline(floor[0], color=GREY, linestyle="--", linewidth=1.2, label="what noise alone gives")
    for values, name, marker, colour in ((held_out, "left out of", "o", BEST), (fitted, "in", "s", "#0072b2")):
        axes.plot(places[kept], values[kept], marker=marker, color=colour, label=f"rms of orientations {name} the fit")
        _beside(axes, values, points, marker)
    _write_ratios(axes, held_out, floor[0])
    every = np.concatenate([held_out, fitted, floor])
    low, high = 0.6 * np.nanmin(every), 2.2 * np.nanmax(every)
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    label_axis(axes.yaxis, low, high)
    axes.set_ylabel(f"rms error, {shown('m/s^2').label}")
    axes.set_xlim(-0.5, len(points) - 0.5)
    axes.set_xticks(places, [_tick(k, each) for k, each in enumerate(points)])
    axes.set_title("The error of the model over the steps; below each, the p-value of the run with it")
    axes.legend(loc="upper right", ncols=3)


def _tick(number: int, point: _Point) -> str:
    """Return the words below a model."""
    p_value = "" if point.p_value is None else f"\np {format_p(point.p_value)}"
    return f"{wrapped(f'{number}: {point.label}', _NAME)}{p_value}"


def _in_unit(values_mps2: Sequence[float | None]) -> Floats:
    """Return errors in the unit that they are drawn in; NaN where there is none."""
    return np.array([np.nan if value is None else value for value in values_mps2]) * shown("m/s^2").per_si


def _beside(axes: Axes, values: Floats, points: Sequence[_Point], marker: str) -> None:
    """Draw models that are not on the way: undone ones with a cross, those to choose from with open markers."""
    for x, (y, point) in enumerate(zip(values, points, strict=True)):
        if point.kind == "undone":
            axes.plot(x, y, marker="x", color=GREY, markersize=8.0, linestyle="none")
        elif point.kind == "either":
            axes.plot(x, y, marker=marker, markerfacecolor="white", color=RUNNER_UP, markersize=6.5, linestyle="none")


def _write_ratios(axes: Axes, errors: Floats, floor: float) -> None:
    """Write how many times the noise floor the held-out error is."""
    for x, error in enumerate(errors):
        if np.isfinite(error) and floor > 0.0:
            axes.annotate(f"{error / floor:.2f} × floor", (x, error), (8, 6), textcoords="offset points", fontsize=8.5,
                          bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8})  # fmt: skip


def _coefficients(figure: SubFigure, points: Sequence[_Point], effects: Sequence[str]) -> None:
    """Draw the coefficients of each effect, with 1 sigma, at every model that has the effect."""
    drawn = effects[:_COEFFICIENTS]
    rows = -(-len(drawn) // _WIDE)
    panels = figure.subplots(rows, -(-len(drawn) // rows), squeeze=False).ravel()
    for axes, name in zip(panels, drawn, strict=False):
        _of_effect(axes, name, points)
    for axes in panels[len(drawn) :]:
        axes.set_axis_off()


def _of_effect(axes: Axes, name: str, points: Sequence[_Point]) -> None:
    """Draw the coefficients of one effect over the models."""
    fitted = [(x, _parameters(point.result, name)) for x, point in enumerate(points)]
    fitted = [(x, parameters) for x, parameters in fitted if parameters]
    symbols = list(dict.fromkeys(p.symbol for _, parameters in fitted for p in parameters))
    unit = shown(fitted[0][1][0])
    for k, coefficient in enumerate(symbols):
        shift = 0.5 * (k - 0.5 * (len(symbols) - 1)) / max(len(symbols), 1)
        values = [
            (x + shift, p.value * unit.per_si, p.sigma * unit.per_si)
            for x, parameters in fitted
            for p in parameters
            if p.symbol == coefficient and p.value is not None and p.sigma is not None
        ]
        if values:
            places, middles, sigmas = zip(*values, strict=True)
            sensor = _accelerometer(coefficient, k)
            again = sensor in [_accelerometer(other, j) for j, other in enumerate(symbols[:k])]
            axes.errorbar(
                places,
                middles,
                sigmas,
                fmt=MARKERS[sensor],
                color=ACCELEROMETERS[sensor],
                capsize=2.0,
                markersize=5.0,
                markerfacecolor="white" if again else None,
                label=symbol(coefficient),
            )
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlim(-0.5, len(points) - 0.5)
    axes.set_xticks(range(len(points)))
    axes.set_xlabel("number of the model above", fontsize=8.0)
    axes.set_ylabel(f"coefficient ± 1σ, {unit.label}")
    axes.set_title(wrapped(name, 30))
    axes.legend(fontsize=8.0, handletextpad=0.2, borderpad=0.1)


def _accelerometer(name: str, k: int) -> int:
    """Return the accelerometer, from 0, of a coefficient by the digit at its end; of one without, its place."""
    return int(name[-1]) - 1 if name[-1] in "123" else k % 3


def _parameters(result: Calibration, name: str) -> list[Parameter]:
    """Return the coefficients of an effect in the unit of the first of them; a constant of another unit is left out."""
    effect = next((each for each in result.model.effects if str(each) == name), None)
    sizes = [] if effect is None else [each.symbol for each in effect.parameters]
    own = [result.parameters[each] for each in sizes if each in result.parameters]
    return [p for p in own if p.shown_unit == own[0].shown_unit]


def residuals_of_steps(state: Improvement) -> Figure:
    """Residuals over their sigma with the model of each step, on the same axes: a column a model, a row an
    accelerometer."""
    with styled():
        figure = blank(11.0, 7.0)
        draw_residuals_of_steps(figure, state, state.start.drivers)
    return figure


def draw_residuals_of_steps(figure: FigureBase, state: Improvement, drivers: Sequence[Driver]) -> None:
    """The same on a part of a figure; drivers: of the residuals of the first model."""
    steps = [("start", state.start), *((_label(step), step.diagnosis) for step in state.steps)]
    drawn = steps if len(steps) <= _COLUMNS else [steps[0], *steps[-(_COLUMNS - 1) :]]
    driver = driver_to_show(drivers)
    if driver is None:
        return say(figure, "Nothing that was recorded varies in this run.")
    unit, scale = driver_axis(driver)
    sigmas = mean_sigmas(state.start.before)
    panels = figure.subplots(3, len(drawn), sharex=True, sharey=True, squeeze=False)
    for column, (words, diagnosis) in enumerate(drawn):
        ratios = unexplained_mps2(diagnosis.before) / sigmas
        panels[0, column].set_title(f"{wrapped(words, 28)}\n{_fate(diagnosis, state.floor_mps2)}", fontsize=8.5)
        for i, axes in enumerate(panels[:, column]):
            for bound in (-2.0, 2.0):
                axes.axhline(bound, color=GREY, linewidth=0.7, linestyle=":")
            axes.plot(driver.values[:, i] * scale, ratios[:, i], MARKERS[i], color=ACCELEROMETERS[i], markeredgewidth=0)
            if not column:
                axes.set_ylabel(f"accelerometer {i + 1}\nresidual / σ")
        panels[-1, column].set_xlabel(f"{driver.words}, {unit}", fontsize=8.0)
    if len(drawn) < len(steps):
        letter(panels[0, 1], f"{len(steps) - len(drawn)} steps before it are left out")


def _fate(diagnosis: Diagnosis, floor_mps2: float | None) -> str:
    """Return the held-out error over the noise floor and the p-value of a model in one line."""
    rms = diagnosis.before.held_out_rms_mps2
    times = f"{rms / floor_mps2:.2f} × floor, " if rms is not None and floor_mps2 else ""
    return f"{times}p {format_p(diagnosis.test.p_value)}"
