"""Three ways of estimating beside each other, what they cost, and whether the noise is as it is assumed to be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.engine_comparison import Comparison
from kf_calib.estimation.filter_history import InnovationTests, innovation_tests, reading_correlation
from kf_calib.estimation.results import Calibration
from kf_calib.noise.allan import AllanDeviation
from kf_calib.support.units import shown
from kf_calib.views.figures.convergence import MANY, draw_nis
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    ALARM,
    GREY,
    MARKERS,
    PALE,
    drawn_on,
    log_scale,
    say,
    say_within,
    whole_numbers,
)
from kf_calib.views.notation import written

_WAYS = {"block": "block engine", "filterpy": "filterpy", "batch": "batch least squares"}
_COLOURS = {"block": "#222222", "filterpy": "#cc79a7", "batch": "#56b4e9"}
_LOWEST = 0.8  # of a value, that a bar of its sigma may reach down by on a logarithmic axis
_HATCHES = {"block": "", "filterpy": "///", "batch": "..."}


@drawn_on()
def three_ways(figure: Figure, compared: Comparison) -> None:
    """Differences of filterpy and batch least squares from the block engine after each orientation, in sigma; time and
    memory of the three; cumulative NIS beside chi-squared."""
    above, below = figure.subfigures(2, 1, squeeze=False)[:, 0]
    left, right = above.subfigures(1, 2, squeeze=False, width_ratios=[1.6, 1.0])[0]
    draw_differences(left.subplots(), compared)
    time, memory = right.subplots(2, 1)
    _bars(time, "Time", "s", {name: way.wall_s for name, way in compared.ways.items()})
    _bars(memory, "Peak memory of Python and numpy", "MB", {name: way.peak_mb for name, way in compared.ways.items()})
    tests = innovation_tests(compared.result)
    first, second = below.subplots(1, 2)
    draw_nis(first, tests)
    draw_cumulative(second, tests)
    for axes in (first, second):
        whole_numbers(axes, tests.numbers[0], tests.numbers[-1])


def draw_differences(axes: Axes, compared: Comparison) -> None:
    """Draw the largest difference of a parameter after each orientation, and behind it those of all parameters."""
    numbers = [visit.dwell.number for visit in compared.result.visits]
    drawn = list[Floats]()
    for (name, differences), marker in zip(compared.running_sigma.items(), "os", strict=False):
        sizes = np.abs(differences)
        known = np.isfinite(sizes).any(axis=1)
        largest = np.where(known, np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=1), np.nan)
        drawn += [largest]
        axes.plot(numbers, largest, color=_COLOURS[name], marker=marker if len(numbers) <= MANY else "", markersize=3.5,
                  label=f"{_WAYS[name]}: {written(float(f'{largest[-1]:.2g}'))} σ at the end")  # fmt: skip
    log_scale(axes, drawn)
    whole_numbers(axes, numbers[0], numbers[-1])
    axes.set_ylabel("largest difference, σ")
    axes.set_title("Largest difference of a parameter from the block engine, in its σ then")
    axes.legend(loc="best")


def _bars(axes: Axes, title: str, unit: str, sizes: dict[str, float]) -> None:
    """Draw a bar a way from zero, with its size beside it."""
    names = list(sizes)
    for place, name in enumerate(names):
        axes.barh(place, sizes[name], color=_COLOURS[name], hatch=_HATCHES[name], edgecolor="white", height=0.7)
        axes.annotate(f"{sizes[name]:.3g} {unit}", (sizes[name], place), xytext=(4, 0), textcoords="offset points",
                      va="center", fontsize=8.5)  # fmt: skip
    axes.set_yticks(range(len(names)), [_WAYS[name] for name in names])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, 1.25 * max(sizes.values()))
    axes.set_title(title)
    axes.set_xlabel(unit)


def draw_cumulative(axes: Axes, tests: InnovationTests) -> None:
    """Draw the sum of the NIS so far over its degrees of freedom, with what noise alone gives."""
    known = np.isfinite(tests.per_dof)
    axes.set_title("Sum of the NIS so far over its degrees of freedom")
    axes.set_ylabel("NIS / degrees of freedom")
    if not known.any():
        return say_within(axes, "no degrees of freedom")
    band = tests.per_dof_band[known]
    axes.fill_between(tests.numbers[known], band[:, 0], band[:, 1], color=PALE, alpha=0.6, linewidth=0.0,
                      label="95 % of noise alone")  # fmt: skip
    axes.axhline(1.0, color=GREY, linewidth=0.9)
    above = tests.per_dof[known][-1] > band[-1, 1]
    axes.plot(tests.numbers[known], tests.per_dof[known], color=ALARM if above else "#222222", markersize=3.5,
              marker="o" if len(band) <= MANY else "",
              label=f"{tests.per_dof[known][-1]:.3g} at the end{', above the band' if above else ''}")  # fmt: skip
    axes.set_ylim(0.0, 1.3 * max(float(np.nanmax(tests.per_dof)), 2.0))
    axes.legend(loc="upper right")


@drawn_on(11.0, 6.0)
def whiteness(figure: Figure, result: Calibration) -> None:
    """Autocorrelation of the innovations from dwell to dwell and of the readings within dwells, with bounds of 95 %."""
    tests, inside = innovation_tests(result), reading_correlation(result)
    panels = figure.subplots(2, 3, sharey="row")
    nothing = np.zeros(len(tests.bound))
    _reach(panels[0, 0], tests.autocorrelation, tests.bound)
    _reach(panels[1, 0], inside.values, np.abs(inside.white) + inside.bound)
    for i in range(3):
        above, below = panels[:, i]
        above.set_title(f"accelerometer {i + 1}")
        _autocorrelation(above, tests.autocorrelation[:, i], nothing, tests.bound, i)
        _autocorrelation(below, inside.values[:, i], inside.white, inside.bound, i)
        above.set_xlabel("lag, dwells")
        below.set_xlabel("lag, readings")
    panels[0, 0].set_ylabel("autocorrelation of\ninnovations / σ")
    panels[1, 0].set_ylabel("autocorrelation of readings\nabout parabolas in dwells")
    for axes in panels[:, 0]:
        axes.legend(*axes.get_legend_handles_labels(), loc="upper right", fontsize=7.5)


def _autocorrelation(axes: Axes, values: Floats, white: Floats, bound: Floats, i: int) -> None:
    """Draw an autocorrelation as stems, with the band that white noise keeps within in 95 % of all lags."""
    if not len(values) or not np.isfinite(values).any():
        axes.set_xticks([])
        return say_within(axes, "too few to tell")
    lags = np.arange(1, len(values) + 1)
    axes.fill_between(lags, white - bound, white + bound, color=PALE, alpha=0.6, linewidth=0.0,
                      label="white noise, 95 %")  # fmt: skip
    axes.vlines(lags, white, values, color=ACCELEROMETERS[i], linewidth=1.5)
    axes.plot(lags, values, MARKERS[i], color=ACCELEROMETERS[i], markersize=3.0)
    axes.plot(lags, white, color=GREY, linewidth=0.8)


def _reach(axes: Axes, values: Floats, bound: Floats) -> None:
    """Let an axis reach as far below zero as above, over all that is drawn in its row."""
    reach = 1.1 * max(float(np.nanmax(np.abs(values), initial=0.0)), float(bound.max(initial=0.0)))
    axes.set_ylim(-(reach or 1.0), reach or 1.0)


@drawn_on(11.0, 5.0)
def allan_deviation(figure: Figure, compared: Comparison) -> None:
    """Allan deviation of the readings in the longest dwells, with the lines of the noise model: a panel an
    accelerometer."""
    allan = compared.allan
    if allan is None:
        return say(figure, "There are no readings to take an Allan deviation of.")
    panels: Sequence[Axes] = figure.subplots(1, 3, sharex=True, sharey=True)
    scaled = allan.deviation_mps2 * shown("m/s^2").per_si
    for i, axes in enumerate(panels):
        _lines(axes, allan, i)
        axes.errorbar(allan.tau_s, scaled[:, i], scaled[:, i] * np.minimum(allan.spread, _LOWEST), fmt=MARKERS[i],
                      color=ACCELEROMETERS[i], markersize=3.5, elinewidth=0.9, label="readings, ±1σ")  # fmt: skip
        axes.set_xlabel("length of a cluster τ, s")
        axes.set_title(f"accelerometer {i + 1}")
    ends = np.outer(np.minimum(allan.spread, _LOWEST), [-1.0, 1.0])[:, None] + 1.0
    log_scale(panels[0], [scaled[..., None] * ends, allan.white_mps2 * shown("m/s^2").per_si])
    log_scale(panels[0], [allan.tau_s], "x")
    for axes in panels[1:]:
        axes.tick_params(labelleft=False)
    panels[0].set_ylabel(f"Allan deviation, {shown('m/s^2').label}")
    numbers = ", ".join(map(str, allan.dwells))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5,
                  title=f"Readings of {'dwell' if len(allan.dwells) == 1 else 'dwells'} {numbers}")  # fmt: skip


def _lines(axes: Axes, allan: AllanDeviation, i: int) -> None:
    """Draw what the parts of the noise model give."""
    per_si = shown("m/s^2").per_si
    axes.plot(allan.tau_s, allan.white_mps2[:, i] * per_si, color="#222222", linewidth=1.2, label="white, σ √(κ/m)")
    if allan.flicker_mps2[i]:
        axes.plot(allan.tau_s, np.full(len(allan.tau_s), allan.flicker_mps2[i] * per_si), "--", color="#222222",
                  linewidth=1.2, label="1/f, were it the scatter of dwells")  # fmt: skip
    if allan.walk_mps2.any():
        walk = allan.walk_mps2[:, i] * per_si
        axes.plot(allan.tau_s, walk, ":", color="#222222", linewidth=1.4, label="walk, q √(τ/3)")
