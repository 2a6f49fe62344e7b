"""The filter from orientation to orientation: sigmas and estimates (a panel a parameter: a column an accelerometer,
rows of angles, scale factors and biases; below, effects), NIS and innovations; and from calibration to calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import date2num
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.estimation.filter_history import InnovationTests, ParameterHistory, history_of, innovation_tests
from kf_calib.estimation.results import Calibration
from kf_calib.exchange.history import History, ParameterTrack
from kf_calib.support.units import rounded, shown, significant
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    ALARM,
    BAND,
    BEST,
    GREY,
    MARKERS,
    PALE,
    UNIT_KINDS,
    accelerometer_of,
    dated,
    drawn_on,
    log_scale,
    mark_of,
    panels_of,
    say_once,
    say_within,
    whole_numbers,
)
from kf_calib.views.notation import Shown, signed, symbol, twelve, with_coefficients, written

MANY = 60
"""Dwells, above which curves have no markers."""
_TEXT_ROOM = 0.28  # of a panel, for its text
_STYLES = ("-", "--", ":")
_ROWS = [UNIT_KINDS[unit] for unit in paper_parameters.UNITS[:4]]


def parameter_panels(figure: FigureBase, quantity: str, more: Sequence[Sequence[int]] = ()) -> tuple[list[Axes], ...]:
    """Axes of the twelve parameters in their order, and of further groups of states, three a row.

    quantity: what the y axis shows of a parameter, such as ``σ``.
    """
    rows = 4 + -(-len(more) // 3)
    panels = figure.subplots(rows, 3, sharex=True, squeeze=False)
    twelve_panels = [panels[row, column] for column in range(3) for row in range(4)]
    for k, axes in enumerate(twelve_panels):
        if k >= 4:
            axes.sharey(twelve_panels[k % 4])
            axes.tick_params(labelleft=False)
        else:
            axes.set_ylabel(f"{quantity} of {_ROWS[k]},\n{twelve()[k].unit}" if twelve()[k].unit else quantity)
        if k % 4 == 0:
            axes.set_title(f"accelerometer {k // 4 + 1}")
    others = list(panels[4:].flat)
    for axes in others[len(more) :]:
        axes.set_axis_off()
    return twelve_panels, others[: len(more)]


def draw_sigmas(
    figure: FigureBase, numbers: Floats, sigmas: Floats, names: Sequence[Shown], targets: Floats | None = None
) -> None:
    """Sigmas (n, p) in SI after dwells of these numbers, the largest of a kind named; targets (p,): those asked for."""
    groups = _by_unit(names)
    panels, others = parameter_panels(figure, "σ", groups)
    largest = _largest(sigmas[-1, :STATE_COUNT])
    for k, axes in enumerate(panels):
        name, values = names[k], sigmas[:, k] * names[k].per_si
        _curve(axes, numbers, values, k // 4)
        text = f"{name.label}  {_final(values[-1], name.unit)}"
        corner(axes, text + ("\nlargest of its kind" if k in largest else ""), k in largest)
        if targets is not None and np.isfinite(targets[k]):
            axes.axhline(targets[k] * name.per_si, color=ALARM, linewidth=1.2, linestyle="--", label="target")
    for k in range(4):
        row = [sigmas[:, k::4][:, :3] * names[k].per_si]
        if targets is not None:
            row.append(targets[k:STATE_COUNT:4] * names[k].per_si)
        log_scale(panels[k], row, room=_TEXT_ROOM)
    for axes, group in zip(others, groups, strict=True):
        for place, k in enumerate(group):
            values = sigmas[:, k] * names[k].per_si
            _curve(axes, numbers, values, place % 3, place // 3, f"{names[k].label}  {_final(values[-1], '')}")
        axes.set_ylabel(f"σ of effect,\n{names[group[0]].unit}")
        log_scale(axes, [sigmas[:, k] * names[k].per_si for k in group], room=_TEXT_ROOM)
        axes.legend(loc="upper right", fontsize=7.0, handlelength=1.2, labelspacing=0.2, ncols=1 + (len(group) > 3))
    for axes in (*panels, *others):
        last = axes in (others[-3:] or panels[3::4])
        whole_numbers(axes, numbers[0], numbers[-1], "orientation" if last else "")


def _by_unit(names: Sequence[Shown]) -> list[list[int]]:
    """Return the places of the coefficients of effects, those of one unit together."""
    groups = dict[str, list[int]]()
    for k, name in enumerate(names[STATE_COUNT:], STATE_COUNT):
        groups.setdefault(name.unit, []).append(k)
    return list(groups.values())


def _largest(sigma: Floats) -> set[int]:
    """Return the places of the largest angle's, scale factor's and bias's sigma of the twelve."""
    units, places = np.array(paper_parameters.UNITS), set[int]()
    for unit in UNIT_KINDS:
        of_unit = np.flatnonzero((units == unit) & np.isfinite(sigma))
        places |= {int(of_unit[np.argmax(sigma[of_unit])])} if of_unit.size else set()
    return places


def _curve(axes: Axes, numbers: Floats, values: Floats, i: int, style: int = 0, name: str = "") -> None:
    """Draw values after each dwell, in the colour and with the marker of an accelerometer."""
    marker = MARKERS[i] if len(numbers) <= MANY else ""
    if np.isfinite(values).sum() == 1:
        marker = MARKERS[i]
    axes.plot(numbers, values, _STYLES[style % 3], marker=marker, markersize=3.0, color=ACCELEROMETERS[i], label=name)


