"""The Rerun view of the paper's experiment: D in blocks, the directions of gravity, both sets' sigmas falling.

Timelines: ``reading`` (of each accelerometer, 1 to 400), and ``orientation`` (1 to 4, at its last reading); 0 is the
prior. The covariance is the filter's from the prior of the navigation grade, the same for both sets.
Entities: ``optimal/...`` and ``nonoptimal/...``: ``parameters/ACCELEROMETER/SYMBOL/sigma``, the charts
``sigmas/KIND``, ``directions/...``; ``design/{picture,labels}``; ``summary``; ``notes``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.estimation.prior import PRIORS
from kf_calib.reproduction.grebenkin2019 import GRAVITY_MPS2, READINGS, Column, Experiment, shrinking
from kf_calib.views.rerun.correlation import LIFT, picture
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.names import (
    ACCELEROMETERS,
    GOLD,
    GREY,
    LABELS,
    ORIENTATION,
    WHITE,
    colour_of,
    path_of,
    per_si,
    twelve,
)
from kf_calib.views.rerun.sigmas import Falling, overview_sheet

READING = "reading"
SETS = {"optimal": "optimal", "nonoptimal": "non-optimal"}
_COLUMN, _GAP, _BETWEEN = 24, 14, 60  # pixels of a column of D, between accelerometers, between the sets
_UNIT = np.array([GRAVITY_MPS2, GRAVITY_MPS2, GRAVITY_MPS2, 1.0])


def save(found: Experiment, words: str, path: str | Path) -> Path:
    """Write the view to an .rrd file; ``words``: Markdown of the results. Raises InputError where it cannot be."""
    path = Path(path)
    sigmas = {name: _sigmas(column) for name, column in _columns(found).items()}
    with rrd_file(path, _layout(sigmas)) as stream:
        for name, column in _columns(found).items():
            _log_sigmas(stream, name, sigmas[name])
            _falling(name, sigmas).log_overview(stream)
            _log_directions(stream, name, column)
        _log_design(stream, found)
        table = words.partition("\n\n")[0]
        for name, text in (("summary", table), ("notes", words)):
            stream.log(name, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    return path


def _columns(found: Experiment) -> dict[str, Column]:
    return {"optimal": found.optimal, "nonoptimal": found.nonoptimal}


def _sigmas(column: Column) -> Floats:
    """Sigma in shown units (n + 1, 12): of the prior, and after every reading."""
    nominal = paper_parameters.nominal()
    jacobian = paper_parameters.jacobian(paper_parameters.state_of(nominal))
    covariances = shrinking(column.orientations, PRIORS["navigation"].covariance(nominal))
    variance = np.diagonal(jacobian @ covariances @ jacobian.T, axis1=1, axis2=2)
    return np.sqrt(variance) * per_si()


def _log_sigmas(stream: rr.RecordingStream, name: str, sigma: Floats) -> None:
    reading = np.arange(len(sigma))
    last = reading % READINGS == 0
    for k, symbol in enumerate(paper_parameters.SYMBOLS):
        path = f"{name}/{path_of(symbol)}/sigma"
        for rows, index in ((last, [rr.TimeColumn(ORIENTATION, sequence=reading[last] // READINGS)]), (~last, [])):
            times = [rr.TimeColumn(READING, sequence=reading[rows]), *index]
            stream.send_columns(path, times, rr.Scalars.columns(scalars=sigma[rows, k]))
        stream.log(path, rr.SeriesLines(names=LABELS[symbol], colors=colour_of(symbol), widths=1.5), static=True)


def _log_directions(stream: rr.RecordingStream, name: str, column: Column) -> None:
    """Where specific force points in the platform, in each orientation: an arc where the Earth turns it."""
    stream.log(f"{name}/directions", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    circles = rr.LineStrips3D([np.roll(circle, k, axis=1) for k in range(3)], colors=(75, 75, 80), radii=0.003)
    stream.log(f"{name}/directions/sphere", circles, static=True)
    frame = rr.Arrows3D(vectors=1.3 * np.eye(3), colors=GREY, radii=0.008, labels=["X", "Y", "Z"], show_labels=True)
    stream.log(f"{name}/directions/frame", frame, static=True)
    arcs = (column.orientations.force_mps2 / GRAVITY_MPS2).reshape(3, 4, READINGS, 3)
    shared = np.allclose(arcs, arcs[0])
    colours = [GOLD] if shared else ACCELEROMETERS
    for i, (arc, colour) in enumerate(zip(arcs[: len(colours)], colours, strict=True)):
        path = f"{name}/directions/{'all' if shared else f'a{i + 1}'}"
        stream.log(path, rr.LineStrips3D(list(arc), colors=colour, radii=0.012), static=True)
        points = rr.Points3D(
            arc[:, 0], colors=colour, radii=0.035, labels=[f"{k}" for k in range(1, 5)], show_labels=shared
        )
        stream.log(f"{path}/first", points, static=True)


def _log_design(stream: rr.RecordingStream, found: Experiment) -> None:
    """The paper's figure 4: D of each accelerometer in both sets, columns by parameter, a pixel a reading downwards."""
    panels, labels = list[NDArray[np.uint8]](), list[tuple[float, float, str, tuple[int, int, int]]]()
    left = 0
    for name, column in _columns(found).items():
        width = 3 * 4 * _COLUMN + 2 * _GAP
        labels.append((left + width / 2, -66.0, SETS[name], WHITE))
        for i, design in enumerate(column.orientations.design):
            panels += [_blocks(design), _blank(_GAP if i < 2 else _BETWEEN)]
            for k, symbol in enumerate(paper_parameters.SYMBOLS[4 * i : 4 * i + 4]):
                labels.append((left + (k + 0.5) * _COLUMN, -36.0, LABELS[symbol], colour_of(symbol)))
            left += 4 * _COLUMN + (_GAP if i < 2 else _BETWEEN)
    whole = np.concatenate(panels[:-1], axis=1)
    stream.log("design/picture", rr.Image(whole), static=True)
    labels += [(-22.0, (k + LIFT) * READINGS - 10, f"{k + 1}", WHITE) for k in range(4)]
    x, y, texts, colours = zip(*labels, strict=True)
    points = rr.Points2D(np.column_stack([x, y]), labels=texts, show_labels=True, radii=0.0, colors=colours)
    stream.log("design/labels", points, static=True)


