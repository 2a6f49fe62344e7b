"""What could hide in a run: the smallest detectable size of each effect against usual sizes, and what is not seen."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.diagnosis.detectability import Detectable, Unseen
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects.effect import Grade
from kf_calib.support.units import shown
from kf_calib.views.console import GRADES, size_range
from kf_calib.views.figures.scales import label_axis
from kf_calib.views.figures.style import GREY, blank, styled
from kf_calib.views.figures.symbols import wrapped

_LOW, _HIGH = 0.01, 1000.0  # smallest detectable sizes that the axis spans
_SEEN, _HIDDEN = "#0072b2", "#e69f00"  # of Okabe and Ito's palette
_ROW_IN, _LINE_IN = 0.23, 0.14
_LINE = 150  # letters of a line below the panels


def detection_limits(diagnosis: Diagnosis) -> Figure:
    """Usual sizes of each effect over the smallest that this run would find; below, what it cannot see, and why.

    The part of a bar on the left of 1 could hide in the run: it is drawn in another colour. Usual sizes are those of
    sensors of the grade that the noise of the run is of.
    """
    half = (len(diagnosis.detectable) + 1) // 2
    below_in = _LINE_IN * (2 + sum(len(text.splitlines()) for text in _unseen_texts(diagnosis.unseen)))
    height_in = max(7.0, 1.2 + _ROW_IN * half + below_in)
    with styled():
        figure = blank(11.0, height_in)
        draw_detection_limits(figure, diagnosis, below_in / height_in)
    return figure


def draw_detection_limits(figure: FigureBase, diagnosis: Diagnosis, below: float) -> None:
    """The same on a part of a figure; below: share of its height for what is not seen."""
    sizes, texts = _ordered(diagnosis.detectable, diagnosis.grade), _unseen_texts(diagnosis.unseen)
    half = (len(sizes) + 1) // 2
    grid = figure.add_gridspec(2, 2, height_ratios=(1.0 - below, below))
    for column, half_of_sizes in enumerate((sizes[:half], sizes[half:])):
        _bars(figure.add_subplot(grid[0, column]), half_of_sizes, half, diagnosis.grade, not column)
    words = figure.add_subplot(grid[1, :])
    words.set_axis_off()
    words.set_title("Not to be seen in this run at any size" if texts else "Every effect could be seen in this run")
    words.text(0.0, 1.0, "\n".join(texts), transform=words.transAxes, va="top", color=GREY, fontsize=8.0)


def _ordered(sizes: Sequence[Detectable], grade: Grade) -> list[Detectable]:
    """Return what could hide most first, then those without a usual size."""

    def largest_hidden(each: Detectable) -> float:
        usual = each.typical.of(grade)
        return usual[1] / each.minimum if usual is not None else float("inf")

    return sorted(sizes, key=largest_hidden)


def _bars(axes: Axes, sizes: Sequence[Detectable], rows: int, grade: Grade, first: bool) -> None:
    """Draw a row for each effect: usual sizes over the smallest that would be found."""
    axes.set_xscale("log")
    axes.set_xlim(_LOW, _HIGH)
    for k, detectable in enumerate(sizes):
        usual = detectable.typical.of(grade)
        smallest = shown(detectable.coefficient).text(detectable.minimum)
        if usual is None:
            axes.text(1.4, k, "no usual size is known", va="center", color=GREY, fontsize=7.5)
        else:
            _bar(axes, k, usual[0] / detectable.minimum, usual[1] / detectable.minimum)
            smallest += f"  ({size_range(usual, detectable.coefficient)})"
        axes.text(1.02, k, smallest, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
    axes.axvline(1.0, color="#222222", linewidth=1.2)
    axes.set_yticks(range(len(sizes)), [detectable.name for detectable in sizes], fontsize=8.0)
    axes.set_ylim(max(rows, 3) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    label_axis(axes.xaxis, _LOW, _HIGH)
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
