"""docs/conventions.png: which way is up, which sense is positive, what each accelerometer reads.

`tools/pictures conventions` draws it again; the readings in it are those of the program's own bench.
"""

from __future__ import annotations

import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, parse_axes

COLOURS = {"x": "#d55e00", "y": "#009e73", "z": "#0072b2"}  # told apart by the colour-blind, too
GIMBALS = ("outer", "middle", "inner")
FACES = {"y z x": [(0, 0, 0), (0, 0, 180), (0, 90, 0), (0, -90, 0), (0, 0, 90), (0, 0, -90)],
         "z y x": [(0, 0, 0), (0, 0, 180), (0, 90, 0), (0, -90, 0), (0, 0, 90), (0, 0, -90)]}  # fmt: skip


def drawn() -> Image.Image:
    """The picture."""
    figure, panels = plt.subplots(2, 2, figsize=(11, 7.3), height_ratios=(1.5, 1.0))
    for column, (axes, up, words) in enumerate(
        [
            ("y z x", "y", 'as in the paper: --axes "y z x" (up is y)'),
            ("z y x", "z", 'as in ROS: --axes "z y x" --up z'),
        ]
    ):
        bench = Bench(parse_axes(axes), 9.81, up=up)
        draw_platform(panels[0, column], axes, up)
        panels[0, column].set_title(words, fontsize=13, fontweight="bold")
        draw_readings(panels[1, column], bench, axes)
    figure.subplots_adjust(0.02, 0.0, 0.98, 0.98, wspace=0.05, hspace=0.0)
    memory = io.BytesIO()
    figure.savefig(memory, dpi=80)
    return Image.open(memory).convert("RGB")


def projected(point: Floats, up: str) -> Floats:
    """A point of the platform at zero angles on the paper, seen from the right and a little above, ``up`` upward."""
    x, y, z = point
    right, back, above = (x, -z, y) if up == "y" else (x, y, z)
    return np.array([0.94 * right + 0.42 * back, above - 0.16 * right + 0.30 * back])


def draw_platform(panel: Axes, axes: str, up: str) -> None:
    """The block with its axes, the specific force at rest, and the positive sense of each gimbal."""
    corners = 0.3 * np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    for i, one in enumerate(corners):
        for other in corners[i + 1 :]:
            if np.count_nonzero(one != other) == 1:
                panel.plot(*zip(projected(one, up), projected(other, up), strict=True), color="0.75", lw=1)
    for number, letter in enumerate("xyz", 1):
        axis = np.eye(3)[number - 1]
        tip = projected(1.05 * axis, up)
        draw_arrow(panel, projected(0.3 * axis, up), tip, COLOURS[letter], 2.5)
        side = "left" if tip[0] > 0.3 else "right" if tip[0] < -0.3 else "center"
        name = f"{letter}: accelerometer {number}"
        place, look = 1.07 * tip + np.array([0.0, 0.02]), {"ha": side, "va": "center_baseline", "fontsize": 11}
        panel.text(place[0], place[1], name, color=COLOURS[letter], **look)
        draw_sense(panel, number - 1, up, COLOURS[letter], f"{GIMBALS[axes.split().index(letter)]} gimbal")
    foot = np.array([-1.3, 0.1])
    draw_arrow(panel, foot, foot + np.array([0.0, 0.9]), "black", 4)
    panel.text(foot[0], foot[1] + 1.0, "up: at rest,\nspecific force is +g", ha="center", fontsize=11)
    panel.set_xlim(-1.75, 1.95)
    panel.set_ylim(-0.75, 1.45)
    panel.set_aspect("equal")
    panel.axis("off")


def draw_arrow(panel: Axes, start: Floats, end: Floats, colour: str, width: float) -> None:
    look = {"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0}
    panel.annotate("", tuple(end), tuple(start), arrowprops=look)


def draw_sense(panel: Axes, axis: int, up: str, colour: str, name: str) -> None:
    """A ring about an axis with an arrow in the positive sense: a right-handed screw along the axis."""
    turn = np.radians(np.linspace(20.0, 320.0, 60))
    one, other = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    ring = [0.72 * np.eye(3)[axis] + 0.22 * (np.cos(a) * one + np.sin(a) * other) for a in turn]
    points = np.array([projected(point, up) for point in ring])
    panel.plot(*points.T, color=colour, lw=1.6)
    ahead = points[-1] - points[-2]
    towards = np.degrees(np.arctan2(ahead[1], ahead[0])) - 90.0
    panel.plot(*points[-1], color=colour, marker=(3, 0, float(towards)), markersize=9)
    low = points[np.argmin(points[:, 1])]
    panel.text(low[0], low[1] - 0.12, name, color=colour, fontsize=9.5, ha="center")


def draw_readings(panel: Axes, bench: Bench, axes: str) -> None:
    """What the three accelerometers read in six orientations, in g."""
    poses = FACES[axes]
    force = bench.specific_force(np.zeros(len(poses)), np.radians(poses)) / bench.gravity_mps2
    cells = [
        [*(f"{angle:g}°" for angle in pose), *(f"{value:+.0f} g" if abs(value) > 0.5 else "0" for value in row)]
        for pose, row in zip(poses, force, strict=True)
    ]
    heads = [f"{name}, {letter}" for name, letter in zip(GIMBALS, axes.split(), strict=True)]
    heads += [f"{number} reads" for number in (1, 2, 3)]
    table = panel.table(cells, colLabels=heads, cellLoc="center", bbox=(0.04, 0.1, 0.92, 0.85))
    table.auto_set_font_size(False)
    table.set_fontsize(11)
    table.scale(1.0, 1.5)
    for (row, column), cell in table.get_celld().items():
        cell.set_edgecolor("0.8")
        if row and column > 2 and "g" in cell.get_text().get_text():
            cell.set_text_props(fontweight="bold", color=COLOURS["xyz"[column - 3]])
    panel.axis("off")
