"""Where the model fails: residuals against what they go with, what explanations predict of them, and what is left."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import MaxNLocator

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.residual_drivers import (
    Driver,
    channel_rms_mps2,
    is_function_of,
)
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import format_p
from kf_calib.support.units import Unit, shown, shown_whole
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    BAND,
    BEST,
    GREY,
    MARKERS,
    RUNNER_UP,
    blank,
    say,
    styled,
)
from kf_calib.views.figures.words import rounded_number, wrapped

_SIGNIFICANT, _SOME = 0.01, 0.005  # p-value and share above and below which a driver explains nothing
_TITLE = 36  # letters in a line of a title
_PANELS = 4  # drivers in small panels; the explorer of the report has all
_MANY = 150  # dwells, above which markers are smaller and bars of sigma are left out


def residuals(diagnosis: Diagnosis, driver: str | None = None) -> Figure:
    """Residuals of each accelerometer against what they go with most, the best explanation, and what it leaves.

    From the left: the residuals of the model, with what the best explanation and the runner-up predict of them; the
    readings less all that the best explanation does not itself add, and the effect as a curve with its 1 sigma; what it
    leaves. All are means of dwells, with 1 sigma, on the same axes. driver: another quantity to draw them against, by
    its symbol, such as ``q1`` or ``T``. Raises TypeError for what is no diagnosis.
    """
    if not isinstance(diagnosis, Diagnosis):
        raise TypeError(
            f"residuals are drawn of a diagnosis, not of a {type(diagnosis).__name__}: give what diagnose returns."
        )
    with styled():
        figure = blank(11.0, 7.0)
        draw_residuals(figure, diagnosis, diagnosis.drivers, driver)
    return figure


def draw_residuals(
    figure: FigureBase, diagnosis: Diagnosis, drivers: Sequence[Driver], symbol: str | None = None
) -> None:
    """The same on a part of a figure; drivers: of the residuals, the first is taken where no symbol is given."""
    driver = driver_to_show([each for each in drivers if symbol in (None, each.symbol)])
    if driver is None:
        return say(figure, f"{symbol or 'Nothing that was recorded'} does not vary in this run.")
    others = diagnosis.explanations
    panels = figure.subplots(3, 3 if others else 1, sharex=True, sharey="row", squeeze=False)
    label, scale = driver_axis(driver)
    sigmas = mean_sigmas(diagnosis.before)
    for i, row in enumerate(panels):
        x = driver.values[:, i] * scale
        _points(row[0], x, diagnosis.before.residuals_mps2[:, i], sigmas[:, i], i)
        _rms(row[0], diagnosis.before.residuals_mps2, i)
        row[0].set_ylabel(f"accelerometer {i + 1}, {shown('m/s^2').label}")
        if others:
            best = others[0]
            for explanation, colour, marker in zip(others[:2], (BEST, RUNNER_UP), "_x", strict=False):
                _predictions(row[0], x, explanation, i, colour, marker)
            _points(row[1], x, best.unexplained_mps2[:, i] + best.contribution_mps2[:, i], sigmas[:, i], i)
            _curve(row[1], x, best, i, is_function_of(best.contribution_mps2, driver))
            _points(row[2], x, best.unexplained_mps2[:, i], sigmas[:, i], i)
            _rms(row[2], best.unexplained_mps2, i)
    titles = [f"Residuals of {diagnosis.before.model.sum}"]
    if others:
        name = others[0].name
        titles += [f"Readings less all but {name}", f"What {name} leaves of them"]
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(wrapped(title, _TITLE if others else 3 * _TITLE))
    for axes in panels[-1]:
        axes.set_xlabel(f"{driver.words}, {label}")
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def driver_to_show(drivers: Sequence[Driver]) -> Driver | None:
    """The quantity that explains most; time where none explains anything, and None where nothing varies."""
    if drivers and _explains(drivers[0]):
        return drivers[0]
    return next((each for each in drivers if each.symbol == "t"), drivers[0] if drivers else None)


def driver_axis(driver: Driver) -> Unit:
    """The unit in which a quantity is drawn."""
    return shown_whole(driver.unit, float(np.abs(driver.values).max()))


def _explains(driver: Driver) -> bool:
    """Tell whether a quantity explains more of the misfit than noise would."""
    return driver.p_value <= _SIGNIFICANT and driver.share >= _SOME


def _points(axes: Axes, x: Floats, values_mps2: Floats, sigmas_mps2: Floats, i: int) -> None:
    """Draw means of dwells with their sigma and the line at zero."""
    many = len(x) > _MANY
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    per_si = shown("m/s^2").per_si
    bars = None if many else sigmas_mps2 * per_si
    axes.errorbar(x, values_mps2 * per_si, bars, fmt=MARKERS[i], color=ACCELEROMETERS[i], zorder=3, elinewidth=0.9,
                  markersize=2.0 if many else 4.5, markeredgewidth=0.0)  # fmt: skip


def _rms(axes: Axes, residuals_mps2: Floats, i: int) -> None:
    """Write the rms of the residuals of one accelerometer above its panel: on axes of large ones small ones cannot be
    read."""
    unit = shown("m/s^2")
    rms = rounded_number(channel_rms_mps2(residuals_mps2)[i] * unit.per_si, 2)
    axes.set_title(f"rms {rms} {unit.label}", loc="right", fontsize=8.0, color=GREY)


def _predictions(axes: Axes, x: Floats, explanation: Explanation, i: int, colour: str, marker: str) -> None:
    """Draw what an explanation predicts of the residual of each dwell."""
    predicted = explanation.predicted_mps2[:, i] * shown("m/s^2").per_si
    axes.plot(x, predicted, marker=marker, markersize=9 if marker == "_" else 4,
              linestyle="none", color=colour, label=f"what {explanation.name} predicts of it")  # fmt: skip


def _curve(axes: Axes, x: Floats, explanation: Explanation, i: int, is_function: bool) -> None:
    """Draw what an explanation adds to the readings, with its 1 sigma: a curve if it depends on this quantity alone."""
    order, per_si = np.argsort(x), shown("m/s^2").per_si
    middle = explanation.contribution_mps2[order, i] * per_si
    sigma = explanation.contribution_sigma_mps2[order, i] * per_si
    if is_function:
        axes.plot(x[order], middle, color=BEST)
        axes.fill_between(x[order], middle - sigma, middle + sigma, color=BAND, linewidth=0.0)
    else:
        axes.errorbar(x[order], middle, sigma, fmt="_", color=BEST, ecolor=BAND, elinewidth=6.0, markersize=9)


def what_they_go_with(diagnosis: Diagnosis) -> Figure:
    """Residuals over their sigma against everything that varies in the run, and what the best explanation leaves."""
    with styled():
        figure = blank(11.0, 7.0)
        draw_drivers(figure, diagnosis, diagnosis.drivers)
    return figure


def draw_drivers(figure: FigureBase, diagnosis: Diagnosis, drivers: Sequence[Driver]) -> None:
    """The same on a part of a figure: a column a driver, those that explain most first."""
    drawn, others = drivers[:_PANELS], diagnosis.explanations[:1]
    if not drawn:
        return say(figure, "Nothing that was recorded varies in this run.")
    wide = min(4, len(drawn))
    high = -(-len(drawn) // wide) * (1 + len(others))
    panels = figure.subplots(high, wide, sharey=True, squeeze=False)
    before = diagnosis.before.residuals_mps2 / mean_sigmas(diagnosis.before)
    for k, driver in enumerate(drawn):
        row, column = divmod(k, wide)
        unit, scale = driver_axis(driver)
        values = [before, *(each.unexplained_ratios for each in others)]
        for below, (ratios, axes) in enumerate(zip(values, panels[row * len(values) :, column], strict=False)):
            _ratios(axes, driver.values * scale, ratios)
            axes.set_xlabel("" if below < len(values) - 1 else f"{driver.symbol}, {unit}")
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
            if not below:
                axes.set_title(f"{driver.words}\n{_of_share(driver)}", fontsize=8.5)
            if not column:
                axes.set_ylabel("residual / σ" if not below else f"with\n{wrapped(others[0].name, 18)}")
    for axes in panels.flat[: panels.size]:
        if not axes.has_data():
            axes.set_axis_off()
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=3)


def _of_share(driver: Driver) -> str:
    """Return in a few words how much of the misfit goes with a driver."""
    if not _explains(driver):
        return "no more than by chance"
    return f"{driver.share:.0%} of the misfit, p {format_p(driver.p_value)}"


def _ratios(axes: Axes, x: Floats, ratios: Floats) -> None:
    """Draw ratios (D, 3) against a quantity (D, 3), with lines at +-2."""
    for bound in (-2.0, 2.0):
        axes.axhline(bound, color=GREY, linewidth=0.7, linestyle=":")
    for i in range(3):
        axes.plot(x[:, i], ratios[:, i], MARKERS[i], color=ACCELEROMETERS[i], markersize=3.0 if len(x) < _MANY else 1.5,
                  markeredgewidth=0.0, alpha=0.85, label=f"accelerometer {i + 1}")  # fmt: skip
