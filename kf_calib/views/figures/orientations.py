"""A plan of orientations: where specific force will point in the platform, in order, and the sigmas to expect."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design.orientation_plan import Plan
from kf_calib.views.figures.directions import number_points, on_map, sphere_map
from kf_calib.views.figures.parameter_panels import draw_sigmas
from kf_calib.views.figures.scales import log_scale, whole_numbers, written
from kf_calib.views.figures.style import ACCELEROMETERS, ALARM, GREY, PALE, blank, styled
from kf_calib.views.figures.symbols import KINDS, twelve, with_coefficients
from kf_calib.views.plan import gimbal_names

_HATCHES = ("", "///", "...")
_GIMBALS = ("#222222", "#cc79a7", "#56b4e9", "#e69f00")
_ARC = 33  # points of the way between two directions


def plan(made: Plan) -> Figure:
    """The orientations on the sphere in their order, and the predicted sigma of each parameter, with targets if any."""
    with styled():
        figure = blank(11.0, 6.6)
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.25, 1.0])[0]
        above, below = left.subfigures(2, 1, squeeze=False, height_ratios=[1.5, 1.0])[:, 0]
        draw_tour(above, made)
        draw_angles(below.subplots(), made)
        draw_predicted(right, made)
    return figure


def draw_tour(figure: FigureBase, made: Plan) -> None:
    """Draw the directions of specific force, numbered, and the shortest ways between them."""
    axes = sphere_map(figure, (1, 1, 1))
    for start, end in zip(made.directions[:-1], made.directions[1:], strict=True):
        longitude, latitude = on_map(_arc(start, end))
        seam = np.flatnonzero(np.abs(np.diff(longitude)) > np.pi) + 1  # the way leaves the map and enters opposite
        axes.plot(np.insert(longitude, seam, np.nan), np.insert(latitude, seam, np.nan), color=PALE, linewidth=1.0,
                  zorder=2)  # fmt: skip
    number_points(axes, *on_map(made.directions), [str(k + 1) for k in range(len(made.poses))])
    axes.set_title(
        f"{len(made.poses)} orientations in order: specific force in the platform, y up", loc="center", pad=14.0
    )


def draw_angles(axes: Axes, made: Plan) -> None:
    """Draw the angles of the gimbals in the order of the visits."""
    numbers = np.arange(1, len(made.poses) + 1)
    for angles, name, colour, marker in zip(made.gimbal_deg.T, gimbal_names(made), _GIMBALS, "osDv", strict=False):
        axes.plot(numbers, angles, f":{marker}", color=colour, markersize=4.0, linewidth=0.9,
                  label=f"gimbal {name.replace('_', ' ')}")  # fmt: skip
    reach = float(np.abs(made.gimbal_deg).max(initial=90.0))
    axes.set_ylim(-1.15 * reach, 1.6 * reach)  # room for the legend
    axes.set_yticks(np.arange(-180, 181, 90))
    axes.set_ylabel("angle, deg")
    axes.set_title("Angles to set")
    axes.legend(loc="upper center", ncols=4, fontsize=8.0)
    whole_numbers(axes, 1, max(len(made.poses), 2))


def _arc(start: Floats, end: Floats) -> Floats:
    """Return points (m, 3) of the great arc between two directions."""
    share = np.linspace(0.0, 1.0, _ARC)[:, None]
    points = (1.0 - share) * start + share * end
    if np.linalg.norm(start + end) < 1e-6:  # opposite directions: over any point between, as all ways are as long
        points += np.sin(np.pi * share) * np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def draw_predicted(figure: FigureBase, made: Plan) -> None:
    """Draw a bar for the predicted sigma of each parameter, and a line where a sigma was asked for."""
    groups = [[k for k in range(STATE_COUNT) if paper_parameters.UNITS[k] == unit] for unit in KINDS]
    panels = figure.subplots(len(groups), 1, height_ratios=[len(group) for group in groups])
    for axes, group, kind in zip(panels, groups, KINDS.values(), strict=True):
        per_si, unit = twelve()[group[0]].per_si, twelve()[group[0]].unit
        _sigma_bars(axes, group, made.sigma[-1] * per_si, made.targets * per_si)
        _before(axes, group, made.sigma[0] * per_si)
        _values(axes, group, made.sigma[[0, -1]] * per_si)
        axes.set_xlabel(f"predicted σ of {kind}, {unit}")
    panels[0].set_title("Predicted σ after the last orientation")
    marked = [axes for axes in panels if axes.get_legend_handles_labels()[1]]
    if marked:
        figure.legend(*marked[0].get_legend_handles_labels(), loc="outside lower right", ncols=2)


def _sigma_bars(axes: Axes, group: list[int], sigma: Floats, targets: Floats) -> None:
    """Draw sigmas as bars of a logarithmic axis with their values, and what was asked for as lines across them."""
    known = np.isfinite(targets[group])
    log_scale(axes, [0.3 * sigma[group], 2.0 * sigma[group], targets[group][known]], "x")
    left = axes.get_xlim()[0]
    for row, k in enumerate(group):
        if not np.isfinite(sigma[k]):
            axes.text(left, row, " not determined", va="center", fontsize=8.0, color=GREY)
            continue
        axes.barh(row, sigma[k] - left, left=left, height=0.7, color=ACCELEROMETERS[k // 4], hatch=_HATCHES[k // 4],
                  edgecolor="white", linewidth=0.0)  # fmt: skip
        if np.isfinite(targets[k]):
            axes.plot([targets[k]] * 2, [row - 0.45, row + 0.45], color=ALARM, linewidth=2.0,
                      label="" if "target" in axes.get_legend_handles_labels()[1] else "target")  # fmt: skip
    axes.set_yticks(range(len(group)), [twelve()[k].label for k in group])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")


def _before(axes: Axes, group: list[int], sigma: Floats) -> None:
    """Mark the sigmas before the first orientation, as far as they are known and on the axis."""
    seen = [row for row, k in enumerate(group) if sigma[k] < axes.get_xlim()[1]]
    if seen:
        before = [sigma[group[row]] for row in seen]
        axes.plot(before, seen, "D", color="#222222", markersize=4.0, label="before the plan")


def _values(axes: Axes, group: list[int], sigmas: Floats) -> None:
    """Write the last of some sigmas (n, p) to the right of all that are on the axis."""
    for row, k in enumerate(group):
        seen = sigmas[:, k][sigmas[:, k] < axes.get_xlim()[1]]
        if np.isfinite(sigmas[-1, k]):
            axes.annotate(written(float(f"{sigmas[-1, k]:.3g}")), (seen.max(initial=sigmas[-1, k]), row), (6, 0),
                          textcoords="offset points", va="center", fontsize=8.0)  # fmt: skip


def predicted_sigmas(made: Plan) -> Figure:
    """Predicted sigma of every parameter against the number of orientations, with targets if any."""
    names = with_coefficients(made.prospect.model.coefficients)
    with styled():
        figure = blank(11.0, 7.0)
        draw_sigmas(figure, np.arange(len(made.sigma), dtype=float), made.sigma, names, made.targets)
    return figure
