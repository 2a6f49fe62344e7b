"""Directions of gravity in the platform on a map of the sphere: Mollweide's, which keeps areas; the y axis is up."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.residual_table import residual_table
from kf_calib.estimation.results import Calibration
from kf_calib.views.figures.style import ACCELEROMETERS, GREY, blank, styled

_AXES = {"+x": (0.0, 0.0, -9.0, -9.0), "+z": (-90.0, 0.0, -9.0, -9.0), "−z": (90.0, 0.0, -9.0, -9.0),
         "−x": (180.0, 0.0, 10.0, 0.0), "+y": (0.0, 90.0, -16.0, 6.0), "−y": (0.0, -90.0, -16.0, -7.0)}  # fmt: skip
"""Where the axes of the platform are written: longitude and latitude, deg, and how far beside it, points."""
_NUMBERED = 40  # dwells, above which they are not numbered
_LEAST = 3.0  # sigmas at the ends of the colours, at least


def sphere_map(figure: FigureBase, place: tuple[int, int, int]) -> Axes:
    """An empty map of the sphere in a place of a grid, with the platform's axes named."""
    axes = figure.add_subplot(*place, projection="mollweide")
    axes.set_xticks(np.radians([-150, -90, -30, 30, 90, 150]), [""] * 6)
    axes.set_yticks(np.radians([-60, -30, 0, 30, 60]), [""] * 5)
    for name, (longitude, latitude, right, up) in _AXES.items():
        axes.annotate(name, (np.radians(longitude), np.radians(latitude)), (right, up), textcoords="offset points",
                      color=GREY, ha="center", va="center", fontsize=8.0, zorder=1)  # fmt: skip
    return axes


def on_map(directions: Floats) -> tuple[Floats, Floats]:
    """Longitude and latitude (n,) in rad of directions (n, 3) in the platform."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.arctan2(-unit[:, 2], unit[:, 0]), np.arcsin(np.clip(unit[:, 1], -1.0, 1.0))


def directions(result: Calibration) -> Figure:
    """Where specific force pointed in the platform in each dwell, coloured by the residual of each accelerometer."""
    with styled():
        figure = blank(11.0, 6.2)
        draw_directions(figure, result)
    return figure


def draw_directions(figure: FigureBase, result: Calibration) -> None:
    """The same on a part of a figure: triangles point up where the reading is larger than predicted."""
    table = residual_table(result)
    of = {name: table[name].reshape(-1, 3) for name in ("ratio", "force_x_mps2", "force_y_mps2", "force_z_mps2")}
    ratios, force = of.pop("ratio"), np.array([each[:, 0] for each in of.values()]).T
    longitude, latitude = on_map(force)
    limit = max(_LEAST, float(np.nanquantile(np.abs(ratios), 0.98)))
    size, maps, marks = 300.0 / max(len(force), 1) ** 0.5, list[Axes](), None
    for i in range(3):
        axes = sphere_map(figure, (2, 2, i + 1))
        for marker, chosen in (("^", ratios[:, i] >= 0.0), ("v", ratios[:, i] < 0.0)):
            marks = axes.scatter(
                longitude[chosen], latitude[chosen], size, c=ratios[chosen, i], marker=marker, cmap="PuOr_r",
                norm=Normalize(-limit, limit), edgecolors="#444444", linewidths=0.5, zorder=3, clip_on=False,
            )  # fmt: skip
        axes.set_title(f"accelerometer {i + 1}", color=ACCELEROMETERS[i], loc="center", pad=12.0)
        maps.append(axes)
    if marks is not None:
        figure.colorbar(marks, ax=maps, label="residual / σ (▲ above 0, ▼ below)", shrink=0.6, extend="both",
                        location="left", pad=0.02)  # fmt: skip
    _draw_order(figure, result, longitude, latitude)


def _draw_order(figure: FigureBase, result: Calibration, longitude: Floats, latitude: Floats) -> None:
    """Draw the same directions in the order of the dwells: numbers, or colours where there are many."""
    axes = sphere_map(figure, (2, 2, 4))
    numbers = [dwell.number for dwell in result.fit.dwells]
    few = len(numbers) <= _NUMBERED
    axes.set_title("numbers of the dwells" if few else "order of the dwells", loc="center", pad=12.0)
    if few:
        number_points(axes, longitude, latitude, [str(number) for number in numbers])
        return
    marks = axes.scatter(
        longitude, latitude, 300.0 / len(numbers) ** 0.5, c=numbers, cmap="viridis", zorder=3, clip_on=False
    )
    figure.colorbar(marks, ax=axes, label="dwell", shrink=0.6, pad=0.02)


def number_points(axes: Axes, longitude: Floats, latitude: Floats, names: list[str]) -> None:
    """Draw points with their numbers beside them; those of one direction share a text."""
    axes.plot(longitude, latitude, "o", color="#222222", markersize=3.0, zorder=3, clip_on=False)
    places = dict[tuple[float, float], list[str]]()
    for x, y, name in zip(longitude.tolist(), latitude.tolist(), names, strict=True):
        pole = abs(y) > 1.55  # all longitudes are one point there
        places.setdefault((0.0 if pole else round(x, 1), round(y, 1)), []).append(name)
    for (x, y), own in places.items():
        text = ", ".join(own) if len(own) < 4 else f"{own[0]}, {own[1]} … {own[-1]}"
        axes.annotate(text, (x, y), xytext=(4, 3), textcoords="offset points", fontsize=8.0, zorder=4)
