"""The error falls: residuals of each step of an improvement on the same axes, with its numbers, and what was added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.ticker import MaxNLocator

from kf_calib.diagnosis.residual_drivers import unexplained_mps2
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support.units import shown
from kf_calib.views.figures.residuals import driver_to_show
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    GREY,
    MARKERS,
    accelerometer_of,
    drawn_on,
    mark_of,
    rows_of,
    say,
    wrapped,
)
from kf_calib.views.improvement import changes, equally_good
from kf_calib.views.notation import symbol, unit_across

_COLUMNS = 5  # models whose residuals are drawn
_PANELS = 4  # of coefficients
_NAME = 26


@dataclass(frozen=True)
class _Model:
    """A model on the way, or one to choose: what it is in words, its calibration and its p-value."""

    label: str
    result: Calibration
    p_value: float | None = None


@drawn_on(11.0, 8.0)
def improvement(figure: Figure, state: Improvement) -> None:
    """Residuals over their sigma with the model of each step, on the same axes: a column a step.

    Above each stand its error on orientations left out, over what noise alone gives, and the p-value of the run. Undone
    steps are among them; effects among which the run cannot decide follow the last. Below are the coefficients that the
    last model has, with 1 and 2 sigma, against zero.
    """
    models, coefficients = _models(state), _coefficients(state.result)
    if not any(each.result.consistency.dof for each in models):
        return say(figure, "The parameters take up every mean reading of this run: there is no error to be seen.")
    if not coefficients:
        _residuals(figure, state, models)
        return
    above, below = figure.subfigures(2, 1, height_ratios=(3.0, 1.0))  # type: ignore[misc]  # two, of two rows
    _residuals(above, state, models)
    _against_zero(below, coefficients)


def _models(state: Improvement) -> list[_Model]:
    """Return the models from the first to the last, undone ones where they stood, then those that are equally good."""
    models = [_Model("start", state.start.before, state.start.test.p_value)]
    models += [_Model(changes(step).replace("- ", "− ") + " (undone)" * step.undone, step.result,
                      step.diagnosis.test.p_value) for step in state.history]  # fmt: skip
    return [*models, *(_Model(f"{name}?", result) for name, result in equally_good(state))]


def _residuals(figure: FigureBase, state: Improvement, models: Sequence[_Model]) -> None:
    """Draw residuals over their sigma, a column a model: the first, and as many of the last as there is room for."""
    driver = driver_to_show(state.start.drivers)
    if driver is None:
        return say(figure, "Nothing that was recorded varies in this run.")
    drawn = [0, *range(max(1, len(models) - _COLUMNS + 1), len(models))]
    unit, scale = unit_across(driver)
    sigmas = mean_sigmas(state.start.before)
    panels: Any = figure.subplots(3, len(drawn), sharex=True, sharey=True, squeeze=False)
    for column, number in enumerate(drawn):
        ratios = unexplained_mps2(models[number].result) / sigmas
        panels[0, column].set_title(_heading(number, models[number], state), fontsize=8.5 - (len(drawn) == _COLUMNS))
        for i, axes in enumerate(panels[:, column]):
            axes.axhspan(-2.0, 2.0, color="#eeeeee", zorder=0)
            axes.plot(driver.values[:, i] * scale, ratios[:, i], MARKERS[i], color=ACCELEROMETERS[i], markeredgewidth=0)
            if not column:
                axes.set_ylabel(f"accelerometer {i + 1}\nresidual / σ")
        panels[-1, column].set_xlabel(f"{driver.words}, {unit}", fontsize=8.0)
        panels[-1, column].xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    left_out = len(models) - len(drawn)
    said = "grey: within 2σ" + f"; {left_out} steps are left out" * bool(left_out)
    panels[-1, 0].set_xlabel(f"{panels[-1, 0].get_xlabel()}\n{said}", fontsize=8.0)


def _heading(number: int, model: _Model, state: Improvement) -> str:
    """Return what a model is, its error on orientations left out, and the p-value of the run with it."""
    rms, unit = model.result.held_out_rms_mps2, shown("m/s^2")
    said = [wrapped(f"{number}: {model.label}", _NAME)]
    if rms is not None and state.floor_mps2:
        said.append(f"held out {unit.number(rms, zeros=True)} {unit.label} = {rms / state.floor_mps2:.2f} × noise")
    return "\n".join([*said, *([] if model.p_value is None else [f"p {format_p(model.p_value)}"])])


def _coefficients(result: Calibration) -> list[tuple[str, list[Parameter]]]:
    """Return the coefficients of a model by effect and unit; constants such as times are not measured from zero."""
    sized = [(str(effect), result.parameters[c.symbol]) for effect in result.model.effects for c in effect.coefficients]
    known = [(name, p) for name, p in sized if p.value is not None and p.sigma is not None]
    groups = groupby(known, key=lambda each: (each[0], each[1].shown_unit))
    return [(name, [p for _, p in members]) for (name, _), members in groups]


def _against_zero(figure: SubFigure, coefficients: Sequence[tuple[str, list[Parameter]]]) -> None:
    """Draw coefficients with 1 and 2 sigma against zero: a panel an effect, in its unit."""
    drawn = coefficients[:_PANELS]
    panels: Any = figure.subplots(1, len(drawn), squeeze=False)
    for axes, (name, parameters) in zip(panels[0], drawn, strict=True):
        _of_effect(axes, name, parameters)
    if len(coefficients) > len(drawn):
        figure.supxlabel(f"{len(coefficients) - len(drawn)} more are in the table", fontsize=8.0, color=GREY)


def _of_effect(axes: Axes, name: str, parameters: Sequence[Parameter]) -> None:
    """Draw the coefficients of one effect, each in the colour of its accelerometer where its name ends in one."""
    unit = shown(parameters[0])
    for k, parameter in enumerate(parameters):
        assert parameter.value is not None and parameter.sigma is not None
        mark, colour = mark_of(accelerometer_of(parameter.symbol))
        value, sigma = parameter.value * unit.per_si, parameter.sigma * unit.per_si
        axes.errorbar(value, k, xerr=2.0 * sigma, fmt="none", color=colour, elinewidth=1.0, capsize=3.0)
        axes.errorbar(value, k, xerr=sigma, fmt=mark, color=colour, elinewidth=3.5, markersize=5.5)
    said = [" ± ".join(unit.rounded(p.value or 0.0, p.sigma or np.nan)) for p in parameters]
    rows_of(axes, [f"{symbol(p.symbol)} = {text}" for p, text in zip(parameters, said, strict=True)], fontsize=8.5)
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel(f"coefficient ± 1σ and 2σ, {unit.label}")
    axes.set_title(wrapped(name, 40))
