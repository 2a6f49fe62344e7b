"""What each orientation brought of the information about every parameter, and the correlations at the end."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.estimation.estimate import correlation
from kf_calib.estimation.parameter_history import ParameterHistory, history_of
from kf_calib.estimation.results import Calibration
from kf_calib.views.figures.parameter_panels import MANY
from kf_calib.views.figures.scales import whole_numbers
from kf_calib.views.figures.style import ACCELEROMETERS, GREY, MARKERS, blank, say, styled
from kf_calib.views.figures.symbols import with_coefficients

NOTABLE = 0.3
"""A correlation below this is not worth a place in a figure."""


def information(result: Calibration) -> Figure:
    """The share of the final information 1/sigma^2 that came with each orientation.

    Above: mean over the parameters of each accelerometer; below: every parameter.
    """
    with styled():
        figure = blank(11.0, 7.0)
        draw_information(figure, history_of(result))
    return figure


def draw_information(figure: FigureBase, history: ParameterHistory) -> None:
    """The same on a part of a figure."""
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.7])
    numbers, names = history.numbers, with_coefficients(history.parameters[STATE_COUNT:])
    count = int((numbers > 0).sum())
    above.axhline(100.0 / count, color=GREY, linewidth=1.0, linestyle="--", label=f"if all {count} brought as much")
    few = len(numbers) <= MANY
    for i, width in enumerate((3.6, 2.4, 1.2) if few else (2.4, 1.5, 0.7)):  # where all three are alike, none is hidden
        marker = MARKERS[i] if few else ""
        above.plot(numbers, 100.0 * history.shares_of_accelerometers[:, i], marker=marker, color=ACCELEROMETERS[i],
                   linewidth=width, markersize=2.0 + 1.6 * width, label=f"accelerometer {i + 1}")  # fmt: skip
    above.set_ylabel("share, %")
    above.set_title("Share of the final information 1/σ² that each orientation brought: mean of four parameters")
    top = 100.0 * np.nanmax(history.shares_of_accelerometers, initial=0.0)
    above.set_ylim(-0.04 * top, 1.4 * top)  # room for the legend
    above.legend(loc="upper center", ncols=4)
    known = 100.0 * np.where(np.isfinite(history.shares), history.shares, 0.0)
    edges = np.append(numbers - 0.5, numbers[-1] + 0.5)
    mesh = below.pcolormesh(edges, np.arange(len(names) + 1), known.T, cmap="YlGnBu", vmin=0.0,
                            vmax=max(float(np.quantile(known, 0.98)), 1e-3), rasterized=True)  # fmt: skip
    lost = [each.value is None for each in history.parameters]
    below.set_yticks(np.arange(len(names)) + 0.5, [f"{own.label}{' not determined' if gone else ''}"
                                                   for own, gone in zip(names, lost, strict=True)])  # fmt: skip
    below.invert_yaxis()
    below.grid(visible=False)
    for row in range(4, len(names), 4) if len(names) <= STATE_COUNT else (4, 8, 12):
        below.axhline(row, color="white", linewidth=2.0)
    below.set_title("The same for each parameter")
    whole_numbers(below, numbers[0], numbers[-1])
    figure.colorbar(mesh, ax=below, label="share, %", extend="max", pad=0.01)


def correlations(result: Calibration) -> Figure:
    """Correlations of the parameters and of the effects' coefficients at the end of a run, if any is notable."""
    with styled():
        figure = blank(8.0, 7.0)
        if not draw_correlations(figure, result):
            figure.set_size_inches(8.0, 1.5)
    return figure


def draw_correlations(figure: FigureBase, result: Calibration) -> bool:
    """The same on a part of a figure; a sentence where no correlation is notable. Whether there is a matrix."""
    matrix, names = correlation(result.estimate), with_coefficients(result.model.coefficients)
    beside = np.where(np.eye(len(matrix), dtype=bool) | ~np.isfinite(matrix), 0.0, matrix)
    one, other = np.unravel_index(np.argmax(np.abs(beside)), beside.shape)
    if abs(beside[one, other]) < NOTABLE:
        largest = f"the largest, of {names[one].label} and {names[other].label}, is {beside[one, other]:.2g}"
        said = f"All correlations of parameters are smaller than {NOTABLE}: {largest.replace('-', '−')}."
        say(figure, said, "#222222")
        return False
    axes = figure.subplots()
    image = axes.imshow(np.ma.masked_invalid(matrix), cmap="PuOr_r", vmin=-1.0, vmax=1.0)
    axes.set_facecolor("#d9d9d9")
    axes.grid(visible=False)
    labels = [each.label for each in names]
    axes.set_xticks(range(len(names)), labels, rotation=90 if max(map(len, labels)) > 3 else 0)
    axes.set_yticks(range(len(names)), labels)
    axes.xaxis.tick_top()
    for edge in (3.5, 7.5, 11.5)[: 3 if len(names) > STATE_COUNT else 2]:
        axes.axhline(edge, color=GREY, linewidth=0.8)
        axes.axvline(edge, color=GREY, linewidth=0.8)
    for row, column in zip(*np.nonzero(np.abs(beside) >= NOTABLE), strict=True):
        value = float(beside[row, column])
        axes.text(column, row, f"{value:.2f}".replace("0.", ".").replace("-", "−"), ha="center", va="center",
                  fontsize=min(8.0, 110.0 / len(names)), color="white" if abs(value) > 0.65 else "#222222")  # fmt: skip
    lost = bool(np.isnan(np.diag(matrix)).any())
    axes.set_title(f"Correlations; written from {NOTABLE} on{'; grey: not determined' if lost else ''}", pad=12.0)
    figure.colorbar(image, ax=axes, label="correlation (no unit)", shrink=0.8)
    return True
