"""Figures within a page: SVG of matplotlib's own, which the page turns over in the dark; many points are a picture."""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from typing import ClassVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import Collection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from kf_calib.views.figures.style import content_of

_MOST = 400_000  # characters of a figure
_MOST_PROCESSES = 8  # that draw: no figure is so small that more would be quicker
_MANY = 150  # points of one kind in a panel that are
_PICTURE_DPI = 150

_given = list["Drawing"]()
"""What a copy of the process draws."""


@dataclass(eq=False)
class Drawing:
    """A figure in a page, with the title that says what is to be seen, and what draws it; names in its markup are made
    with ``prefix``. Markup is there once it is drawn.

    on_white: a picture, or a figure in which a map of colours gives numbers: a dark page shows it on a white card, and
    turns over black and white of all others.
    """

    kind: ClassVar[str] = "drawing"
    title: str
    draw: Callable[[], Figure]
    prefix: str
    markup: str = ""
    on_white: bool = False


def draw_all(drawings: Sequence[Drawing]) -> None:
    """Draw each figure once, and keep its markup alone; copies of this process draw on all cores.

    Where a running process cannot be copied, as on Windows, this one draws: a new one would take as long to begin.
    """
    processes = min(_cores(), len(drawings))
    if processes <= 1:
        markups = [_markup(drawing.draw, drawing.prefix) for drawing in drawings]
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads of BLAS, which is ready to be copied
            pool = get_context("fork").Pool(processes, initializer=_be_given, initargs=(drawings,))
        with pool:
            markups = pool.map(_markup_of_given, range(len(drawings)), chunksize=1)
    for drawing, (markup, on_white) in zip(drawings, markups, strict=True):
        drawing.markup, drawing.on_white = markup, on_white


def _cores() -> int:
    """Return how many processes may draw at once."""
    return min(len(os.sched_getaffinity(0)), _MOST_PROCESSES) if sys.platform == "linux" else 1


def _be_given(drawings: Sequence[Drawing]) -> None:
    """Take over what a copy of the process draws; Ctrl-C is for the process that waits for it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.disable()  # a copy ends after a few figures
    _given[:] = drawings


def _markup_of_given(k: int) -> tuple[str, bool]:
    return _markup(_given[k].draw, _given[k].prefix)


def _markup(draw: Callable[[], Figure], prefix: str) -> tuple[str, bool]:
    """Return a figure's markup, and whether it stands on white.

    Points of a kind are a picture where there are many in a panel, and the whole figure is one where it would be larger
    than ``_MOST``.
    """
    figure = draw()
    artists = [artist for axes in figure.axes for artist in axes.get_children()]
    for artist in artists:
        artist.set_rasterized(_has_many_points(artist))
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_visible(False)
    text = content_of(figure, "svg", _PICTURE_DPI, letters_as="none", names=prefix).decode()
    if len(text) <= _MOST:
        return text[text.index("<svg") :], any(isinstance(artist, AxesImage | QuadMesh) for artist in artists)
    figure.patch.set_visible(True)
    return (
        f'<img alt="" src="data:image/png;base64,{b64encode(content_of(figure, "png", _PICTURE_DPI)).decode()}">',
        True,
    )


def _has_many_points(artist: Artist) -> bool:
    if isinstance(artist, Line2D):
        return artist.get_marker() not in ("None", "none", "", " ", None) and np.size(artist.get_xdata()) > _MANY
    return isinstance(artist, Collection) and max(len(artist.get_paths()), np.shape(artist.get_offsets())[0]) > _MANY