def _final(value: float, unit: str) -> str:
    """Return a sigma at the end as text."""
    if not np.isfinite(value):
        return "not determined"
    number = significant(value, zeros=True) if value >= 1e-4 else written(float(f"{value:.3g}"))
    return f"{number} {unit}".rstrip()


def corner(axes: Axes, text: str, strong: bool = False) -> None:
    """Write into the upper right corner, which a falling curve leaves free."""
    axes.text(0.985, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=8.0,
              color="#111111", fontweight="bold" if strong else "normal", linespacing=1.25,
              bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.75})  # fmt: skip


_LOG_FROM = 12.0  # times the upper end of the band; a larger NIS is drawn on a logarithmic axis
_LEGEND_ROOM = 0.32  # of a panel, for its legend above the points
_CUT = 12.0  # final sigmas beyond which an estimate on its way is not drawn


@drawn_on()
def convergence(figure: Figure, result: Calibration) -> None:
    """Sigma of every parameter against the number of orientations, the largest of each kind named; NIS and innovations.

    NIS of each dwell has the middle 95 % of chi-squared behind it, innovations are over their sigma with lines at 2.
    """
    history = history_of(result)
    names = with_coefficients(history.parameters[STATE_COUNT:])
    figure.set_size_inches(11.0, 7.0 + 1.3 * -(-len(_by_unit(names)) // 3))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[2.1, 1.0])[0]
    draw_sigmas(left, history.numbers.astype(float), history.sigmas, names)
    tests, (above, below) = innovation_tests(result), right.subplots(2, 1, sharex=True)
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
        return say_within(axes, "nothing is left over\nto judge the model by")
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
        log_scale(axes, [tests.nis[judged], band], room=_LEGEND_ROOM)
    else:
        axes.set_ylim(0.0, max(tests.nis[judged].max(), band[:, 1].max()) / (1.0 - _LEGEND_ROOM))
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
        say_within(axes, "the dwells before determine\nno prediction", 0.25)


@drawn_on()
def estimates(figure: Figure, result: Calibration) -> None:
    """Each estimate on its way to the final one, in final sigmas, with its own sigma after every orientation."""
    history = history_of(result)
    names = with_coefficients(history.parameters[STATE_COUNT:])
    figure.set_size_inches(11.0, 7.0 + 1.3 * -(-(len(names) - STATE_COUNT) // 3))
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
    return f"{name.label} {signed(off)} ± {sigma} {name.unit}".replace("-", "−")


_AHEAD = 0.5  # of the time from the first to the last calibration, if no later date is asked for
_SIGMAS = 2.0


@drawn_on()
def history(figure: Figure, calibrations: History) -> None:
    """A panel a parameter: what each calibration found less the last, with its 2 sigma, on the band within which those
    before it predict it; after the last, the band of the parameter in use, its tolerance, and when it may leave it.
    """
    panels = panels_of(figure, len(calibrations.tracks), 1.2, 2.2)
    for track, axes in zip(calibrations.tracks, panels, strict=True):
        _chart(axes, calibrations, track)
    say_once(figure, panels)


def _chart(axes: Axes, calibrations: History, track: ParameterTrack) -> None:
    """Draw one parameter."""
    unit = shown(track.unit)
    zero, scale = float(track.values[-1]), unit.per_si
    marker, colour = mark_of(accelerometer_of(track.symbol) or 0)
    dates = date2num(calibrations.dates)
    predicted, reach = (track.predicted - zero) * scale, _SIGMAS * track.predicted_sigma * scale
    known = np.isfinite(predicted)
    axes.errorbar(dates[known], predicted[known], reach[known], fmt="none", ecolor=PALE, elinewidth=7.0,
                  label="predicted by those before (2σ)")  # fmt: skip
    span_days = _AHEAD * float(calibrations.days[-1])
    if calibrations.due is not None:  # to the next one, and a little beyond
        span_days = max(span_days, 1.1 * ((calibrations.due - calibrations.dates[-1]) / timedelta(days=1)))
    ahead = np.linspace(0.0, span_days, 60)
    value, sigma = track.known_after(ahead)
    middle, wide = (value - zero) * scale, _SIGMAS * sigma * scale
    to_come = dates[-1] + ahead
    axes.plot(to_come, middle, color=BEST, linewidth=1.0, label="expected in use")
    axes.fill_between(to_come, middle - wide, middle + wide, color=BAND, linewidth=0.0, label="its 2σ")
    axes.errorbar(dates, (track.values - zero) * scale, _SIGMAS * track.sigmas * scale, fmt=marker, color=colour,
                  elinewidth=0.9, label="found (2σ)", zorder=3)  # fmt: skip
    tolerance = calibrations.tolerances.get(track.symbol)
    if tolerance is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * tolerance * scale, color=ALARM, linewidth=0.9, linestyle="--", label="tolerance")
    else:
        axes.axhline(0.0, color=GREY, linewidth=0.7)
    if calibrations.due is not None and calibrations.due_by == track.symbol:
        axes.axvline(float(date2num(calibrations.due)), label="may leave it", color=ALARM, linewidth=1.2)
    axes.set_title(f"{symbol(track.symbol)}, {unit.label} from the last")
    dated(axes)
