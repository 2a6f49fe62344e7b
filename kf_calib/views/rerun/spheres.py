"""Residuals on spheres of the directions of gravity, an accelerometer each, beside its sensitive axis."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.results import Calibration
from kf_calib.views.rerun.names import ACCELEROMETERS

NEGATIVE, POSITIVE, NONE = np.array([70, 140, 255]), np.array([255, 110, 50]), np.array([150, 150, 155])
_FULL = 4.0  # sigma at which the colour of a residual is full
_PITCH = 2.6  # between the middles of spheres


class Log(Protocol):
    """Sends an entity: for all times, or for a moment of a timeline."""

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


def spheres(origin: str, columns: int) -> rrb.Spatial3DView:
    """The view of three spheres, one below the other, in each column."""
    beside = 0.5 * (columns - 1) * _PITCH
    eye = rrb.EyeControls3D(position=(beside, -0.6 * _PITCH, 8.2), look_target=(beside, -_PITCH, 0.0), eye_up=(0, 1, 0))
    name = f"blue −4σ, orange +4σ{'; right: left over' if columns > 1 else ''}"  # longer titles are cut off
    return rrb.Spatial3DView(origin=origin, name=name, line_grid=False, eye_controls=eye)


def log_spheres(
    result: Calibration, ratios: Floats, path: str, column: int, stream: rr.RecordingStream, log: Log
) -> None:
    """Where gravity pointed in the platform, a sphere an accelerometer, coloured and sized by the signed residual."""
    force = np.array([visit.dwell.means[1:4] for visit in result.visits])
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, 73)
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    for i in range(3):
        middle = np.array([column * _PITCH, -i * _PITCH, 0.0])
        circles = [np.roll(circle, k, axis=1) + middle for k in range(3)]
        stream.log(f"{path}/{i + 1}/sphere", rr.LineStrips3D(circles, colors=(75, 75, 80), radii=0.004), static=True)
        sensitivity = result.estimate.state[4 * i : 4 * i + 3]
        axis = sensitivity / np.linalg.norm(sensitivity)
        arrow = rr.Arrows3D(origins=[middle], vectors=[1.3 * axis], colors=ACCELEROMETERS[i], radii=0.02,
                            labels=[f"E{'₁₂₃'[i]}"], show_labels=True)  # fmt: skip
        stream.log(f"{path}/{i + 1}/axis", arrow, static=True)
        weight = np.clip(np.abs(ratios[:, i]) / _FULL, 0.0, 1.0)
        points = rr.Points3D(directions + middle, colors=signed(ratios[:, i]), radii=0.03 + 0.09 * weight)
        log(f"{path}/{i + 1}/residuals", points)


def signed(ratios: Floats) -> NDArray[np.uint8]:
    """RGB (n, 3): blue for residuals below zero, orange above, grey for none."""
    weight = np.clip(np.abs(ratios) / _FULL, 0.0, 1.0)[:, None]
    end = np.where(ratios[:, None] < 0.0, NEGATIVE, POSITIVE)
    return np.round(NONE + weight * (end - NONE)).astype(np.uint8)
