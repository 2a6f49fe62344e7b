"""All figures of a result, and how they are saved."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import singledispatch
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.errors import InputError
from kf_calib.exchange.history import History
from kf_calib.support.output_files import write_whole
from kf_calib.views.figures import style
from kf_calib.views.figures.history import history
from kf_calib.views.figures.residuals import residuals, what_they_go_with

Figures = Mapping[str, Callable[[], Figure]]
"""Title of each figure, and what draws it."""


@singledispatch
def figures(result: Any) -> Figures:
    """The figures of a result by title, the one that tells most first; nothing is drawn before it is called for."""
    raise TypeError(f"there is no figure of {type(result).__name__}: give the result of calibrate, diagnose, improve, "
                    "compare, plan or history.")  # fmt: skip


@figures.register
def _(found: Diagnosis) -> Figures:
    return {
        "Where the model fails": lambda: residuals(found),
        "What the residuals go with": lambda: what_they_go_with(found),
    }


@figures.register
def _(found: History) -> Figures:
    return {"The calibrations over time": lambda: history(found)}


def save(what: Figure | Figures, path: str | Path, kind: str = "", width_px: int | None = None) -> Path:
    """Write a figure as a PNG, SVG or PDF; of several, the first, or in a PDF all of them. The same is the same file.

    kind: ``png``, ``svg`` or ``pdf``; what the name ends in where it is not given. width_px: of a PNG; 150 pixels an
    inch where it is not given. Raises InputError for another kind, or where the file cannot be written.
    """
    path = Path(path)
    kind = kind or path.suffix.lower()[1:]
    if kind not in style.KINDS:
        raise InputError(f"{path}: a figure is saved as {', '.join(style.KINDS)}: let its name end in one of these.")
    if isinstance(what, Figure):
        what = {"": lambda figure=what: figure}
    if kind == "pdf":
        write_whole(path, _pages(what))
    else:
        figure = next(iter(what.values()))()
        dpi = style.DPI if width_px is None else width_px / figure.get_figwidth()
        write_whole(path, style.content_of(figure, kind, dpi))
    return path


def _pages(what: Figures) -> bytes:
    """Return a PDF with a figure a page, its title above it."""
    memory = io.BytesIO()
    with style.styled(), PdfPages(memory, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as pages:
        for title, draw in what.items():
            figure = draw()
            if title:
                figure.suptitle(title, x=0.01, ha="left")
            pages.savefig(figure)
    return memory.getvalue()
