"""What a misfit may be, and with what probability: families of effects, and below them single explanations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.diagnosis.hypothesis_table import LISTED, NOISE, NONE, NOTHING, SURE, Hypothesis, HypothesisTable
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.views.diagnosis import name_of
from kf_calib.views.figures.style import BEST, GREY, PALE, blank, say, styled
from kf_calib.views.figures.symbols import wrapped

_FAMILIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's, the likeliest first
_NO_EFFECT = {NOTHING: PALE, NOISE: GREY, NONE: BEST}
_NAME = 44  # letters of a name in a line
_LINE_IN = 0.2
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


def hypotheses(diagnosis: Diagnosis) -> Figure:
    """The probability of each family of effects, and of each explanation in the colours of its families.

    Those of less than 1 % are drawn together. Beside each explanation stands the logarithm of its odds to the next.
    """
    with styled():
        if diagnosis.table is None:
            figure = blank(11.0, 2.0)
            say(figure, wrapped(diagnosis.verdict, 110))
            return figure
        lines = sum(bar.lines + 0.5 for bars in _bars(diagnosis.table) for bar in bars)
        figure = blank(11.0, 1.9 + _LINE_IN * lines)
        draw_hypotheses(figure, diagnosis.table)
    return figure


def draw_hypotheses(figure: FigureBase, table: HypothesisTable) -> None:
    """The same on a part of a figure."""
    above, below = both = _bars(table)
    families, explanations = figure.subplots(
        2, 1, sharex=True, height_ratios=[sum(bar.lines + 0.5 for bar in bars) for bars in both]
    )
    _draw(families, above, "Families of what is missing (two effects at once count in both of theirs)")
    _draw(explanations, below, "Explanations, in the colours of their families", "log₁₀ odds\nto the next")
    explanations.set_xlabel("probability, %; dashes: from 95 % on it is taken for sure", loc="left")


def _bars(table: HypothesisTable) -> tuple[list[_Bar], list[_Bar]]:
    """Return the bars of families and of explanations, the likeliest first, the unlikely as one at the end."""
    told = [family for family, share in table.families.items() if share >= LISTED]
    own = iter(_FAMILIES)
    colours = {family: _NO_EFFECT.get(family) or next(own, PALE) for family in told}
    families = [_Bar(family, table.families[family], (colours[family],)) for family in told]
    others = [family for family in table.families if family not in told]
    families += [_Bar(_others(len(others)), table.probability_of_families(others), (PALE,))] if others else []
    explanations = [
        _Bar(_name(row), row.probability, tuple(colours.get(each, PALE) for each in row.families),
             "" if odds is None else f"{odds:.1f}")
        for row, odds in zip(table.rows, table.log10_odds, strict=True) if row in table.listed
    ]  # fmt: skip
    rest = [row.probability for row in table.rows if row not in table.listed]
    explanations += [_Bar(_others(len(rest)), sum(rest), (PALE,))] if rest else []
    return families, explanations


def _others(count: int) -> str:
    return f"{count} other{'s' * (count > 1)}"


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
        axes.annotate(format_probability(bar.probability), (100.0 * bar.probability, middle), xytext=(4, 0),
                      textcoords="offset points", va="center", fontsize=8.5)  # fmt: skip
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
