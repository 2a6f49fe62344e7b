"""Residuals on the sphere of directions of gravity in the platform."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.residual_table import mean_sigmas, quantity_means
from kf_calib.views.figures.style import GREY, blank, styled
from kf_calib.views.figures.symbols import wrapped

_COLOURS = "PuOr_r"  # colour-blind eyes tell its ends apart
_LEAST = 3.0  # sigma at the ends of the colours, at least
_MANY = 150


def on_the_sphere(diagnosis: Diagnosis) -> Figure:
    """Residuals over their sigma by the direction of the specific force in the platform, a row an accelerometer.

    The sphere is unrolled with all areas true (Mollweide): the platform's z axis points up, its x axis out of the
    middle. Triangles up are positive, down negative. On the right: what the best explanation leaves, in the same
    colours.
    """
    with styled():
        figure = blank(11.0, 7.5) if diagnosis.explanations else blank(11.0, 2.8)
        draw_on_the_sphere(figure, diagnosis)
    return figure


def draw_on_the_sphere(figure: FigureBase, diagnosis: Diagnosis) -> None:
    """The same on a part of a figure; the accelerometers stand side by side where there is no explanation."""
    force = quantity_means(diagnosis.before, ["fx", "fy", "fz"])
    directions = np.stack([force[f"f{axis}"][:, 0] for axis in "xyz"], axis=1)
    columns = {diagnosis.before.model.sum: diagnosis.before.residuals_mps2 / mean_sigmas(diagnosis.before)}
    columns |= {f"with {each.name}": each.unexplained_ratios for each in diagnosis.explanations[:1]}
    most = max(_LEAST, *(float(np.percentile(np.abs(ratios), 99.0)) for ratios in columns.values()))
    shape = (3, 2) if len(columns) > 1 else (1, 3)
    panels = figure.subplots(*shape, squeeze=False, subplot_kw={"projection": "mollweide"})
    for row, (words, ratios) in zip(panels.T if len(columns) > 1 else panels, columns.items(), strict=True):
        for i, axes in enumerate(row):
            _points(axes, directions, ratios[:, i], most)
            axes.set_title(wrapped(f"accelerometer {i + 1}: {words}", 60), fontsize=9.0, loc="center")
    bar = ScalarMappable(Normalize(-most, most), _COLOURS)
    figure.colorbar(bar, ax=panels, label="residual / σ", shrink=0.8, aspect=30, extend="both")


def _points(axes: Axes, directions: Floats, ratios: Floats, most: float) -> None:
    """Draw the residuals of one accelerometer, large where they are large, and where the platform's axes point."""
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    latitude = np.arctan2(directions[:, 2], np.hypot(directions[:, 0], directions[:, 1]))
    size = (8.0 if len(ratios) > _MANY else 25.0) * (0.5 + 2.0 * np.minimum(np.abs(ratios) / most, 1.0))
    for marker, own in (("^", ratios >= 0.0), ("v", ratios < 0.0)):
        axes.scatter(longitude[own], latitude[own], size[own], ratios[own], marker=marker, cmap=_COLOURS, vmin=-most,
                     vmax=most, edgecolors="#444444", linewidths=0.4, zorder=3)  # fmt: skip
    for text, x, y in (("x", 0.0, 0.0), ("y", 90.0, 0.0), ("−y", -90.0, 0.0), ("z", 0.0, 78.0), ("−z", 0.0, -78.0),
                       ("−x", 172.0, 0.0)):  # fmt: skip
        axes.text(np.radians(x), np.radians(y), text, ha="center", va="center", color=GREY, fontsize=8.0)
    axes.set_xticks(np.radians([-90.0, 0.0, 90.0]), [])
    axes.set_yticks(np.radians([-45.0, 0.0, 45.0]), [])
