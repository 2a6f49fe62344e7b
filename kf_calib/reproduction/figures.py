"""The seed paper's experiment: its Table 2 beside the figures computed here, and both sets' sigmas as readings come."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.reproduction.grebenkin2019 import (
    GRAVITY_MPS2,
    NONOPTIMAL_PRINTED,
    OPTIMAL_PRINTED,
    READINGS_PER_DWELL,
    Column,
    Experiment,
    falling_sigma,
    printed_column,
)
from kf_calib.views.figures import Figures, figures
from kf_calib.views.figures.convergence import parameter_panels
from kf_calib.views.figures.style import GREY, drawn_on, log_scale
from kf_calib.views.notation import twelve, written

_SETS = {"optimal": ("#0072b2", "-"), "non-optimal": ("#d55e00", "--")}


@drawn_on(11.0, 6.0)
def table2(figure: Figure, experiment: Experiment) -> None:
    """Mean size of the error of each parameter, of both sets: printed, expected, by least squares and by the filter."""
    axes, place = figure.subplots(), np.arange(STATE_COUNT)
    every = list[np.ndarray]()
    for (name, (colour, _)), (column, table) in zip(_SETS.items(), _tables(experiment), strict=True):
        computed = (column.orientations.expected, column.least_squares, column.kalman)
        every += [printed_column(table), *computed]
        axes.hlines(column.orientations.expected, place - 0.38, place + 0.38, color=colour, linewidth=2.0,
                    label=f"{name}: expected, √(2/π) σ")  # fmt: skip
        for offset, values, marker, what in ((-0.22, printed_column(table), "X", "printed in the paper"),
                                             (0.0, column.least_squares, "o", "least squares, here"),
                                             (0.22, column.kalman, "D", "filter, here")):  # fmt: skip
            axes.plot(place + offset, values, marker, color=colour, markersize=6.0, markeredgecolor="white",
                      markeredgewidth=0.6, label=f"{name}: {what}")  # fmt: skip
    log_scale(axes, every)
    for edge in (3.5, 7.5):
        axes.axvline(edge, color=GREY, linewidth=0.8)
    axes.set_xlim(-0.6, STATE_COUNT - 0.4)
    axes.set_xticks(place, [each.label for each in twelve()])
    axes.grid(visible=False, axis="x")
    axes.set_ylabel("mean of |error|, % of the deviation that was to be found")
    axes.set_title(f"Table 2 of the paper and {written(experiment.repetitions)} repetitions: optimal orientations "
                   "below, non-optimal ones above")  # fmt: skip
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)


@drawn_on()
def falling(figure: Figure, experiment: Experiment) -> None:
    """Sigma of every parameter as readings come, in the optimal and the non-optimal set, from the same prior."""
    panels, _ = parameter_panels(figure, "σ")
    both = [falling_sigma(column.orientations) for column, _ in _tables(experiment)]
    for k, axes in enumerate(panels):
        for (name, (colour, style)), sigmas in zip(_SETS.items(), both, strict=True):
            values = sigmas[:, k] * twelve()[k].per_si
            last = written(float(f"{values[-1]:.2g}"))
            axes.plot(values, style, color=colour, label=f"{name}" if k else f"{name} set")
            axes.annotate(last, (len(values) - 1, values[-1]), xytext=(3, 0), textcoords="offset points", fontsize=7.5,
                          color=colour, va="center", annotation_clip=False)  # fmt: skip
        axes.text(0.985, 0.97, twelve()[k].label, transform=axes.transAxes, ha="right", va="top", fontweight="bold")
        axes.set(xticks=range(0, len(both[0]), READINGS_PER_DWELL), xlim=(0, 1.16 * len(both[0])))
    for k in range(4):
        shown = np.array(both)[:, :, k::4] * twelve()[k].per_si
        log_scale(panels[k], [0.7 * shown, shown])
    for axes in panels[3::4]:
        axes.set_xlabel(f"readings ({READINGS_PER_DWELL} in each orientation)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


@drawn_on(11.0, 5.0)
def design_matrices(figure: Figure, experiment: Experiment) -> None:
    """The design matrices of both sets, as the paper's figure 4: a column a parameter, a row a reading."""
    panels = figure.subplots(1, 6, sharey=True)
    unit = np.array([GRAVITY_MPS2, GRAVITY_MPS2, GRAVITY_MPS2, 1.0])  # of angles and scale factor, of the bias
    every = [(name, i, column.orientations.design[i] / unit)
             for name, (column, _) in zip(_SETS, _tables(experiment), strict=True) for i in range(3)]  # fmt: skip
    for axes, (name, i, matrix) in zip(panels, every, strict=True):
        axes.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto", interpolation="nearest")
        axes.set_xticks(range(4), [each.label for each in twelve()[4 * i : 4 * i + 4]])
        axes.set_yticks(range(0, 4 * READINGS_PER_DWELL + 1, READINGS_PER_DWELL))
        axes.grid(visible=False)
        axes.set_title(f"{name} set" if i == 0 else "")
    panels[0].set_ylabel(f"reading ({READINGS_PER_DWELL} in each orientation)")
    figure.colorbar(panels[0].get_images()[0], ax=panels, label="element of D, g (bias: 1)")


def _tables(experiment: Experiment) -> list[tuple[Column, dict[str, float]]]:
    """Return both sets with their columns of Table 2."""
    return [(experiment.optimal, OPTIMAL_PRINTED), (experiment.nonoptimal, NONOPTIMAL_PRINTED)]


@figures.register
def experiment_figures(experiment: Experiment) -> Figures:
    """The figures of the experiment by title."""
    return {
        "Table 2 of the paper": lambda: table2(experiment),
        "Sigma as readings come": lambda: falling(experiment),
        "Design matrices of both sets": lambda: design_matrices(experiment),
    }
