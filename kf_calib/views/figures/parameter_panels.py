"""A panel a parameter: a column an accelerometer, rows of angles, scale factors and biases; below, effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.views.figures.scales import log_scale, whole_numbers, written
from kf_calib.views.figures.style import ACCELEROMETERS, ALARM, MARKERS
from kf_calib.views.figures.symbols import KINDS, Shown, twelve

MANY = 60
"""Dwells, above which curves have no markers."""
_ROOM = 0.28  # of a panel, for its text
_STYLES = ("-", "--", ":")
_ROWS = [KINDS[unit] for unit in paper_parameters.UNITS[:4]]


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
        log_scale(panels[k], row, room=_ROOM)
    for axes, group in zip(others, groups, strict=True):
        for place, k in enumerate(group):
            values = sigmas[:, k] * names[k].per_si
            _curve(axes, numbers, values, place % 3, place // 3, f"{names[k].label}  {_final(values[-1], '')}")
        axes.set_ylabel(f"σ of effect,\n{names[group[0]].unit}")
        log_scale(axes, [sigmas[:, k] * names[k].per_si for k in group], room=_ROOM)
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
    for unit in KINDS:
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
    return f"{written(float(f'{value:.3g}'))} {unit}".rstrip()


def corner(axes: Axes, text: str, strong: bool = False) -> None:
    """Write into the upper right corner, which a falling curve leaves free."""
    axes.text(0.985, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=8.0,
              color="#111111", fontweight="bold" if strong else "normal", linespacing=1.25,
              bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.75})  # fmt: skip
