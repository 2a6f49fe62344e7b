"""Which effect is missing: what each suspect explains, which of them are alike, and where they would be told apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import MaxNLocator

from kf_calib.design.next_orientation import ENOUGH, Advice
from kf_calib.diagnosis.candidate_tests import overlap_matrix
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.results import format_p
from kf_calib.support.units import span
from kf_calib.views.figures.style import BEST, GREY, PALE, RUNNER_UP, blank, say, styled
from kf_calib.views.figures.symbols import wrapped

_MOST, _ALIKE = 7, 8  # explanations that are drawn, effects in the matrix of overlaps
_DRIVERS = 6
_NO_MISFIT = "The misfit as a whole is no larger than noise"
_NAME = 24  # letters of a name in a line
_DARK = 0.6  # overlap above which numbers are white
_FITTING = "#56b4e9"  # of Okabe and Ito's palette


def suspects(diagnosis: Diagnosis) -> Figure:
    """What each suspect explains of the misfit, how alike suspects are, and what the next orientation would tell.

    Above, from the left: the part of the misfit beyond noise that each explanation takes away, and whether the model
    with it fits; the overlaps of what they would add to the readings. Below: the quantities that the residuals go with,
    and the separation of the best explanation from its rivals, now and after one more dwell.
    """
    with styled():
        figure = blank(11.0, 7.0)
        draw_suspects(figure, diagnosis, diagnosis.drivers)
    return figure


def draw_suspects(figure: FigureBase, diagnosis: Diagnosis, drivers: Sequence[Driver]) -> None:
    """The same on a part of a figure; drivers: of the residuals."""
    explained = diagnosis.explanations[:_MOST]
    if not explained:
        return say(figure, wrapped(diagnosis.verdict, 90))
    rows, names = figure.add_gridspec(2, 1, height_ratios=(1.5, 1.0)), _alike(diagnosis)
    above = rows[0].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    below = rows[1].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    _bars(figure.add_subplot(above[0]), explained)
    _overlaps(figure.add_subplot(above[1]), diagnosis, names)
    _drivers(figure.add_subplot(below[0]), drivers[:_DRIVERS])
    _separation(figure.add_subplot(below[1]), diagnosis)


def _bars(axes: Axes, explained: Sequence[Explanation]) -> None:
    """Draw the share of each explanation, hatched where the model with it does not fit; what is known stands beside."""
    colours = [BEST, *(RUNNER_UP if k == 0 else _FITTING for k in range(len(explained) - 1))]
    for k, (explanation, colour) in enumerate(zip(explained, colours, strict=True)):
        share = 0.0 if explanation.share is None else 100.0 * explanation.share
        if explanation.fits:
            axes.barh(k, share, color=colour, height=0.62)
        else:
            axes.barh(k, share, facecolor="white", edgecolor=GREY, hatch="////", height=0.62, linewidth=0.8)
        axes.text(
            103.0, k, _said(explanation), va="center", fontsize=8.5, color="#222222" if explanation.fits else GREY
        )
    axes.set_yticks(range(len(explained)), [wrapped(explanation.name, _NAME) for explanation in explained])
    axes.set_ylim(len(explained) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("explained part of the misfit beyond noise, %")
    if all(explanation.share is None for explanation in explained):
        axes.text(50.0, 0.5 * (len(explained) - 1.0), _NO_MISFIT, color=GREY, ha="center", va="center")
    axes.set_title("What each explains; hatched: the model with it does not fit")


def _said(explanation: Explanation) -> str:
    """Return whether an explanation fits and its p-value, in words."""
    fits = "fits" if explanation.fits else "does not fit"
    return fits if explanation.p_value is None else f"{fits}, p {format_p(explanation.p_value)}"


def _alike(diagnosis: Diagnosis) -> list[str]:
    """Return names of suspects and their look-alikes, the best first."""
    names = dict.fromkeys([*diagnosis.missing, *diagnosis.ambiguity, *(each.name for each in diagnosis.suspects)])
    names.pop(diagnosis.test.effects.walk, None)  # which takes any path, and so overlaps with all
    return list(names)[:_ALIKE]


def _overlaps(axes: Axes, diagnosis: Diagnosis, names: Sequence[str]) -> None:
    """Draw the matrix of overlaps with a number in each cell."""
    values = overlap_matrix(diagnosis.test, names)
    if np.isfinite(values).sum() <= 1:
        return _words(axes, "No other effect has a shape to compare:\nthere are no overlaps to show.")
    axes.imshow(np.nan_to_num(values), cmap="Greys", vmin=0.0, vmax=1.25, aspect="auto")
    for (row, column), overlap in np.ndenumerate(values):
        text = "–" if np.isnan(overlap) else f"{overlap:.2f}"
        axes.text(column, row, text, ha="center", va="center", fontsize=8.0,
                  color="white" if overlap > _DARK else "#222222")  # fmt: skip
    axes.set_xticks(range(len(names)), [wrapped(name, 16) for name in names], rotation=40, ha="right",
                    rotation_mode="anchor", fontsize=8.0)  # fmt: skip
    axes.set_yticks(range(len(names)), [wrapped(name, 22) for name in names], fontsize=8.0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    axes.set_title("Overlap of what they add to the readings\n(1.00: the same shape, not the same probability)")


def _drivers(axes: Axes, drivers: Sequence[Driver]) -> None:
    """Draw the share of the misfit that goes with each quantity of the bench."""
    if not any(driver.share for driver in drivers):
        return _words(axes, f"{_NO_MISFIT}:\nno part of it is left to go with a quantity.")
    for k, driver in enumerate(drivers):
        axes.barh(k, 100.0 * driver.share, color=PALE, height=0.62)
        axes.text(103.0, k, f"p {format_p(driver.p_value)}", va="center", fontsize=8.5, color=GREY)
    axes.set_yticks(range(len(drivers)), [wrapped(driver.words, _NAME) for driver in drivers])
    axes.set_ylim(max(len(drivers), 1) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("part of the misfit beyond noise, %")
    axes.set_title("What goes with each quantity, beyond what any would by chance")


def _separation(axes: Axes, diagnosis: Diagnosis) -> None:
    """Draw how far the best explanation stands out now, and would after a dwell in the advised orientation."""
    going = diagnosis.next_orientation
    if going is None:
        return _words(axes, "There is no advice where to go next.")
    advice, why = going
    axes.barh([0, 1], [advice.before, advice.after], color=(PALE, BEST), height=0.5)
    for k, value in enumerate((advice.before, advice.after)):
        text = f" {value:.0f}" if advice.shows else f" {value:.1f} σ"
        axes.text(value, k, text, va="center", fontsize=9.0)
    stay = "a dwell" if advice.stay_s is None else span(advice.stay_s)
    axes.set_yticks([0, 1], ["now", f"after {stay} there"])
    axes.set_ylim(1.6, -0.6)
    axes.set_xlim(0.0, 1.2 * max(advice.before, advice.after, 1.0))
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("effects that become visible" if advice.shows else "separation, σ")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=bool(advice.shows)))
    if not advice.shows and axes.get_xlim()[1] > ENOUGH:
        axes.axvline(ENOUGH, color=GREY, linestyle=":", linewidth=1.0)
        axes.text(ENOUGH, -0.55, " enough", color=GREY, fontsize=8.0, va="top")
    axes.set_title(f"Next: gimbals at {_angles(advice)} deg\n{wrapped(why.partition(':')[0], 50)}")


def _angles(advice: Advice) -> str:
    """Return the advised gimbal angles as text."""
    return ", ".join(f"{angle:g}" for angle in advice.gimbal_deg)


def _words(axes: Axes, text: str) -> None:
    """Write in the middle of a panel why there is nothing to draw."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", color=GREY, transform=axes.transAxes)
