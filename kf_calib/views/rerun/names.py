"""What the panels share: timelines, colours, labels, units, and how an .rrd file is written, whole or not at all.

Rerun's own way to a file waits for ever where the disk is full, and raises nothing where it could not write: here it
encodes in memory (a view has a few MB), and what it encoded is written as every other output is.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import PlotBackground

from kf_calib.bench import paper_parameters
from kf_calib.estimation.measurement_model import Model
from kf_calib.support.output_files import write_whole
from kf_calib.support.text import printable
from kf_calib.support.units import shown
from kf_calib.views.notation import twelve

BENCH_TIME = "bench_time"
ORIENTATION = "orientation"

Colour = tuple[int, int, int]
ACCELEROMETERS: tuple[Colour, Colour, Colour] = ((235, 115, 40), (40, 185, 130), (85, 160, 245))
"""One colour an accelerometer in all panels: in the order of x, y, z, and told apart by colour-blind eyes."""
PALE: tuple[Colour, Colour, Colour] = ((255, 190, 130), (150, 235, 195), (175, 215, 255))
"""The same accelerometers' second angle."""
_OF_TWELVE = [colour for full, pale in zip(ACCELEROMETERS, PALE, strict=True) for colour in (full, pale, full, full)]
GREY: Colour = (135, 135, 140)
WHITE: Colour = (235, 235, 235)
GIMBALS: tuple[Colour, ...] = ((205, 160, 255), (255, 160, 205), (225, 215, 130), (200, 200, 205))
GOLD: Colour = (250, 210, 70)
RED: Colour = (240, 50, 70)
DARK: Colour = (13, 16, 17)
"""What everything is drawn on, whatever the viewer prefers: marks are light."""
ON_DARK = PlotBackground(color=DARK)

CHANNELS = ("a1", "a2", "a3")
MAUVE: Colour = (214, 150, 235)
"""Coefficients of effects."""
KINDS = {"rad": "angles", "1": "scale factors", "m/s^2": "biases"}
"""What the parameters of an SI unit are."""


def entity(*parts: str) -> str:
    """The path of an entity, whatever characters are in the names of its parts."""
    return rr.new_entity_path([*parts]).lstrip("/")


def thin(pixels: float) -> float:
    """A radius in pixels of the screen, whatever the zoom: Rerun takes negative radii for such."""
    return -pixels


def path_of(symbol: str) -> str:
    """The parameter's entity; the accelerometer comes first, so that legends list one after the other."""
    return f"parameters/a{paper_parameters.SYMBOLS.index(symbol) // 4 + 1}/{symbol}"


class DrawnParameter(NamedTuple):
    """What is estimated and drawn as one curve: the SI value times ``per_si`` is in ``unit``."""

    label: str
    unit: str
    per_si: float
    colour: Colour
    path: str


def quantities(model: Model) -> tuple[DrawnParameter, ...]:
    """The twelve parameters in the units that people are shown, then the coefficients of the effects in the model."""
    parameters = [
        DrawnParameter(*own, colour, path_of(symbol))
        for symbol, own, colour in zip(paper_parameters.SYMBOLS, twelve(), _OF_TWELVE, strict=True)
    ]
    coefficients = [
        DrawnParameter(printable(each.symbol), printable(shown(each).label), shown(each).per_si, MAUVE,
                 entity("parameters", "effects", each.symbol))
        for each in model.coefficients
    ]  # fmt: skip
    return (*parameters, *coefficients)


def markdown_page(text: str) -> rr.TextDocument:
    """A page of text in Markdown."""
    return rr.TextDocument(printable(text), media_type=rr.MediaType.MARKDOWN)


def window(content: rrb.Container, timeline: str, play_state: Literal["paused", "following"]) -> rrb.Blueprint:
    """A window that opens with all of its room for the content, at the end of a timeline or at its beginning."""
    return rrb.Blueprint(
        content,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play_state),
    )


def curves_panel(
    contents: list[str], name: str, axis_x: rrb.TimeAxis, legend: rrb.Corner2D | None = None,
    reach: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:  # fmt: skip
    """Curves over a timeline; no legend unless a corner is given for it. reach: of the axis that points up."""
    return rrb.TimeSeriesView(
        contents=contents,
        name=name,
        plot_legend=rrb.PlotLegend(legend, visible=legend is not None),
        axis_x=axis_x,
        axis_y=None if reach is None else rrb.ScalarAxis(range=reach),
        background=ON_DARK,
    )


def new_stream() -> rr.RecordingStream:
    """A stream with an identity of its own: two views written by one process would else be merged by the viewer."""
    return rr.RecordingStream("kf_calib", recording_id=uuid.uuid4())


@contextmanager
def strict() -> Iterator[None]:
    """Mistakes in what is logged raise, rather than leave a hole in the view; the caller's mode is given back."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


@contextmanager
def rrd_file(path: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A stream whose content is the file when the block has ended. Raises InputError where it cannot be written."""
    with strict(), new_stream() as stream:
        memory = stream.memory_recording()
        stream.send_blueprint(blueprint)
        yield stream
        content = memory.drain_as_bytes()
        stream.disconnect()
    write_whole(path, content)
