"""Where the model fails: residuals against what they go with, what explanations predict of them, and what is left; of
all dwells, and of one reading by reading.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import MaxNLocator

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.explanation import EffectShape, bars_of
from kf_calib.diagnosis.hypothesis_table import IRREGULAR
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.errors import InputError
from kf_calib.estimation.filter_history import DwellReadings, readings_of
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import Unit, rounded, shown, significant
from kf_calib.views.diagnosis import explains, share_in_words
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    ALARM,
    BAND,
    BEST,
    GREY,
    MARKERS,
    PALE,
    drawn_on,
    mark_of,
    say,
    say_once,
    wrapped,
)
from kf_calib.views.notation import unit_across

_TITLE, _LABEL = 36, 44  # letters in a line of a title, and below an axis
_PANELS = 4  # drivers in small panels; the explorer of the report has all
_LARGER = 1.1  # times sigma of noise alone, from which that with what was estimated is drawn, too
_MANY = 150  # dwells, above which markers are smaller and bars of sigma are left out


@drawn_on()
def residuals(figure: Figure, diagnosis: Diagnosis, driver: str | None = None) -> None:
    """What the readings show of the best explanation, over the quantity that it goes with.

    From the left: the residuals of the model, with what the explanation predicts of them; what the effect must explain,
    which is the readings less all else, and the effect as a curve with its 1 sigma; what it leaves. All are means of
    dwells, with 1 sigma: of noise alone, and pale with what was estimated of scatter and setting error. driver: another
    quantity to draw them over, by its symbol, such as ``q1`` or ``T``. Where the verdict names no explanation,
    residuals alone, with the dwell that it calls wrong. Raises TypeError for what is no diagnosis.
    """
    if not isinstance(diagnosis, Diagnosis):
        raise TypeError(
            f"residuals are drawn of a diagnosis, not of a {type(diagnosis).__name__}: give what diagnose returns."
        )
    named = diagnosis.explanation
    if named and driver is None and named.shapes:
        return draw_shape(figure, named.shapes[0])
    across = driver_to_show([each for each in diagnosis.drivers if driver in (None, each.symbol)], follows(diagnosis))
    if across is None:
        return say(figure, f"{driver or 'Nothing that was recorded'} does not vary in this run.")
    if named:
        return draw_shape(figure, named.over(across))
    _draw_alone(figure, diagnosis, across)


def _draw_alone(figure: FigureBase, diagnosis: Diagnosis, driver: Driver) -> None:
    """Draw the residuals of each accelerometer over a quantity."""
    before, unit, panels = diagnosis.before, unit_across(driver), figure.subplots(3, 1, sharex=True)
    residuals, (alone, estimated) = before.residuals_mps2, bars_of(before)
    wrong = np.array([visit.dwell.number == diagnosis.disturbed_dwell for visit in before.visits])
    for i, axes in enumerate(panels):
        x = driver.values[:, i] * unit.per_si
        _points(axes, x, residuals[:, i], (alone[:, i], estimated[:, i]), i)
        _mark(axes, x[wrong], residuals[wrong, i], diagnosis.disturbed_dwell)
        _rms(axes, residuals[:, i])
        axes.set_ylabel(f"accelerometer {i + 1}, {shown('m/s^2').label}")
    panels[0].set_title(wrapped(f"Residuals of {before.model.sum}", 3 * _TITLE))
    say_once(figure, panels)
    _say_quantity(panels[-1], driver.words, unit)


def draw_shape(figure: FigureBase, shape: EffectShape) -> None:
    """Draw residuals, what the effect must explain of the readings, and what it leaves: a row a channel."""
    panels = figure.subplots(len(shape.channels), 3, sharex=True, sharey="row", squeeze=False)
    across = unit_across(shape)
    for i, row in enumerate(panels):
        x, colour = shape.values[:, i] * across.per_si, i if len(panels) > 1 else None
        for axes, values in zip(row, (shape.residuals, shape.readings, shape.left), strict=True):
            _points(axes, x, values[:, i], (shape.bars[0][:, i], shape.bars[1][:, i]), colour, shape.quantity)
        _rms(row[0], shape.residuals[:, i], shape.quantity)
        _rms(row[2], shape.left[:, i], shape.quantity)
        row[0].plot(x, (shape.residuals - shape.left)[:, i] * shown(shape.quantity).per_si, marker="_", markersize=9,
                    linestyle="none", color=BEST, label=f"what the model with {shape.effect} predicts")  # fmt: skip
        _curve(row[1], across.per_si, shape, i)
        row[0].set_ylabel(f"{shape.channels[i]}, {shown(shape.quantity).label}")
    say_once(figure, panels[:, 0])
    titles = ["Residuals without it", f"What {shape.effect} must explain", "What it leaves"]
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(wrapped(title, _TITLE))
    has_letters = "·" in shape.symbol or "²" in shape.symbol
    for axes in panels[-1]:
        _say_quantity(axes, f"{shape.words} ({shape.symbol})" if has_letters else shape.words, across)


def _say_quantity(axes: Axes, words: str, unit: Unit) -> None:
    """Write below a panel what is across, and set few round numbers there."""
    axes.set_xlabel(wrapped(f"{words}, {unit.label}", _LABEL) if words else "")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def follows(diagnosis: Diagnosis) -> bool:
    """Whether the verdict may speak of a quantity that the misfit goes with: of noise or a wrong dwell it does not."""
    first = diagnosis.likeliest
    return not (diagnosis.noise or diagnosis.disturbed_dwell or (first is not None and first.driver == IRREGULAR))


def driver_to_show(drivers: Sequence[Driver], follows: bool = True) -> Driver | None:
    """The quantity that explains most; time where the misfit follows none, and None where nothing varies."""
    if drivers and follows and explains(drivers[0]):
        return drivers[0]
    return next((each for each in drivers if each.symbol == "t"), drivers[0] if drivers else None)


def _points(
    axes: Axes, x: Floats, values: Floats, sigmas: tuple[Floats, Floats], i: int | None, quantity: str = "m/s^2"
) -> None:
    """Draw means of dwells of accelerometer i, or of the platform, with two sigmas and the line at zero: of noise
    alone, and with what was estimated."""
    many, per_si = len(x) > _MANY, shown(quantity).per_si
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    mark, colour = mark_of(i)
    alone, estimated = sigmas
    if not many and np.nanmax(estimated / alone) > _LARGER:
        axes.errorbar(x, values * per_si, estimated * per_si, fmt="none", ecolor=PALE, elinewidth=1.0,
                      label="1σ with the scatter that was estimated")  # fmt: skip
    axes.errorbar(x, values * per_si, None if many else alone * per_si, fmt=mark, color=colour, zorder=3,
                  elinewidth=1.2, markersize=2.0 if many else 4.5, markeredgewidth=0.0)  # fmt: skip


def _mark(axes: Axes, x: Floats, values_mps2: Floats, number: int) -> None:
    """Put a ring about the mean of the dwell of this number, and its number beside it; nothing where there is none."""
    for at, value in zip(x, values_mps2 * shown("m/s^2").per_si, strict=True):
        axes.plot(at, value, "o", markersize=11.0, markerfacecolor="none", color=ALARM, zorder=4)
        axes.annotate(f"dwell {number}", (at, value), (9, 0), textcoords="offset points", color=ALARM, va="center")


def _rms(axes: Axes, residuals: Floats, quantity: str = "m/s^2") -> None:
    """Write the rms of residuals above their panel: on axes of large ones small ones cannot be read."""
    unit = shown(quantity)
    rms = unit.number(float(np.sqrt(np.nanmean(residuals**2))), 2, zeros=True)
    axes.set_title(f"rms {rms} {unit.label}", loc="right", fontsize=8.0, color=GREY)


def _curve(axes: Axes, scale: float, shape: EffectShape, i: int) -> None:
    """Draw what an effect adds to the readings, with its 1 sigma: a curve if it depends on this quantity alone."""
    per_si = shown(shape.quantity).per_si
    if shape.is_curve:
        at, middle, sigma = shape.curve(i)
        at, middle, sigma = at * scale, middle * per_si, sigma * per_si
        axes.plot(at, middle, color=BEST)
        axes.fill_between(at, middle - sigma, middle + sigma, color=BAND, linewidth=0.0)
    else:
        middle, sigma = shape.component[:, i] * per_si, shape.component_sigma[:, i] * per_si
        x = shape.values[:, i] * scale
        axes.errorbar(x, middle, sigma, fmt="_", color=BEST, ecolor=BAND, elinewidth=6.0, markersize=9)


@drawn_on()
def what_they_go_with(figure: Figure, diagnosis: Diagnosis) -> None:
    """Residuals over their sigma against everything that varies in the run, and what the best explanation leaves."""
    drawn, others = diagnosis.drivers[:_PANELS], [diagnosis.explanation] if diagnosis.explanation else []
    if not drawn:
        return say(figure, "Nothing that was recorded varies in this run.")
    wide = min(4, len(drawn))
    high = -(-len(drawn) // wide) * (1 + len(others))
    panels = figure.subplots(high, wide, sharey=True, squeeze=False)
    before = diagnosis.before.residuals_mps2 / mean_sigmas(diagnosis.before)
    for k, driver in enumerate(drawn):
        row, column = divmod(k, wide)
        unit, scale = unit_across(driver)
        values = [before, *(each.unexplained_ratios for each in others)]
        for below, (ratios, axes) in enumerate(zip(values, panels[row * len(values) :, column], strict=False)):
            _ratios(axes, driver.values * scale, ratios)
            axes.set_xlabel("" if below < len(values) - 1 else f"{driver.symbol}, {unit}")
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
            if not below:
                axes.set_title(f"{driver.words}\n{share_in_words(driver)}", fontsize=8.5)
            if not column:
                axes.set_ylabel("residual / σ" if not below else f"with\n{wrapped(others[0].name, 18)}")
    for axes in panels.flat[: panels.size]:
        if not axes.has_data():
            axes.set_axis_off()
    say_once(figure, [panels[0, 0]])


def _ratios(axes: Axes, x: Floats, ratios: Floats) -> None:
    """Draw ratios (D, 3) against a quantity (D, 3), with lines at +-2."""
    for bound in (-2.0, 2.0):
        axes.axhline(bound, color=GREY, linewidth=0.7, linestyle=":")
    for i in range(3):
        axes.plot(x[:, i], ratios[:, i], MARKERS[i], color=ACCELEROMETERS[i], markersize=3.0 if len(x) < _MANY else 1.5,
                  markeredgewidth=0.0, alpha=0.85, label=f"accelerometer {i + 1}")  # fmt: skip


@drawn_on()
def dwell(figure: Figure, source: Source, result: Calibration, number: int | None = None) -> None:
    """Every reading of one dwell less the model's prediction, with their mean and its sigma: the worst dwell, or this.

    source: the recording that was calibrated, which is read once more. Of more than 4000 readings some are drawn.
    """
    draw_dwell(figure, readings_of(source, result, number), result.model.sum)


@drawn_on()
def disturbed_dwell(figure: Figure, diagnosis: Diagnosis) -> None:
    """The same of the dwell that a diagnosis calls wrong or disturbed, less what the other orientations predict of it.

    Raises InputError where there is none, or where its readings were gone when the run was diagnosed.
    """
    if diagnosis.disturbed_readings is None:
        raise InputError("this diagnosis has no readings of a disturbed dwell to draw.")
    draw_dwell(figure, diagnosis.disturbed_readings, diagnosis.before.model.sum)


def draw_dwell(figure: FigureBase, readings: DwellReadings, model: str) -> None:
    """The same on a part of a figure; model: what the prediction is of, in words."""
    less = "less what all others predict" if readings.left_out else f"less the model: {model}"
    panels = figure.subplots(3, 2, sharex="col", sharey="col", squeeze=False, width_ratios=(2.2, 1.0))
    for i, (wide, narrow) in enumerate(panels):
        _readings(wide, readings, i)
        _mean(narrow, readings, i)
        wide.set_ylabel(f"accelerometer {i + 1}\nreading − model, {shown('m/s^2').label}")
    early = "; grey: not used" if (readings.time_s < readings.start_s - 1e-9).any() else ""
    some = "" if readings.every == 1 else f"; one of {readings.every} readings is drawn"
    panels[0, 0].set_title(f"Dwell {readings.number}, reading by reading, {less}{early}{some}")
    panels[0, 1].set_title(f"Mean of its {readings.count} readings, ± 1σ and 2σ")
    panels[-1, 0].set_xlabel("time since the first reading of the run, s")
    panels[-1, 1].set_xlabel(f"mean − model, {shown('m/s^2').label}")


def _readings(axes: Axes, readings: DwellReadings, i: int) -> None:
    """Draw the readings of one accelerometer with zero, which is the model, and their mean; grey: not used."""
    per_si, used = shown("m/s^2").per_si, readings.time_s >= readings.start_s - 1e-9
    for some, colour in ((~used, GREY), (used, ACCELEROMETERS[i])):
        axes.plot(readings.time_s[some], readings.differences_mps2[some, i] * per_si, ".", color=colour, markersize=2.0,
                  alpha=0.55)  # fmt: skip
    axes.axhline(0.0, color=GREY, linewidth=1.0)
    axes.axhline(readings.mean_mps2[i] * per_si, color=BEST, linewidth=1.4, linestyle="--")


def _mean(axes: Axes, readings: DwellReadings, i: int) -> None:
    """Draw the mean of one accelerometer with its sigma on an axis of its own size."""
    unit = shown("m/s^2")
    mean, sigma = readings.mean_mps2[i] * unit.per_si, readings.sigma_mps2[i] * unit.per_si
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.errorbar([mean], [0.0], xerr=[2.0 * sigma], fmt="none", color=ACCELEROMETERS[i], elinewidth=1.0, capsize=4.0)
    axes.errorbar([mean], [0.0], xerr=[sigma], fmt="o", color=ACCELEROMETERS[i], elinewidth=4.0, markersize=8.0)
    times = mean / sigma if sigma > 0.0 else np.nan
    value, spread = rounded(mean, sigma)
    said = f"{value} ± {spread} {unit.label}: {significant(times)} σ"
    axes.text(0.5, 0.75, said, transform=axes.transAxes, ha="center", bbox={"facecolor": "white", "edgecolor": "none"})
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([])
    axes.margins(x=0.35)
