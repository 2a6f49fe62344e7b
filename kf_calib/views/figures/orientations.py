"""Orientations: those of a plan with the sigmas to expect, those of a run with what each left and brought. Directions
of gravity in the platform are on maps of the sphere, Mollweide's, which keeps areas.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design.orientation_plan import Plan
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.estimate import correlation
from kf_calib.estimation.filter_history import history_of
from kf_calib.estimation.residual_table import mean_sigmas, quantity_means, residual_table
from kf_calib.estimation.results import Calibration
from kf_calib.views.figures.convergence import MANY, draw_sigmas
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    ALARM,
    GREY,
    MARKERS,
    PALE,
    UNIT_KINDS,
    drawn_on,
    log_scale,
    say,
    whole_numbers,
    wrapped,
)
from kf_calib.views.notation import gimbal_names, twelve, with_coefficients, written

_AXES = {"+x": (0.0, 0.0, -9.0, -9.0), "+z": (-90.0, 0.0, -9.0, -9.0), "−z": (90.0, 0.0, -9.0, -9.0),
         "−x": (180.0, 0.0, 10.0, 0.0), "+y": (0.0, 90.0, -16.0, 6.0), "−y": (0.0, -90.0, -16.0, -7.0)}  # fmt: skip
"""Where the axes of the platform are written: longitude and latitude, deg, and how far beside it, points."""
_NUMBERED = 40  # dwells, above which they are not numbered
_LEAST = 3.0  # sigmas at the ends of the colours, at least


def sphere_map(figure: FigureBase, place: tuple[int, int, int]) -> Axes:
    """An empty map of the sphere in a place of a grid, with the platform's axes named; the y axis is up."""
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


@drawn_on(11.0, 6.2)
def directions(figure: Figure, result: Calibration) -> None:
    """Where specific force pointed in the platform in each dwell, coloured by the residual of each accelerometer."""
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


_HATCHES = ("", "///", "...")
_GIMBALS = ("#222222", "#cc79a7", "#56b4e9", "#e69f00")
_ARC = 33  # points of the way between two directions


@drawn_on(11.0, 6.6)
def plan(figure: Figure, made: Plan) -> None:
    """The orientations on the sphere in their order, and the predicted sigma of each parameter, with targets if any."""
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.25, 1.0])[0]
    above, below = left.subfigures(2, 1, squeeze=False, height_ratios=[1.5, 1.0])[:, 0]
    draw_tour(above, made)
    draw_angles(below.subplots(), made)
    draw_predicted(right, made)


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
    for angles, name, colour, marker in zip(
        made.gimbal_deg.T, gimbal_names(made.information.model.bench), _GIMBALS, "osDv", strict=False
    ):
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
    groups = [[k for k in range(STATE_COUNT) if paper_parameters.UNITS[k] == unit] for unit in UNIT_KINDS]
    panels = figure.subplots(len(groups), 1, height_ratios=[len(group) for group in groups])
    for axes, group, kind in zip(panels, groups, UNIT_KINDS.values(), strict=True):
        per_si, unit = twelve()[group[0]].per_si, twelve()[group[0]].unit
        _sigma_bars(axes, group, made.sigma[0] * per_si, made.sigma[-1] * per_si, made.targets * per_si)
        axes.set_xlabel(f"predicted σ of {kind}, {unit}")
    panels[0].set_title("Predicted σ after the last orientation")
    marked = [axes for axes in panels if axes.get_legend_handles_labels()[1]]
    if marked:
        figure.legend(*marked[0].get_legend_handles_labels(), loc="outside lower right", ncols=2)


