"""What a misfit may be: families of effects and single explanations with their probabilities, what each suspect
explains, which are alike and where they would be told apart, and what could hide in the run unseen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kf_calib.design.next_orientation import ENOUGH
from kf_calib.diagnosis.candidate_tests import overlap_matrix
from kf_calib.diagnosis.coefficient_sizes import Detectable, Unseen
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.hypothesis_table import LISTED, NOISE, NONE, NOTHING, SURE, Hypothesis, HypothesisTable
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.effects.effect import Grade
from kf_calib.estimation.results import format_p
from kf_calib.support.text import angles_in_words, counted
from kf_calib.support.units import shown, span
from kf_calib.views.console import GRADES, size_range
from kf_calib.views.diagnosis import name_of
from kf_calib.views.figures.style import (
    BEST,
    GREY,
    PALE,
    RUNNER_UP,
    drawn_on,
    label_ticks,
    rows_of,
    say,
    say_within,
    ticks,
    wrapped,
)

_FAMILIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's, the likeliest first
_NO_EFFECT = {NOTHING: PALE, NOISE: GREY, NONE: BEST}
_NAME = 44  # letters of a name in a line
_LINE_IN = 0.14
_END = 130.0  # of the panel in per cent: beyond 100 there are numbers


class _Bar(NamedTuple):
    """A bar with its name, its colours from above, and the number in the last column."""

    name: str
    probability: float
    colours: tuple[str, ...]
    odds: str = ""

    @property
    def lines(self) -> int:
        """Number of lines of its name."""
        return self.name.count("\n") + 1


@drawn_on()
def hypotheses(figure: Figure, diagnosis: Diagnosis) -> None:
    """The probability of each family of effects, and of each explanation in the colours of its families.

    Those of less than 1 % are drawn together. Beside each explanation stands the logarithm of its odds to the next.
    """
    if diagnosis.table is None:
        figure.set_size_inches(11.0, 2.0)
        return say(figure, wrapped(diagnosis.verdict, 110))
    above, below = both = _probability_bars(diagnosis.table)
    lines = [sum(bar.lines + 0.5 for bar in bars) for bars in both]
    figure.set_size_inches(11.0, 1.9 + _LINE_IN * sum(lines))
    families, explanations = figure.subplots(2, 1, sharex=True, height_ratios=lines)
    _draw(families, above, "Families of what is missing (two effects at once count in both of theirs)")
    _draw(explanations, below, "Explanations, in the colours of their families", "log₁₀ odds\nto the next")
    explanations.set_xlabel("probability, %; dashes: from 95 % on it is taken for sure", loc="left")


def _probability_bars(table: HypothesisTable) -> tuple[list[_Bar], list[_Bar]]:
    """Return the bars of families and of explanations, the likeliest first, the unlikely as one at the end."""
    told = [family for family, share in table.families.items() if share >= LISTED]
    own = iter(_FAMILIES)
    colours = {family: _NO_EFFECT.get(family) or next(own, PALE) for family in told}
    families = [_Bar(family, table.families[family], (colours[family],)) for family in told]
    others = [family for family in table.families if family not in told]
    families += [_Bar(counted(len(others), "other"), table.probability_of_families(others), (PALE,))] if others else []
    explanations = [
        _Bar(_name(row), row.probability, tuple(colours.get(each, PALE) for each in row.families),
             "" if odds is None else f"{odds:.1f}")
        for row, odds in zip(table.rows, table.log10_odds, strict=True) if row in table.listed
    ]  # fmt: skip
    rest = [row.probability for row in table.rows if row not in table.listed]
    explanations += [_Bar(counted(len(rest), "other"), sum(rest), (PALE,))] if rest else []
    return families, explanations


def _name(row: Hypothesis) -> str:
    """Return the name of an explanation, in lines; of an unknown effect with its formulas, without their names."""
    formulas = (text.partition("=")[2].strip() or text for text in row.formulas)
    return "\n".join(wrapped(text, _NAME) for text in (name_of(row), ", ".join(formulas)) if text)


def _draw(axes: Axes, bars: Sequence[_Bar], title: str, odds: str = "") -> None:
    """Draw the bars; of two families at once, each has its share of the height. Numbers stand beside."""
    places, place = list[float](), 0.0
    for bar in bars:
        places.append(place + 0.5 * (bar.lines + 0.5))
        place += bar.lines + 0.5
    for bar, middle in zip(bars, places, strict=True):
        height = 1.0 / len(bar.colours)
        for k, colour in enumerate(bar.colours):
            top = middle - 0.5 + k * height
            axes.barh(top, 100.0 * bar.probability, height, color=colour, align="edge", linewidth=0.0)
        _beside(axes, 100.0 * bar.probability, middle, format_probability(bar.probability), 8.5)
        axes.text(_END, middle, bar.odds, va="center", ha="right", fontsize=8.5)
    axes.text(1.0, 1.0, odds, transform=axes.transAxes, va="bottom", ha="right", fontsize=8.0, color=GREY)
    axes.axvline(100.0 * SURE, color=GREY, linestyle="--", linewidth=1.0)
    axes.set_yticks(places, [bar.name for bar in bars])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(place, 0.0)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, _END)
    axes.spines["bottom"].set_bounds(0.0, 100.0)
    axes.set_xticks([0.0, 20.0, 40.0, 60.0, 80.0, 100.0 * SURE], ["0", "20", "40", "60", "80", f"{100.0 * SURE:g}"])
    axes.set_title(title)


def _beside(axes: Axes, value: float, place: float, text: str, size: float) -> None:
    """Write a number at the end of its bar, clear of lines behind it."""
    axes.annotate(text, (value, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=size,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5})  # fmt: skip


_MOST, _ALIKE = 7, 8  # explanations that are drawn, effects in the matrix of overlaps
_DRIVERS = 6
_NO_MISFIT = "The means of the dwells differ by no more than noise"
_SUSPECT_NAME = 24  # letters of a name in a line
_DARK = 0.6  # overlap above which numbers are white
_FITTING = "#56b4e9"  # of Okabe and Ito's palette


@drawn_on()
def suspects(figure: Figure, diagnosis: Diagnosis) -> None:
    """What each suspect explains of the misfit, how alike suspects are, and what the next orientation would tell.

    Above, from the left: the part of the misfit beyond noise that each explanation takes away, and whether the model
    with it fits; the overlaps of what they would add to the readings. Below: the quantities that the residuals go with,
    and the separation of the best explanation from its rivals, now and after one more dwell.
    """
    explained = diagnosis.explanations[:_MOST]
    if not explained:
        return say(figure, wrapped(diagnosis.verdict, 90))
    names = dict.fromkeys([*diagnosis.missing, *diagnosis.ambiguity, *(each.name for each in diagnosis.suspects)])
    names.pop(diagnosis.test.effects.walk, None)  # which takes any path, and so overlaps with all
    rows = figure.add_gridspec(2, 1, height_ratios=(1.5, 1.0))
    above = rows[0].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    below = rows[1].subgridspec(1, 2, width_ratios=(1.15, 1.0))
    _suspect_bars(figure.add_subplot(above[0]), explained)
    _overlaps(figure.add_subplot(above[1]), diagnosis, list(names)[:_ALIKE])
    _drivers(figure.add_subplot(below[0]), diagnosis.drivers[:_DRIVERS])
    _separation(figure.add_subplot(below[1]), diagnosis)


def _suspect_bars(axes: Axes, explained: Sequence[Explanation]) -> None:
    """Draw the share of each explanation, hatched where the model with it does not fit; what is known stands beside."""
    colours = [BEST, *(RUNNER_UP if k == 0 else _FITTING for k in range(len(explained) - 1))]
    for k, (explanation, colour) in enumerate(zip(explained, colours, strict=True)):
        share = 0.0 if explanation.share is None else 100.0 * explanation.share
        if explanation.fits:
            axes.barh(k, share, color=colour, height=0.62)
        else:
            axes.barh(k, share, facecolor="white", edgecolor=GREY, hatch="////", height=0.62, linewidth=0.8)
        said, ink = ("fits", "#222222") if explanation.fits else ("does not fit", GREY)
        p_value = "" if explanation.p_value is None else f", p {format_p(explanation.p_value)}"
        axes.text(103.0, k, said + p_value, va="center", fontsize=8.5, color=ink)
    _share_axis(axes, [explanation.name for explanation in explained], "explained part of the misfit beyond noise, %")
    if all(explanation.share is None for explanation in explained):
        axes.text(50.0, 0.5 * (len(explained) - 1.0), _NO_MISFIT, color=GREY, ha="center", va="center")
    axes.set_title("What each explains; p: that noise alone would do so\nhatched: the model with it does not fit")


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
    axes.set_title("Overlap of what they add to readings\n(1.00: same shape, not same probability)")


def _drivers(axes: Axes, drivers: Sequence[Driver]) -> None:
    """Draw the share of the misfit that goes with each quantity of the bench."""
    if not any(driver.share for driver in drivers):
        return _words(axes, f"{_NO_MISFIT}:\nthey go with no quantity.")
    for k, driver in enumerate(drivers):
        axes.barh(k, 100.0 * driver.share, color=PALE, height=0.62)
        axes.text(103.0, k, f"p {format_p(driver.p_value)}", va="center", fontsize=8.5, color=GREY)
    _share_axis(axes, [driver.words for driver in drivers], "part of the misfit beyond noise, %")
    axes.set_title("What goes with each quantity, beyond what any would by chance")


def _share_axis(axes: Axes, names: Sequence[str], words: str) -> None:
    """Name the rows of bars of a share, and what it is of."""
    rows_of(axes, [wrapped(name, _SUSPECT_NAME) for name in names])
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel(words)


def _separation(axes: Axes, diagnosis: Diagnosis) -> None:
    """Draw how far the best explanation stands out now, and would after a dwell in the advised orientation."""
    going = diagnosis.next_orientation
    if going is None:
        return _words(axes, "There is no advice where to go next.")
    advice, why = going
    axes.barh([0, 1], [advice.before, advice.after], color=(PALE, BEST), height=0.5)
    for k, value in enumerate((advice.before, advice.after)):
        _beside(axes, value, k, f"{value:.0f}" if advice.shows else f"{value:.1f} σ", 9.0)
    stay = "a dwell" if advice.stay_s is None else span(advice.stay_s)
    rows_of(axes, ["now", f"after {stay} there"])
    axes.set_xlim(0.0, 1.2 * max(advice.before, advice.after, 1.0))
    axes.set_xlabel("effects that become visible" if advice.shows else "separation, σ")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=bool(advice.shows)))
    if not advice.shows and axes.get_xlim()[1] > ENOUGH:
        axes.axvline(ENOUGH, color=GREY, linestyle=":", linewidth=1.0)
        axes.text(ENOUGH, -0.55, " enough", color=GREY, fontsize=8.0, va="top")
    axes.set_title(f"Next: gimbals at {angles_in_words(advice.gimbal_deg)}\n{wrapped(why.partition(':')[0], 50)}")


def _words(axes: Axes, text: str) -> None:
    """Write in the middle of a panel why there is nothing to draw."""
    axes.set_axis_off()
    say_within(axes, text)


_LOW, _HIGH = 0.01, 1000.0  # smallest detectable sizes that the axis spans
_SEEN, _HIDDEN = "#0072b2", "#e69f00"  # of Okabe and Ito's palette
_ROW_IN = 0.23
_LINE = 150  # letters of a line below the panels


@drawn_on()
def detection_limits(figure: Figure, diagnosis: Diagnosis) -> None:
    """Usual sizes of each effect over the smallest that this run would find; below, what it cannot see, and why.

    The part of a bar on the left of 1 could hide in the run: it is drawn in another colour. Usual sizes are those of
    sensors of the grade that the noise of the run is of.
    """
    sizes, texts = _ordered(diagnosis.detectable, diagnosis.grade), _unseen_texts(diagnosis.unseen)
    half = (len(sizes) + 1) // 2
    below_in = _LINE_IN * (2 + sum(len(text.splitlines()) for text in texts))
    height_in = max(7.0, 1.2 + _ROW_IN * half + below_in)
    figure.set_size_inches(11.0, height_in)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.0 - below_in / height_in, below_in / height_in))
    for column, half_of_sizes in enumerate((sizes[:half], sizes[half:])):
        _size_bars(figure.add_subplot(grid[0, column]), half_of_sizes, half, diagnosis.grade, not column)
    words = figure.add_subplot(grid[1, :])
    words.set_axis_off()
    words.set_title(
        "Not to be seen in this run at any size that a sensor could have"
        if texts
        else "Every effect could be seen in this run"
    )
    words.text(0.0, 1.0, "\n".join(texts), transform=words.transAxes, va="top", color=GREY, fontsize=8.0)


def _ordered(sizes: Sequence[Detectable], grade: Grade) -> list[Detectable]:
    """Return what could hide most first, then those without a usual size."""

    def largest_hidden(detectable: Detectable) -> float:
        usual = detectable.typical.of(grade)
        return usual[1] / detectable.minimum if usual is not None else float("inf")

    return sorted(sizes, key=largest_hidden)


def _size_bars(axes: Axes, sizes: Sequence[Detectable], rows: int, grade: Grade, first: bool) -> None:
    """Draw a row for each effect: usual sizes over the smallest that would be found."""
    axes.set_xscale("log")
    axes.set_xlim(_LOW, _HIGH)
    for k, detectable in enumerate(sizes):
        usual = detectable.typical.of(grade)
        smallest = shown(detectable.coefficient).text(detectable.minimum)
        if usual is None:
            axes.text(1.4, k, "no usual size", va="center", color=GREY, fontsize=7.5)
        else:
            _bar(axes, k, usual[0] / detectable.minimum, usual[1] / detectable.minimum)
            smallest += f"  ({size_range(usual, detectable.coefficient)})"
        axes.text(1.02, k, smallest, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
    axes.axvline(1.0, color="#222222", linewidth=1.2)
    rows_of(axes, [detectable.name for detectable in sizes], max(rows, 3), fontsize=8.0)
    label_ticks(axes.xaxis, ticks(_LOW, _HIGH))
    axes.set_xlabel("usual size / smallest size that would be found")
    if first:
        numbers = f"beside: smallest size found in 9 of 10 such runs (usual sizes, {GRADES[grade]})"
        axes.set_title(f"Left of 1, hatched: usual sizes that could hide in this run\n{numbers}", fontsize=9.0)


def _bar(axes: Axes, k: int, low: float, high: float) -> None:
    """Draw the part of usual sizes that could hide and the part that would be found, held within the axis."""
    if high <= _LOW or low >= _HIGH:
        edge, arrow, side = (_LOW, "◂", "left") if high <= _LOW else (_HIGH, "▸", "right")
        axes.text(edge, k, arrow, color=_HIDDEN if high <= _LOW else _SEEN, va="center", ha=side, fontsize=12.0)
        return
    low, high = max(low, _LOW), min(max(high, 1.1 * low), _HIGH)
    if low < 1.0:
        axes.barh(k, min(high, 1.0) - low, left=low, color=_HIDDEN, height=0.62, hatch="////", edgecolor="white",
                  linewidth=0.0)  # fmt: skip
    if high > 1.0:
        axes.barh(k, high - max(low, 1.0), left=max(low, 1.0), color=_SEEN, height=0.62)


def _unseen_texts(unseen: Sequence[Unseen]) -> list[str]:
    """Return what is not seen, all effects of one reason together."""
    together = dict[str, list[str]]()
    for each in unseen:
        together.setdefault(each.why, []).append(each.name)
    return [wrapped(f"{', '.join(names)}: {why}", _LINE) for why, names in together.items()]
