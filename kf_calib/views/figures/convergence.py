"""A calibration as it converges: sigmas and estimates after each orientation, NIS and innovations beside noise."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.estimation.innovation_tests import InnovationTests, innovation_tests
from kf_calib.estimation.parameter_history import ParameterHistory, history_of
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import rounded
from kf_calib.views.figures.parameter_panels import MANY, corner, draw_sigmas, parameter_panels
from kf_calib.views.figures.scales import log_scale, whole_numbers
from kf_calib.views.figures.style import ACCELEROMETERS, ALARM, BAND, GREY, MARKERS, PALE, blank, styled
from kf_calib.views.figures.symbols import Shown, with_coefficients

_LOG_FROM = 12.0  # times the upper end of the band; a larger NIS is drawn on a logarithmic axis
_ROOM = 0.32  # of a panel, for its legend above the points
_CUT = 12.0  # final sigmas beyond which an estimate on its way is not drawn


def convergence(result: Calibration) -> Figure:
    """Sigma of every parameter against the number of orientations, the largest of each kind named; NIS and innovations.

    NIS of each dwell has the middle 95 % of chi-squared behind it, innovations are over their sigma with lines at 2.
    """
    history = history_of(result)
    units = {each.unit for each in with_coefficients(history.parameters[STATE_COUNT:])[STATE_COUNT:]}
    with styled():
        figure = blank(11.0, 7.0 + 1.3 * -(-len(units) // 3))
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[2.1, 1.0])[0]
        draw_sigmas(
            left, history.numbers.astype(float), history.sigmas, with_coefficients(history.parameters[STATE_COUNT:])
        )
        draw_innovations(right, innovation_tests(result))
    return figure


def draw_innovations(figure: FigureBase, tests: InnovationTests) -> None:
    """NIS of each dwell above, innovations over their sigma below."""
    above, below = figure.subplots(2, 1, sharex=True)
    draw_nis(above, tests)
    draw_ratios(below, tests)
    for axes, words in ((above, ""), (below, "orientation")):
        whole_numbers(axes, tests.numbers[0], tests.numbers[-1], words)


def draw_nis(axes: Axes, tests: InnovationTests) -> None:
    """Draw the NIS of each dwell with the middle 95 % of what noise alone gives."""
    judged = tests.dof > 0
    axes.set_ylabel("NIS (no unit)")
    if not judged.any():
        axes.set_title("NIS by dwell: no degrees of freedom")
        axes.text(0.5, 0.5, "nothing is left over\nto judge the model by", transform=axes.transAxes, ha="center",
                  va="center", color=GREY)  # fmt: skip
        return
    band, ends = tests.band[judged], (tests.numbers[:, None] + [-0.5, 0.5]).ravel()  # a step a dwell
    axes.fill_between(ends, *np.repeat(tests.band, 2, axis=0).T, color=PALE, alpha=0.6, linewidth=0.0,
                      label="95 % of noise alone")  # fmt: skip
    axes.plot(ends, np.repeat(np.where(judged, tests.dof, np.nan), 2), color=GREY, linewidth=0.9,
              label="degrees of freedom")  # fmt: skip
    size = 4.0 if len(tests.numbers) <= MANY else 2.2
    for place, marker, colour, name in ((~tests.high, "o", "#222222", ""), (tests.high, "D", ALARM, "above it")):
        chosen = judged & place
        if chosen.any():
            axes.plot(tests.numbers[chosen], tests.nis[chosen], marker, color=colour, markersize=size, label=name)
    axes.set_title(f"NIS: {int(tests.high[judged].sum())} of {int(judged.sum())} dwells above the band")
    if tests.nis[judged].max() > _LOG_FROM * band[:, 1].max():
        log_scale(axes, [tests.nis[judged], band], room=_ROOM)
    else:
        axes.set_ylim(0.0, max(tests.nis[judged].max(), band[:, 1].max()) / (1.0 - _ROOM))
    axes.legend(loc="upper right", fontsize=7.5, labelspacing=0.25)


def draw_ratios(axes: Axes, tests: InnovationTests) -> None:
    """Draw the innovations over their sigma, with lines at 2."""
    axes.set_title("Innovations over their σ, lines at ±2")
    axes.set_ylabel("innovation / σ")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for bound in (-2.0, 2.0):
        axes.axhline(bound, color=GREY, linewidth=0.9, linestyle="--")
    for i in range(3):
        axes.plot(tests.numbers, tests.ratios[:, i], MARKERS[i], color=ACCELEROMETERS[i], alpha=0.9,
                  markersize=4.0 if len(tests.numbers) <= MANY else 2.0, markeredgewidth=0.0,
                  label=f"{i + 1}")  # fmt: skip
    largest = np.nanmax(np.abs(tests.ratios), initial=3.0)
    axes.set_ylim(-1.1 * largest, 1.7 * largest)
    if np.isfinite(tests.ratios).any():
        axes.legend(loc="upper right", fontsize=7.5, ncols=3, title="accelerometer", columnspacing=1.0)
    else:
        axes.set_yticks([])
        axes.text(0.5, 0.25, "the dwells before determine\nno prediction", transform=axes.transAxes, ha="center",
                  va="center", color=GREY)  # fmt: skip


def estimates(result: Calibration) -> Figure:
    """Each estimate on its way to the final one, in final sigmas, with its own sigma after every orientation."""
    with styled():
        history = history_of(result)
        count = len(history.parameters) - STATE_COUNT
        figure = blank(11.0, 7.0 + 1.3 * -(-count // 3))
        draw_estimates(figure, history)
    return figure


def draw_estimates(figure: FigureBase, history: ParameterHistory) -> None:
    """The same on a part of a figure."""
    names = with_coefficients(history.parameters[STATE_COUNT:])
    twelve, others = parameter_panels(figure, "", [[k] for k in range(STATE_COUNT, len(names))])
    around = history.sigmas / history.sigmas[-1]
    reach = np.abs(history.deviations) + around
    limit = float(np.clip(1.1 * np.nanmax(reach, initial=3.0), 3.0, _CUT))
    for k, axes in enumerate((*twelve, *others)):
        i = k // 4 if k < STATE_COUNT else k % 3
        middle = history.deviations[:, k]
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        axes.fill_between(history.numbers, middle - around[:, k], middle + around[:, k], color=BAND, linewidth=0.0)
        axes.plot(history.numbers, middle, color=ACCELEROMETERS[i], markersize=3.0, linewidth=1.2,
                  marker=MARKERS[i] if len(history.numbers) <= MANY else "")  # fmt: skip
        axes.set_ylim(-limit, limit)
        axes.set_ylabel("estimate less final,\nin final σ" if k < 4 or (k >= STATE_COUNT and k % 3 == 0) else "")
        last = axes in (others[-3:] or twelve[3::4])
        whole_numbers(axes, history.numbers[0], history.numbers[-1], "orientation" if last else "")
        corner(axes, _ending(history, k, names[k]))


def _ending(history: ParameterHistory, k: int, name: Shown) -> str:
    """Return the final estimate less its nominal value, with its sigma, as text."""
    parameter = history.parameters[k]
    if parameter.value is None or parameter.sigma is None:
        return f"{name.label} not determined"
    off, sigma = rounded((parameter.value - parameter.nominal) * name.per_si, parameter.sigma * name.per_si)
    return f"{name.label} {'' if off.startswith('-') else '+'}{off} ± {sigma} {name.unit}".replace("-", "−")
