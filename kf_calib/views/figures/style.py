"""What all figures share: size, fonts, colours that colour-blind eyes tell apart, and how they become files.

Figures are matplotlib's, on white, for a report; they need no screen, no viewer and no graphics driver.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase

ACCELEROMETERS = ("#d55e00", "#009e73", "#0072b2")
"""One colour an accelerometer, from Okabe and Ito's palette; markers differ, too."""
MARKERS = ("o", "s", "^")
BEST, RUNNER_UP = "#111111", "#8a4fbf"
PLATFORM = "#5b3f9e"
"""What is of the three accelerometers together."""
GREY, PALE, BAND = "#6b6b6b", "#c9c9c9", "#00000018"
ALARM = "#b3001b"

KINDS = ("png", "svg", "pdf")
DPI = 150
_DPI_OF_NOTEBOOKS = 80
_RULES: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
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
    "svg.fonttype": "path",
    "svg.hashsalt": "kf_calib",  # the same figure is the same file
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


def blank(width_in: float = 11.0, height_in: float = 7.0) -> Figure:
    """An empty figure that arranges its panels by itself."""
    figure = Picture(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.06)  # type: ignore[union-attr]  # given just above
    return figure


def content_of(figure: Figure, kind: str, dpi: float = DPI, letters_as: Literal["path", "none"] = "path") -> bytes:
    """A figure as the bytes of a file of this kind: png, svg or pdf; without date, program or user.

    letters_as: of an SVG, ``path`` draws letters as they are here, ``none`` leaves them text, in the reader's typeface.
    """
    nothing = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
               "png": {"Software": None}}  # fmt: skip
    memory = io.BytesIO()
    with styled():
        matplotlib.rcParams["svg.fonttype"] = letters_as
        figure.savefig(memory, format=kind, dpi=dpi, metadata=nothing[kind])
    return memory.getvalue()


def letter(axes: Axes, text: str) -> None:
    """Write a few words in the upper left corner of a panel."""
    axes.text(0.015, 0.97, text, transform=axes.transAxes, va="top", ha="left", fontsize=8.5, color="#222222")


def say(where: FigureBase, text: str, colour: str = GREY) -> None:
    """Write a sentence in the middle of a figure, where there is nothing to draw."""
    axes = where.subplots()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", color=colour, wrap=True, fontsize=10.0)