def _sigma_bars(axes: Axes, group: list[int], before: Floats, sigma: Floats, targets: Floats) -> None:
    """Draw sigmas as bars of a logarithmic axis with their values, what was asked for as lines across them, and those
    before the first orientation as marks, as far as they are known and on the axis."""
    known = np.isfinite(targets[group])
    log_scale(axes, [0.3 * sigma[group], 2.0 * sigma[group], targets[group][known]], "x")
    left, right = axes.get_xlim()
    for row, k in enumerate(group):
        if not np.isfinite(sigma[k]):
            axes.text(left, row, " not determined", va="center", fontsize=8.0, color=GREY)
            continue
        axes.barh(row, sigma[k] - left, left=left, height=0.7, color=ACCELEROMETERS[k // 4], hatch=_HATCHES[k // 4],
                  edgecolor="white", linewidth=0.0)  # fmt: skip
        if np.isfinite(targets[k]):
            axes.plot([targets[k]] * 2, [row - 0.45, row + 0.45], color=ALARM, linewidth=2.0,
                      label="" if "target" in axes.get_legend_handles_labels()[1] else "target")  # fmt: skip
        end = max(sigma[k], before[k]) if before[k] < right else sigma[k]
        axes.annotate(written(float(f"{sigma[k]:.3g}")), (end, row), (6, 0), textcoords="offset points", va="center",
                      fontsize=8.0)  # fmt: skip
    axes.set_yticks(range(len(group)), [twelve()[k].label for k in group])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    seen = [row for row, k in enumerate(group) if before[k] < right]
    if seen:
        axes.plot(before[[group[row] for row in seen]], seen, "D", color="#222222", markersize=4.0,
                  label="before the plan")  # fmt: skip


@drawn_on()
def predicted_sigmas(figure: Figure, made: Plan) -> None:
    """Predicted sigma of every parameter against the number of orientations, with targets if any."""
    names = with_coefficients(made.information.model.coefficients)
    draw_sigmas(figure, np.arange(len(made.sigma), dtype=float), made.sigma, names, made.targets)


_COLOURS = "PuOr_r"  # colour-blind eyes tell its ends apart
_MANY = 150


@drawn_on(11.0, 7.5)
def on_the_sphere(figure: Figure, diagnosis: Diagnosis) -> None:
    """Residuals over their sigma by the direction of the specific force in the platform, a row an accelerometer.

    The sphere is unrolled with all areas true (Mollweide): the platform's z axis points up, its x axis out of the
    middle. Triangles up are positive, down negative. On the right: what the best explanation leaves, in the same
    colours.
    """
    if not diagnosis.explanation:
        figure.set_size_inches(11.0, 2.8)
    force = quantity_means(diagnosis.before, ["fx", "fy", "fz"])
    directions = np.stack([force[f"f{axis}"][:, 0] for axis in "xyz"], axis=1)
    columns = {diagnosis.before.model.sum: diagnosis.before.residuals_mps2 / mean_sigmas(diagnosis.before)}
    if diagnosis.explanation:
        columns[f"with {diagnosis.explanation.name}"] = diagnosis.explanation.unexplained_ratios
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


NOTABLE = 0.3
"""A correlation below this is not worth a place in a figure."""


@drawn_on()
def information(figure: Figure, result: Calibration) -> None:
    """The share of the final information 1/sigma^2 that came with each orientation.

    Above: mean over the parameters of each accelerometer; below: every parameter.
    """
    history = history_of(result)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.7])
    numbers, names = history.numbers, with_coefficients(history.parameters[STATE_COUNT:])
    count = int((numbers > 0).sum())
    above.axhline(100.0 / count, color=GREY, linewidth=1.0, linestyle="--", label=f"if all {count} brought as much")
    few = len(numbers) <= MANY
    for i, width in enumerate((3.6, 2.4, 1.2) if few else (2.4, 1.5, 0.7)):  # where all three are alike, none is hidden
        marker = MARKERS[i] if few else ""
        above.plot(numbers, 100.0 * history.shares_of_accelerometers[:, i], marker=marker, color=ACCELEROMETERS[i],
                   linewidth=width, markersize=2.0 + 1.6 * width, label=f"accelerometer {i + 1}")  # fmt: skip
    above.set_ylabel("share, %")
    above.set_title("Share of the final information 1/σ² that each orientation brought: mean of four parameters")
    top = 100.0 * np.nanmax(history.shares_of_accelerometers, initial=0.0)
    above.set_ylim(-0.04 * top, 1.4 * top)  # room for the legend
    above.legend(loc="upper center", ncols=4)
    known = 100.0 * np.where(np.isfinite(history.shares), history.shares, 0.0)
    edges = np.append(numbers - 0.5, numbers[-1] + 0.5)
    mesh = below.pcolormesh(edges, np.arange(len(names) + 1), known.T, cmap="YlGnBu", vmin=0.0,
                            vmax=max(float(np.quantile(known, 0.98)), 1e-3), rasterized=True)  # fmt: skip
    lost = [each.value is None for each in history.parameters]
    below.set_yticks(np.arange(len(names)) + 0.5, [f"{own.label}{' not determined' if gone else ''}"
                                                   for own, gone in zip(names, lost, strict=True)])  # fmt: skip
    below.invert_yaxis()
    below.grid(visible=False)
    for row in range(4, len(names), 4) if len(names) <= STATE_COUNT else (4, 8, 12):
        below.axhline(row, color="white", linewidth=2.0)
    below.set_title("The same for each parameter")
    whole_numbers(below, numbers[0], numbers[-1])
    figure.colorbar(mesh, ax=below, label="share, %", extend="max", pad=0.01)


@drawn_on(8.0, 7.0)
def correlations(figure: Figure, result: Calibration) -> None:
    """Correlations of the parameters and of the effects' coefficients at the end of a run, if any is notable."""
    matrix, names = correlation(result.estimate), with_coefficients(result.model.coefficients)
    beside = np.where(np.eye(len(matrix), dtype=bool) | ~np.isfinite(matrix), 0.0, matrix)
    one, other = np.unravel_index(np.argmax(np.abs(beside)), beside.shape)
    if abs(beside[one, other]) < NOTABLE:
        largest = f"the largest, of {names[one].label} and {names[other].label}, is {beside[one, other]:.2g}"
        said = f"All correlations of parameters are smaller than {NOTABLE}: {largest.replace('-', '−')}."
        figure.set_size_inches(8.0, 1.5)
        return say(figure, said, "#222222")
    axes = figure.subplots()
    image = axes.imshow(np.ma.masked_invalid(matrix), cmap="PuOr_r", vmin=-1.0, vmax=1.0)
    axes.set_facecolor("#d9d9d9")
    axes.grid(visible=False)
    labels = [each.label for each in names]
    axes.set_xticks(range(len(names)), labels, rotation=90 if max(map(len, labels)) > 3 else 0)
    axes.set_yticks(range(len(names)), labels)
    axes.xaxis.tick_top()
    for edge in (3.5, 7.5, 11.5)[: 3 if len(names) > STATE_COUNT else 2]:
        axes.axhline(edge, color=GREY, linewidth=0.8)
        axes.axvline(edge, color=GREY, linewidth=0.8)
    for row, column in zip(*np.nonzero(np.abs(beside) >= NOTABLE), strict=True):
        value = float(beside[row, column])
        axes.text(column, row, f"{value:.2f}".replace("0.", ".").replace("-", "−"), ha="center", va="center",
                  fontsize=min(8.0, 110.0 / len(names)), color="white" if abs(value) > 0.65 else "#222222")  # fmt: skip
    lost = bool(np.isnan(np.diag(matrix)).any())
    axes.set_xlabel(f"Correlations; written from {NOTABLE} on{'; grey: not determined' if lost else ''}")
    figure.colorbar(image, ax=axes, label="correlation (no unit)", shrink=0.8)
