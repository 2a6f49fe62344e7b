"""Figures as SVG within a page: greys and colours follow the page's light or dark, and many points become a picture."""

from __future__ import annotations

import re

from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from kf_calib.views.figures.style import content_of

_MANY = 3000  # points of a figure, above which those of larger panels are drawn as a picture: the file stays small
_OF_PANEL = 60
_PICTURE_DPI = 220
_COLOUR = re.compile(r"(fill|stroke|stop-color): (#[0-9a-f]{6})")
_NAME = re.compile(r'(\bid="|href="#|url\(#)')
_PLACES = re.compile(r' (?:d|x|y)="[^"]*"')
_DECIMALS = re.compile(r"(\d\.\d\d)\d+")  # more than a screen or printer shows; not of scales, which multiply


def inline_svg(figure: Figure, prefix: str) -> str:
    """The figure as an ``svg`` element whose names begin with ``prefix``, so that several can be in one page.

    A grey of the figure is mixed of the page's ``--ink`` and ``--paper``, black being ink alone; of other colours
    ``--keep`` says how much is kept beside white. On white paper with black ink, colours are those of the figure.
    """
    figure.patch.set_visible(False)
    for axes in figure.axes:
        axes.patch.set_visible(False)
    _draw_many_points_as_picture(figure)
    text = content_of(figure, "svg", _PICTURE_DPI).decode()
    text = text[text.index("<svg") :].strip()
    text = _NAME.sub(rf"\g<1>{prefix}-", _COLOUR.sub(_mixed, text))
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2)
    return _PLACES.sub(lambda found: _DECIMALS.sub(r"\1", found[0]), text)


def _draw_many_points_as_picture(figure: Figure) -> None:
    lines = [line for axes in figure.axes for line in axes.lines]
    if sum(len(line.get_xdata()) for line in lines) <= _MANY:  # type: ignore[arg-type]  # arrays, as they were given
        return
    for line in lines:
        line.set_rasterized(len(line.get_xdata()) > _OF_PANEL)  # type: ignore[arg-type]
    for axes in figure.axes:
        for bars in axes.collections:
            if isinstance(bars, LineCollection):
                bars.set_rasterized(len(bars.get_segments()) > _OF_PANEL)


def _mixed(found: re.Match[str]) -> str:
    """Return a colour as itself, for old browsers, and then as a mixture of the page's colours."""
    what, colour = found.groups()
    parts = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    if max(parts) - min(parts) <= 8:
        mixture = f"var(--ink) {100 - sum(parts) / 7.65:.0f}%, var(--paper)"
    else:
        mixture = f"{colour} var(--keep), #ffffff"
    return f"{what}: {colour}; {what}: color-mix(in srgb, {mixture})"