def _blocks(design: Floats) -> NDArray[np.uint8]:
    """RGB (n, 4 columns of some pixels, 3): blue for -g, black for 0, orange for +g (for a bias, 1)."""
    return np.repeat(picture(design / _UNIT), _COLUMN, axis=1)


def _blank(width: int) -> NDArray[np.uint8]:
    return np.full((4 * READINGS, width, 3), (13, 16, 17), np.uint8)


def _layout(sigmas: dict[str, Floats]) -> rrb.Blueprint:
    curves = [overview_sheet(_falling(name, sigmas), f"{SETS[name]}: σ by reading") for name in SETS]
    spheres = [
        rrb.Spatial3DView(
            origin=f"{name}/directions", name=f"{SETS[name]}: up", line_grid=False,
            eye_controls=rrb.EyeControls3D(position=(2.4, 1.6, 2.9), look_target=(0.0, 0.1, 0.0), eye_up=(0, 1, 0)),
        )
        for name in SETS
    ]  # fmt: skip
    width = 2 * (12 * _COLUMN + 2 * _GAP) + _BETWEEN
    design = rrb.Spatial2DView(
        origin="design",
        name="D: blue −g, orange +g (bias: 1); a row a reading",
        visual_bounds=rrb.VisualBounds2D(x_range=[-40.0, width + 10.0], y_range=[-80.0, 4 * READINGS + 10.0]),
    )
    overview = rrb.Horizontal(
        *curves,
        rrb.Vertical(design, rrb.Horizontal(*spheres), row_shares=[1, 1]),
        rrb.TextDocumentView(origin="summary", name="Table 2"),
        column_shares=[3.2, 3.2, 5.0, 4.2],
        name="Experiment",
    )
    return rrb.Blueprint(
        rrb.Tabs(overview, rrb.TextDocumentView(origin="notes", name="Table 2 and what is said of it")),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=READING, play_state="following"),
    )


def _falling(name: str, sigmas: dict[str, Floats]) -> Falling:
    """The sigmas of one set, on the axes of both."""
    own, none = sigmas[name], np.full(12, np.nan)
    shares = np.full_like(own, np.nan)  # of single readings they are too many to be drawn
    both = np.concatenate(list(sigmas.values()))
    return Falling(twelve(), np.arange(len(own)), own, shares, none, f"{name}/sigmas", READING, both, (230.0, 860.0))
