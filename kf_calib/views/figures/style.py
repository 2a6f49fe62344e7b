"""What all figures share: size, fonts, colours that colour-blind eyes tell apart, axes that can be read, and how they
become files. They are matplotlib's, on white, for a report; they need no screen, no viewer and no graphics driver.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import update_wrapper
from inspect import Signature, signature
from textwrap import fill
from typing import Any, Concatenate, Literal, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from kf_calib.views.notation import written

ACCELEROMETERS = ("#d55e00", "#009e73", "#0072b2")
"""One colour an accelerometer, from Okabe and Ito's palette; markers differ, too."""
MARKERS = ("o", "s", "^")
BEST, RUNNER_UP = "#111111", "#8a4fbf"
PLATFORM = "#5b3f9e"
"""What is of the three accelerometers together."""
GREY, PALE, BAND = "#6b6b6b", "#c9c9c9", "#00000018"
ALARM = "#b3001b"

Arguments = ParamSpec("Arguments")

KINDS = ("png", "svg", "pdf")
DPI = 150
_DPI_OF_NOTEBOOKS = 80
_RULES: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # as it comes out anyway; to work it out takes a tenth of the time of a figure
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": GREY,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": "#222222",
    "ytick.labelcolor": "#222222",
    "lines.linewidth": 1.5,
    "lines.markersize": 4.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.titlesize": 11.0,
    "path.simplify": True,
    "text.parse_math": False,  # names and formulas come from recordings: a $ in them is a $
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of this program, whatever the user has set."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RULES)
        yield


class Picture(Figure):
    """A figure that a notebook shows, whatever matplotlib's settings are there."""

    def _repr_png_(self) -> bytes:
        return content_of(self, "png", _DPI_OF_NOTEBOOKS)


def drawn_on(
    width_in: float = 11.0, height_in: float = 7.0
) -> Callable[[Callable[Concatenate[Figure, Arguments], object]], Callable[Arguments, Figure]]:
    """Make a function that draws on an empty figure, its first argument, one that gives the figure; of this size,
    unless it sets another first."""

    def given(draw: Callable[Concatenate[Figure, Arguments], object]) -> Callable[Arguments, Figure]:
        def figure_of(*arguments: Arguments.args, **named: Arguments.kwargs) -> Figure:
            with styled():
                figure = blank(width_in, height_in)
                draw(figure, *arguments, **named)
            return figure

        update_wrapper(figure_of, draw)
        others = [*signature(draw).parameters.values()][1:]
        figure_of.__signature__ = Signature(others, return_annotation="Figure")
        return figure_of

    return given


def blank(width_in: float = 11.0, height_in: float = 7.0) -> Figure:
    """An empty figure that arranges its panels by itself."""
    figure = Picture(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.06)  # type: ignore[union-attr]  # given just above
    return figure


def content_of(
    figure: Figure, kind: str, dpi: float = DPI, letters_as: Literal["path", "none"] = "path", names: str = "kf_calib"
) -> bytes:
    """A figure as the bytes of a file of this kind: png, svg or pdf; without date, program or user.

    Of an SVG: letters_as ``path`` draws letters as they are here, ``none`` leaves them text, in the reader's typeface;
    names of its parts are made from ``names``, so that a page can have several.
    """
    nothing = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
               "png": {"Software": None}}  # fmt: skip
    memory = io.BytesIO()
    with styled():
        matplotlib.rcParams.update({"svg.fonttype": letters_as, "svg.hashsalt": names})  # the same each time
        figure.savefig(memory, format=kind, dpi=dpi, metadata=nothing[kind])
    return memory.getvalue()


def mark_of(i: int | None) -> tuple[str, str]:
    """Marker and colour of accelerometer i, from 0; None: of the platform."""
    return ("D", PLATFORM) if i is None else (MARKERS[i], ACCELEROMETERS[i])


def accelerometer_of(symbol: str) -> int | None:
    """The number, from 0, of the accelerometer whose parameter a symbol is; None where it ends in no such number."""
    return int(symbol[-1]) - 1 if symbol[-1] in "123" else None


def say(where: FigureBase, text: str, colour: str = GREY) -> None:
    """Write a sentence in the middle of a figure, where there is nothing to draw."""
    axes = where.subplots()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", color=colour, wrap=True, fontsize=10.0)


