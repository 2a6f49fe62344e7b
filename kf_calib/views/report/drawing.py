"""Figures as SVG within a page: greys and colours follow the page's light or dark, and many points become a picture."""

from __future__ import annotations

import gc
import io
import os
import re
import signal
import sys
import warnings
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from typing import ClassVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import Collection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from PIL import Image

from kf_calib.views.figures.style import content_of, styled

_MOST = 200_000  # characters of a figure
_MOST_PROCESSES = 8  # that draw: no figure is so small that more would be quicker
_MANY = 150  # points of one kind in a panel that are
_PICTURE_DPI = 150
_POINTS = 72  # an inch, the unit of SVG
_COLOUR = re.compile(r"\b(fill|stroke|stop-color): #([0-9a-f]{6})\b")
_PICTURE = re.compile(r"(?<=data:image/png;base64,)[\w+/=\s]+")
_SHADES = 64  # of a picture of points, which are few colours and their edges
_BETWEEN = re.compile(r"<metadata>.*?</metadata>|<!--.*?-->|\s*\n\s*", re.DOTALL)
_GROUP = re.compile(r'<g id="[^"]*"')  # nothing refers to the name of a group
_NAME = re.compile(r'(\bid="|href="#|url\(#)')
_PLACES = re.compile(r' (?:d|x|y|transform)="[^"]*"')
_TYPEFACE = re.compile(r" font-family: [^;\"]*;?")  # which the page states once
_UNTURNED = re.compile(r' transform="rotate\(-?0 [^"]*"')
_MARKS = re.compile(r'<g([^>]*)>((?:<use [^>]* style="[^"]*"/>)+)</g>')
_STYLE = re.compile(r' style="[^"]*"')
_DECIMALS = re.compile(r"(\d\.\d\d)\d+")  # more than a screen or printer shows

_given = list["Drawing"]()
"""What a copy of the process draws."""


@dataclass(eq=False)
class Drawing:
    """A figure in a page, with the title that says what is to be seen, and what draws it; names in its markup begin
    with ``prefix``. Markup is there once it is drawn.

    A grey of the figure is mixed of the page's ``--ink`` and ``--paper``, black being ink alone; of other colours
    ``--keep`` says how much is kept beside white. On white paper with black ink, colours are those of the figure.
    ``on_white``: a picture, or a figure in which a map of colours gives numbers: it keeps its colours, on a white card.
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
    artists = [each for axes in figure.axes for each in axes.get_children()]
    for artist in artists:
        artist.set_rasterized(_is_of_many_points(artist))
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_visible(False)
    _arrange(figure)
    on_white = any(isinstance(artist, AxesImage | QuadMesh) for artist in artists)
    markup = _element(figure, prefix, on_white)
    return (markup, on_white) if len(markup) <= _MOST else (_picture(figure), True)


def _arrange(figure: Figure) -> None:
    """Give the panels their places once, with letters as wide as in SVG: savefig would draw all of it to do so."""
    engine = figure.get_layout_engine()
    with styled():
        figure.set_dpi(_POINTS)
        FigureCanvasSVG(figure)
        if engine is not None:
            engine.execute(figure)
        figure.set_layout_engine(None)


def _picture(figure: Figure) -> str:
    """Return the element of a figure that is a picture, all of it."""
    figure.patch.set_visible(True)
    content = b64encode(_of_few_shades(content_of(figure, "png", _PICTURE_DPI))).decode()
    return f'<img alt="" src="data:image/png;base64,{content}">'


def _element(figure: Figure, prefix: str, on_white: bool) -> str:
    """Return the ``svg`` element, as wide as its place, with the colours that it uses defined in its style."""
    text = _short(content_of(figure, "svg", _PICTURE_DPI, letters_as="none").decode())
    colours = sorted({colour for _, colour in _COLOUR.findall(text)})
    mixed = "; ".join(f"--c{colour}: {f'#{colour}' if on_white else _mixture(colour)}" for colour in colours)
    mixed += "; fill: #000000" * on_white
    text = _NAME.sub(rf"\g<1>{prefix}-", _COLOUR.sub(r"\1: var(--c\2)", text))
    return _PICTURE.sub(_smaller, text).replace("<svg", f'<svg style="{mixed}"', 1)


def _short(text: str) -> str:
    """Return the ``svg`` element of a file of matplotlib's with all that is seen, in half as many characters."""
    text = _GROUP.sub("<g", _BETWEEN.sub("", text[text.index("<svg") :]))
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2).replace("xlink:href", "href")
    text = _UNTURNED.sub("", _TYPEFACE.sub("", text))
    return _MARKS.sub(_with_one_style, _PLACES.sub(lambda found: _DECIMALS.sub(r"\1", found[0]), text))


def _with_one_style(match: re.Match[str]) -> str:
    """Return a group of marks that look alike with their style said once."""
    group, marks = match.groups()
    styles = set(_STYLE.findall(marks))
    return f"<g{group}{styles.pop()}>{_STYLE.sub('', marks)}</g>" if len(styles) == 1 else match[0]


def _smaller(found: re.Match[str]) -> str:
    return b64encode(_of_few_shades(b64decode(found[0]))).decode()


def _of_few_shades(png: bytes) -> bytes:
    """Return a PNG with no more shades than a drawing needs."""
    memory = io.BytesIO()
    picture = Image.open(io.BytesIO(png)).convert("RGBA")
    picture.quantize(_SHADES, Image.Quantize.FASTOCTREE).save(memory, "PNG", optimize=True)
    return memory.getvalue()


def _is_of_many_points(artist: Artist) -> bool:
    """Tell whether an artist is of many points in a colour: greys must follow the page, and a curve is small."""
    if isinstance(artist, Line2D):
        has_marks = artist.get_marker() not in ("None", "none", "", " ", None)
        return has_marks and np.size(artist.get_xdata()) > _MANY and not _is_grey(artist.get_color())
    if isinstance(artist, Collection):
        colours = [*artist.get_edgecolor(), *artist.get_facecolor()]
        count = max(len(artist.get_paths()), np.shape(artist.get_offsets())[0])
        return count > _MANY and not all(map(_is_grey, colours))
    return False


def _is_grey(colour: object) -> bool:
    return bool(np.ptp(to_rgb(colour)) < 0.04)  # type: ignore[arg-type]  # whatever an artist has for a colour


def _mixture(colour: str) -> str:
    """Return a colour as a mixture of the page's colours."""
    parts = [int(colour[k : k + 2], 16) for k in (0, 2, 4)]
    if _is_grey(f"#{colour}"):
        return f"color-mix(in srgb, var(--ink) {100 - sum(parts) / 7.65:.0f}%, var(--paper))"
    return f"color-mix(in srgb, #{colour} var(--keep), #ffffff)"
