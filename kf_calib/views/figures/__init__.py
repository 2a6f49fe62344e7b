"""Figures of results for reports, by matplotlib: ``kf_calib.plot``.

    found = kf_calib.diagnose("run.mcap")
    kf_calib.plot.residuals(found)                  # a matplotlib Figure, shown by a notebook
    kf_calib.plot.save(kf_calib.plot.figures(found), "run.pdf")

``figures`` gives all figures of a result, by title, the one that tells most first; each is drawn when it is asked for.
A function of each figure has the same name here as in its module.
"""

from __future__ import annotations

from kf_calib.errors import InputError, need

need("matplotlib", "plot", "a figure")

# ruff: noqa: E402  # after the check
import io
import sys
from collections.abc import Callable, Mapping
from functools import singledispatch
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from kf_calib.design.orientation_plan import Plan
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.engine_comparison import Comparison
from kf_calib.estimation.results import Calibration
from kf_calib.exchange.history import History
from kf_calib.noise.rest_noise import RestNoise
from kf_calib.support.output_files import write_whole
from kf_calib.views.figures import style
from kf_calib.views.figures.convergence import convergence, estimates, history
from kf_calib.views.figures.engines import allan_deviation, three_ways, whiteness
from kf_calib.views.figures.explanations import detection_limits, hypotheses, suspects
from kf_calib.views.figures.improvement import improvement
from kf_calib.views.figures.noise import noise
from kf_calib.views.figures.orientations import (
    correlations,
    directions,
    information,
    on_the_sphere,
    plan,
    predicted_sigmas,
)
from kf_calib.views.figures.residuals import disturbed_dwell, dwell, residuals, what_they_go_with

__all__ = [
    "Figures", "allan_deviation", "convergence", "correlations", "detection_limits", "directions",
    "disturbed_dwell", "dwell", "estimates", "figures", "history", "hypotheses", "improvement", "information", "noise",
    "on_the_sphere", "plan", "predicted_sigmas", "residuals", "save", "suspects", "three_ways",
    "what_they_go_with", "whiteness",
]  # fmt: skip

Figures = Mapping[str, Callable[[], Figure]]
"""Title of each figure, and what draws it."""

PROBABILITIES = "What it may be, and with what probability"
FALL, NO_FALL = "The error falls", "The error of the model"
ON_THEIR_WAY, DIRECTIONS = "Estimates on their way", "Directions of gravity in the platform"
"""Titles of figures that a page puts first, or leaves out where another says the same."""


@singledispatch
def figures(result: Any) -> Figures:
    """The figures of a result by title, the one that tells most first; nothing is drawn before it is called for."""
    leaf = f"{'.'.join(type(result).__module__.split('.')[:2])}.figures"
    if leaf not in sys.modules and leaf.startswith("kf_calib.") and find_spec(leaf):  # a folder with figures of its own
        import_module(leaf)
        return figures(result)
    raise TypeError(f"there is no figure of {type(result).__name__}: give the result of calibrate, diagnose, improve, "
                    "compare, plan, history, noise or a fleet.")  # fmt: skip


@figures.register
def _(diagnosed: Diagnosis) -> Figures:
    fails = diagnosed.test.consistent is False
    likely: Figures = {PROBABILITIES: lambda: hypotheses(diagnosed)} if diagnosed.table else {}
    disturbed = diagnosed.disturbed_readings
    dwells: Figures = (
        {f"Dwell {disturbed.number}, reading by reading": lambda: disturbed_dwell(diagnosed)} if disturbed else {}
    )
    return {
        **({} if diagnosed.explanation else dwells),
        "Where the model fails" if fails else "What the model leaves": lambda: residuals(diagnosed),
        **(dwells if diagnosed.explanation else {}),
        "What the residuals go with": lambda: what_they_go_with(diagnosed),
        **likely,
        "Which effect is missing" if fails else "Whether an effect is missing": lambda: suspects(diagnosed),
        "What could hide here": lambda: detection_limits(diagnosed),
        "Residuals by the direction of gravity": lambda: on_the_sphere(diagnosed),
    }


@figures.register
def _(state: Improvement) -> Figures:
    fails = state.start.test.consistent is False
    return {
        FALL if state.steps else NO_FALL: lambda: improvement(state),
        "Where the first model fails" if fails else "What the first model leaves": lambda: residuals(state.start),
        "What could still hide": lambda: detection_limits(state.diagnosis),
    }


@figures.register
def _(result: Calibration) -> Figures:
    return {
        "Sigma after each orientation, NIS and innovations": lambda: convergence(result),
        ON_THEIR_WAY: lambda: estimates(result),
        "What each orientation brought": lambda: information(result),
        "Correlations": lambda: correlations(result),
        DIRECTIONS: lambda: directions(result),
    }


@figures.register
def _(compared: Comparison) -> Figures:
    return {
        "Three ways of estimating": lambda: three_ways(compared),
        "Whether innovations and readings are white": lambda: whiteness(compared.result),
        "Allan deviation of the readings": lambda: allan_deviation(compared),
    }


@figures.register
def _(made: Plan) -> Figures:
    return {
        "Orientations and the sigmas to expect": lambda: plan(made),
        "Predicted sigma after each orientation": lambda: predicted_sigmas(made),
    }


@figures.register
def _(calibrations: History) -> Figures:
    return {"The calibrations over time": lambda: history(calibrations)}


@figures.register
def _(found: RestNoise) -> Figures:
    return {"Allan deviation at rest": lambda: noise(found)}


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
    from matplotlib.backends.backend_pdf import PdfPages  # with all its fonts it takes 0.2 s to load

    memory = io.BytesIO()
    with style.styled(), PdfPages(memory, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as pages:
        for title, draw in what.items():
            figure = draw()
            if title:
                figure.suptitle(title, x=0.01, ha="left")
            pages.savefig(figure)
    return memory.getvalue()