def say_within(axes: Axes, text: str, up: float = 0.5) -> None:
    """Write in the middle of a panel, or so far up in it, why there is nothing to draw."""
    axes.text(0.5, up, text, transform=axes.transAxes, ha="center", va="center", color=GREY)


def rows_of(axes: Axes, names: Sequence[str], count: int = 0, **text: Any) -> None:
    """Name the rows of a panel from above, as bars lie; count: the rows that there is room for, where it is more."""
    axes.set_yticks(range(len(names)), names, **text)
    axes.set_ylim(max(len(names), count) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


_LEAST_RANGE = 4.0  # between the ends of an axis, so that two labels at least are on it
_FEWEST = 3  # decades with labels; where there are fewer, 2 and 5 have labels, too
_LABELS = 6  # at most, of decades


def log_scale(axes: Axes, values: Any, which: Literal["x", "y"] = "y", room: float = 0.0) -> None:
    """Make an axis logarithmic over all positive ``values``, and write numbers at its ticks; none without a value.

    room: share of the axis that is left free above them, for text.
    """
    flat = np.concatenate([np.asarray(own, float).ravel() for own in values] or [np.zeros(0)])
    flat = flat[np.isfinite(flat) & (flat > 0.0)]
    low, high = (float(flat.min()) / 1.15, float(flat.max()) * 1.15) if flat.size else (0.5, 20.0)
    if high < _LEAST_RANGE * low:
        middle = math.sqrt(low * high)
        low, high = middle / math.sqrt(_LEAST_RANGE), middle * math.sqrt(_LEAST_RANGE)
    high *= (high / low) ** (room / (1.0 - room))
    axis = axes.yaxis if which == "y" else axes.xaxis
    (axes.set_yscale if which == "y" else axes.set_xscale)("log")
    (axes.set_ylim if which == "y" else axes.set_xlim)(low, high)
    label_ticks(axis, ticks(low, high) if flat.size else [])


def label_ticks(axis: Axis, values: Sequence[float]) -> None:
    """Give a logarithmic axis these ticks, with their values as labels, and no others."""
    axis.set_major_locator(FixedLocator(values))
    axis.set_major_formatter(FuncFormatter(lambda value, _: written(value)))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def ticks(low: float, high: float) -> list[float]:
    """Values with labels on a logarithmic axis from ``low`` to ``high``."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    decades = sum(low <= 10.0**power <= high for power in range(first, last + 1))
    steps = (1.0,) if decades >= _FEWEST else (1.0, 2.0, 5.0)
    every = max(1, math.ceil(decades / _LABELS))
    found = [step * 10.0**power for power, step in itertools.product(range(first, last + 1, every), steps)]
    return [float(f"{value:.6g}") for value in found if low <= value <= high]


def whole_numbers(axes: Axes, first: float, last: float, words: str = "orientation") -> None:
    """Let the x axis count orientations from ``first`` to ``last``; 0 is what was known before them."""
    room = max(0.03 * (last - first), 0.5)
    axes.set_xlim(first - room, last + room)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    axes.set_xlabel(f"{words} (0: before)" if words and first == 0 else words)


UNIT_KINDS = {"rad": "angle", "1": "scale factor", "m/s^2": "bias"}


_WIDE = 4


def panels_of(figure: Figure, count: int, around_in: float, high_in: float) -> list[Axes]:
    """So many panels, four a row, on a figure that is as high as its rows and what is around them."""
    high = max(-(-count // _WIDE), 1)
    figure.set_size_inches(13.0, around_in + high_in * high)
    panels = [*figure.subplots(high, _WIDE, sharex=True, squeeze=False).flat]
    for axes in panels[count:]:
        axes.set_axis_off()
    return panels[:count]


def say_once(figure: FigureBase, panels: Iterable[Axes], place: str = "outside lower left", columns: int = 6) -> None:
    """Say once beside the panels what is drawn in them."""
    said = dict[str, Any]()
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        said = dict(zip(labels, handles, strict=True)) | said
    if said:
        figure.legend([*said.values()], [*said], loc=place, ncols=columns)  # type: ignore[arg-type]  # "outside ..."


def dated(axes: Axes) -> None:
    """Let the x axis be of dates, with few short labels."""
    locator = AutoDateLocator(minticks=3, maxticks=5)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=False))


def wrapped(text: str, width: int) -> str:
    """A text in lines of at most so many letters, broken between words only: names of effects stay whole."""
    return fill(text, width, break_on_hyphens=False, break_long_words=False)
