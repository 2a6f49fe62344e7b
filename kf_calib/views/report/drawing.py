"""Figures as SVG within a page: greys and colours follow the page's light or dark, and many points become a picture."""

from __future__ import annotations

import io
import re
from base64 import b64decode, b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import Collection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from PIL import Image

from kf_calib.views.figures.style import content_of, styled

_MOST = 1_200_000  # characters of all figures of a page
_MANY = 60  # points of one kind in a panel that are
_PICTURE_DPI = 150
_LAYOUT_DPI = 600  # letters are as wide as in SVG, not moved to whole pixels
_COLOUR = re.compile(r"\b(fill|stroke|stop-color): #([0-9a-f]{6})\b")
_PICTURE = re.compile(r"(?<=data:image/png;base64,)[\w+/=\s]+")
_SHADES = 64  # of a picture of points, which are few colours and their edges
_BETWEEN = re.compile(r"<metadata>.*?</metadata>|<!--.*?-->|\s*\n\s*", re.DOTALL)
_GROUP = re.compile(r'<g id="[^"]*"')  # nothing refers to the name of a group
_NAME = re.compile(r'(\bid="|href="#|url\(#)')
_PLACES = re.compile(r' (?:d|x|y)="[^"]*"')
_LETTER = re.compile(r'(<use href="#[^"]*") transform="translate\(([-\d.]+) 0\)"')
_MARKS = re.compile(r'<g([^>]*)>((?:<use [^>]* style="[^"]*"/>)+)</g>')
_STYLE = re.compile(r' style="[^"]*"')
_DECIMALS = re.compile(r"(\d\.\d\d)\d+")  # more than a screen or printer shows; not of scales, which multiply


@dataclass(eq=False)
class Drawing:
    """A figure in a page, with the title that says what is to be seen; names in its SVG begin with ``prefix``.

    A grey of the figure is mixed of the page's ``--ink`` and ``--paper``, black being ink alone; of other colours
    ``--keep`` says how much is kept beside white. On white paper with black ink, colours are those of the figure.
    ``on_white``: a picture, or a figure in which a map of colours gives numbers: it keeps its colours, on a white card.
    """

    kind: ClassVar[str] = "drawing"
    title: str
    figure: Figure
    prefix: str
    on_white: bool = False
    markup: str = ""

    def __post_init__(self) -> None:
        self.on_white = any(isinstance(each, AxesImage | QuadMesh) for axes in self.figure.axes
                            for each in axes.get_children())  # fmt: skip
        for patch in (self.figure.patch, *(axes.patch for axes in self.figure.axes)):
            patch.set_visible(False)
        _arrange(self.figure)
        self.markup = _element(self.figure, self.prefix, self.on_white)

    def with_points_as_picture(self) -> None:
        """Draw again, the points of each kind as a picture where there are many."""
        for axes in self.figure.axes:
            for artist in axes.get_children():
                artist.set_rasterized(_is_of_many_points(artist))
        self.markup = _element(self.figure, self.prefix, self.on_white)

    def as_picture(self) -> None:
        """Draw again, all of it as a picture, on white in the dark, too."""
        self.figure.patch.set_visible(True)
        content = b64encode(_of_few_shades(content_of(self.figure, "png", _PICTURE_DPI))).decode()
        self.markup, self.on_white = f'<img alt="" src="data:image/png;base64,{content}">', True


def fit(drawings: Sequence[Drawing], most: int = _MOST) -> None:
    """Make pictures of points, and then of whole figures, the largest first, until all have ``most`` characters."""
    for smaller in (Drawing.with_points_as_picture, Drawing.as_picture):
        for heavy in sorted(drawings, key=lambda heavy: -len(heavy.markup)):
            if sum(len(drawing.markup) for drawing in drawings) <= most:
                return
            smaller(heavy)


def _arrange(figure: Figure) -> None:
    """Give the panels their places once: else each time that it is saved, which draws all of it twice."""
    engine = figure.get_layout_engine()
    with styled():
        if engine is not None:
            dpi = figure.get_dpi()
            figure.set_dpi(_LAYOUT_DPI)
            engine.execute(figure)
            figure.set_dpi(dpi)
        figure.set_layout_engine(None)


def _element(figure: Figure, prefix: str, on_white: bool) -> str:
    """Return the ``svg`` element, as wide as its place, with the colours that it uses defined in its style."""
    text = _short(content_of(figure, "svg", _PICTURE_DPI).decode())
    colours = sorted({colour for _, colour in _COLOUR.findall(text)})
    mixed = "; ".join(f"--c{colour}: {f'#{colour}' if on_white else _mixture(colour)}" for colour in colours)
    mixed += "; fill: #000000" * on_white
    text = _NAME.sub(rf"\g<1>{prefix}-", _COLOUR.sub(r"\1: var(--c\2)", text))
    return _PICTURE.sub(_smaller, text).replace("<svg", f'<svg style="{mixed}"', 1)


def _short(text: str) -> str:
    """Return the ``svg`` element of a file of matplotlib's with all that is seen, in half as many characters."""
    text = _GROUP.sub("<g", _BETWEEN.sub("", text[text.index("<svg") :]))
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2).replace("xlink:href", "href")
    text = _LETTER.sub(r'\1 x="\2"', text.replace("DejaVuSans-", ""))
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
