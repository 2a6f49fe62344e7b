"""Residuals over their sigma against quantities of the bench, and on spheres of the directions of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import Unit, shown_whole
from kf_calib.views.rerun.chart import LEFT, RIGHT, TOP, Axis, Chart, thin, write
from kf_calib.views.rerun.names import ACCELEROMETERS, GREY, WHITE
from kf_calib.views.rerun.sigmas import ROOM

BOUND = 2.0
"""Lines are drawn at so many sigma."""
NEGATIVE, POSITIVE, NONE = np.array([70, 140, 255]), np.array([255, 110, 50]), np.array([150, 150, 155])
_FULL = 4.0  # sigma at which the colour of a residual is full
_APART, _BELOW = 2.6, 2.5  # between the middles of spheres


class Log(Protocol):
    """Sends an entity of a chart: for all times, or for a moment of a timeline."""

    def __call__(self, path: str, what: rr.Archetype) -> None: ...


def forever(stream: rr.RecordingStream) -> Log:
    """Sends what stands for all times."""
    return lambda path, what: stream.log(path, what, static=True)


def at_step(stream: rr.RecordingStream, timeline: str, number: int) -> Log:
    """Sends what stands from one step of a timeline to the next."""

    def send(path: str, what: rr.Archetype) -> None:
        stream.set_time(timeline, sequence=number)
        stream.log(path, what)

    return send


def unit_of(driver: Driver) -> Unit:
    """The unit in which a driver is drawn."""
    return shown_whole(driver.unit, float(np.abs(driver.values).max()))


def drawn_values(driver: Driver) -> Floats:
    """The values (D, 3) of a driver in its unit."""
    return driver.values * unit_of(driver).per_si


def title_of(driver: Driver) -> str:
    """What a driver is, with its unit."""
    return f"{driver.words}, {unit_of(driver).label}"


def panel(
    path: str, values: Floats, below: str, reach: float, title: str, place: tuple[int, int],
    size: tuple[float, float], i: int | None = None,
) -> Chart:  # fmt: skip
    """A chart of residuals over their sigma in a grid of charts; ``place``: its row and column."""
    (row, column), (wide, tall) = place, size
    corner = (column * (wide + LEFT + RIGHT), row * (tall + TOP + ROOM))
    colour = WHITE if i is None else ACCELEROMETERS[i]
    return Chart(path, Axis.around(values, below), Axis(-reach, reach), title, corner, wide, tall, colour)


def reach_of(ratios: Sequence[Floats]) -> float:
    """Half the range of axes that hold all of these residuals over their sigma."""
    return 1.08 * max(1.25 * BOUND, *(float(np.abs(each).max()) for each in ratios))


def bounds(chart: Chart, log: Log) -> None:
    """Send lines at 0 and +-2 sigma."""
    lines = [chart.level(each) for each in (-BOUND, 0.0, BOUND)]
    log(f"{chart.path}/bounds", rr.LineStrips2D(lines, colors=GREY, radii=[thin(0.4), thin(0.9), thin(0.4)]))


def points(chart: Chart, x: Floats, ratios: Floats, log: Log, i: int | None = None) -> None:
    """Send residuals: (D,) of accelerometer ``i``, or (D, 3) of all."""
    count = len(x)
    colours = np.repeat([ACCELEROMETERS[i]], count, axis=0) if i is not None else np.tile(ACCELEROMETERS, (count, 1))
    places = chart.at(x.ravel(), ratios.ravel())
    radius = thin((3.6 if i is not None else 2.6) * (1.0 if count < 60 else 0.5))
    log(f"{chart.path}/residuals", rr.Points2D(places, colors=colours, radii=radius, draw_order=5.0))


def spheres(origin: str, rows: int) -> rrb.Spatial3DView:
    """The view of three spheres in each row."""
    far, low = (5.3, -0.1) if rows == 1 else (6.6, -0.5 * _BELOW)
    eye = rrb.EyeControls3D(position=(0.0, low + 0.25 * far, far), look_target=(0.0, low, 0.0), eye_up=(0, 1, 0))
    named = "; below: what is left" if rows > 1 else ""
    name = f"residual by direction of gravity: blue −4σ, orange +4σ{named}"
    return rrb.Spatial3DView(origin=origin, name=name, line_grid=False, eye_controls=eye)


def log_spheres(result: Calibration, ratios: Floats, path: str, row: int, stream: rr.RecordingStream, log: Log) -> None:
    """Where gravity pointed in the platform, a sphere an accelerometer, coloured and sized by the signed residual."""
    force = np.array([visit.dwell.means[1:4] for visit in result.visits])
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, 73)
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    for i in range(3):
        middle = np.array([(i - 1) * _APART, -row * _BELOW, 0.0])
        circles = [np.roll(circle, k, axis=1) + middle for k in range(3)]
        stream.log(f"{path}/{i + 1}/sphere", rr.LineStrips3D(circles, colors=(75, 75, 80), radii=0.004), static=True)
        arrow = rr.Arrows3D(origins=[middle], vectors=[1.3 * _axis(result, i)], colors=ACCELEROMETERS[i], radii=0.02,
                            labels=[f"E{'₁₂₃'[i]}"], show_labels=True)  # fmt: skip
        stream.log(f"{path}/{i + 1}/axis", arrow, static=True)
        weight = np.clip(np.abs(ratios[:, i]) / _FULL, 0.0, 1.0)
        found = rr.Points3D(directions + middle, colors=signed(ratios[:, i]), radii=0.03 + 0.09 * weight)
        log(f"{path}/{i + 1}/residuals", found)


def _axis(result: Calibration, i: int) -> Floats:
    """Return the direction (3,) of a sensitive axis in the platform."""
    sensitivity = result.estimate.state[4 * i : 4 * i + 3]
    return sensitivity / np.linalg.norm(sensitivity)


def signed(ratios: Floats) -> NDArray[np.uint8]:
    """RGB (n, 3): blue for residuals below zero, orange above, grey for none."""
    weight = np.clip(np.abs(ratios) / _FULL, 0.0, 1.0)[:, None]
    end = np.where(ratios[:, None] < 0.0, NEGATIVE, POSITIVE)
    return np.round(NONE + weight * (end - NONE)).astype(np.uint8)


def of_share(driver: Driver) -> str:
    """How much of the misfit goes with a driver, in a few words."""
    if driver.p_value > 0.01 or driver.share < 0.005:
        return "no more than noise"
    return f"{100 * driver.share:.0f} % of the misfit"


def driver_charts(drivers: Sequence[Driver], reach: float, rows: int) -> list[list[Chart]]:
    """For each driver ``rows`` charts, one below the other; four drivers a row."""
    size = (330.0, 330.0 / rows if rows > 1 else 330.0)
    out = list[list[Chart]]()
    for k, driver in enumerate(drivers):
        row, column = divmod(k, 4)
        titles = [f"{driver.words}: {of_share(driver)}", *["what the explanation leaves"] * (rows - 1)]
        units = [*[""] * (rows - 1), f"{driver.symbol}, {unit_of(driver).label}"]
        out.append([
            panel(f"drivers/{driver.symbol}/{below}", drawn_values(driver), units[below], reach, titles[below],
                  (rows * row + below, column), size) for below in range(rows)
        ])  # fmt: skip
    return out


def say(stream: rr.RecordingStream, path: str, text: str) -> None:
    """Write a sentence where there is nothing to draw."""
    write(stream, path, [((0.0, 0.0), text)], GREY)
