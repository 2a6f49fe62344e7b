"""What could hide in a run: the smallest detectable size of each effect against usual sizes, and what is not seen."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.diagnosis.detectability import Detectable, Unseen
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects.effect import Grade
from kf_calib.views.console import GRADES, size_range
from kf_calib.views.figures.log_axis import label_axis
from kf_calib.views.figures.style import GREY, blank, styled

_LOW, _HIGH = 0.01, 1000.0  # smallest detectable sizes that the axis spans
_SEEN, _HIDDEN = "#0072b2", "#e69f00"  # of Okabe and Ito's palette
_ROW_IN = 0.23
_LINE = 150  # letters of a line below the panels


def detection_limits(found: Diagnosis) -> Figure:
    """Usual sizes of each effect over the smallest that this run would find; below, what it cannot see, and why.

    The part of a bar on the left of 1 could hide in the run: it is drawn in another colour. Usual sizes are those of
    sensors of the grade that the noise of the run is of.
    """
    half = (len(found.detectable) + 1) // 2
    lines = sum(len(text.splitlines()) for text in _unseen_texts(found.unseen))
    with styled():
        figure = blank(11.0, max(7.0, 1.4 + _ROW_IN * half + 0.17 * (lines + 2)))
        draw_detection_limits(figure, found)
    return figure


def draw_detection_limits(figure: FigureBase, found: Diagnosis) -> None:
    """The same on a part of a figure."""
    sizes, texts = _ordered(found.detectable, found.grade), _unseen_texts(found.unseen)
    half = (len(sizes) + 1) // 2
    lines = sum(len(text.splitlines()) for text in texts)
    grid = figure.add_gridspec(2, 2, height_ratios=(_ROW_IN * max(half, 3) + 0.7, 0.17 * (lines + 2)))
    for column, own in enumerate((sizes[:half], sizes[half:])):
        _bars(figure.add_subplot(grid[0, column]), own, half, found.grade, bool(column))
    below = figure.add_subplot(grid[1, :])
    below.set_axis_off()
    below.set_title("Not to be seen in this run at any size" if texts else "Every effect could be seen in this run")
    below.text(0.0, 1.0, "\n".join(texts), transform=below.transAxes, va="top", color=GREY, fontsize=8.0)


def _ordered(sizes: Sequence[Detectable], grade: Grade) -> list[Detectable]:
    """Return what could hide most first, then those without a usual size."""

    def largest_hidden(each: Detectable) -> float:
        usual = each.typical.of(grade)
        return usual[1] / each.minimum if usual is not None else float("inf")

    return sorted(sizes, key=largest_hidden)


def _bars(axes: Axes, sizes: Sequence[Detectable], rows: int, grade: Grade, second: bool) -> None:
    """Draw a row for each effect: usual sizes over the smallest that would be found."""
    axes.set_xscale("log")
    axes.set_xlim(_LOW, _HIGH)
    for k, each in enumerate(sizes):
        usual = each.typical.of(grade)
        smallest = f"{each.shown_minimum:.3g} {each.shown_unit}"
        if usual is None:
            axes.text(_LOW * 1.2, k, "no usual size is known", va="center", color=GREY, fontsize=7.5)
        else:
            _bar(axes, k, usual[0] / each.minimum, usual[1] / each.minimum)
            smallest += f"  ({size_range(usual, each.coefficient)})"
        axes.text(1.02, k, smallest, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
    axes.axvline(1.0, color="#222222", linewidth=1.2)
    axes.set_yticks(range(len(sizes)), [each.name for each in sizes], fontsize=8.0)
    axes.set_ylim(max(rows, 3) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    label_axis(axes.xaxis, _LOW, _HIGH)
    axes.set_xlabel("usual size / smallest size that would be found")
    right = f"right: smallest size found in 9 of 10 runs (usual, {GRADES[grade]})"
    axes.set_title(right if second else "What could hide here: usual sizes left of 1 (orange)", fontsize=9.0)


def _bar(axes: Axes, k: int, low: float, high: float) -> None:
    """Draw the part of usual sizes that could hide and the part that would be found, held within the axis."""
    low, high = min(max(low, _LOW), 0.9 * _HIGH), min(max(high, 1.15 * _LOW), _HIGH)
    high = max(high, 1.15 * low)
    if low < 1.0:
        axes.barh(k, min(high, 1.0) - low, left=low, color=_HIDDEN, height=0.62, hatch="....", edgecolor="white",
                  linewidth=0.0)  # fmt: skip
    if high > 1.0:
        axes.barh(k, high - max(low, 1.0), left=max(low, 1.0), color=_SEEN, height=0.62)


def _unseen_texts(unseen: Sequence[Unseen]) -> list[str]:
    """Return what is not seen, all effects of one reason together."""
    together = dict[str, list[str]]()
    for each in unseen:
        together.setdefault(each.why, []).append(each.name)
    return [fill(f"{', '.join(names)}: {why}", _LINE, subsequent_indent="    ") for why, names in together.items()]
