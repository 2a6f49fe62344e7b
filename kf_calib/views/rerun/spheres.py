"""What is in three dimensions: residuals on spheres of the directions of gravity, and the platform, in whose frame the
sensitive axes stand still and gravity moves from dwell to dwell.

Ellipsoids of 1 sigma sit at the tips of the axes, magnified by one factor for the whole run, with a bar that shows the
scale; the first ones stay as wires, so that the others are seen to shrink. Along the axis they have the scale factor's
sigma, across it the two angles' (s_i = K_i E_i, all without unit).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, Vector
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.filter_history import nis_band
from kf_calib.estimation.results import Calibration
from kf_calib.support.units import shown
from kf_calib.views.notation import written
from kf_calib.views.rerun.names import ACCELEROMETERS, DARK, GOLD, GREY, RED, WHITE, thin
from kf_calib.views.rerun.series import begins, columns_of, crowd, ends

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
    return rrb.Spatial3DView(origin=origin, name="residuals over σ", line_grid=False, eye_controls=eye, background=DARK)


def log_key(path: str, titles: Sequence[str], log: Log) -> None:
    """The key of the colours below the spheres, and what the spheres of each column show above them."""
    ratios = np.array([-_FULL, -0.5 * _FULL, 0.0, 0.5 * _FULL, _FULL])
    beside = 0.5 * (len(titles) - 1) * _PITCH
    places = [(beside + 0.6 * (k - 2), -2.0 * _PITCH - 1.45, 0.0) for k in range(len(ratios))]
    words = [f"{'+' if ratio > 0 else ''}{ratio:g}σ".replace("-", "−") for ratio in ratios]
    log(f"{path}/key", rr.Points3D(places, colors=signed(ratios), radii=_radii(ratios), labels=words, show_labels=True))
    tops = [(k * _PITCH, 1.4, 0.0) for k in range(len(titles))]
    log(f"{path}/titles", rr.Points3D(tops, colors=WHITE, radii=0.0, labels=list(titles), show_labels=True))


def log_spheres(
    result: Calibration, ratios: Floats, path: str, column: int, stream: rr.RecordingStream, log: Log,
    disturbed: Collection[int] = (),
) -> None:  # fmt: skip
    """Where gravity pointed in the platform, a sphere an accelerometer, coloured and sized by the signed residual.

    disturbed: numbers of dwells that get a red ring.
    """
    marked = {k: visit.dwell.number for k, visit in enumerate(result.visits) if visit.dwell.number in disturbed}
    directions = _directions(result)
    for i in range(3):
        middle = np.array([column * _PITCH, -i * _PITCH, 0.0])
        stream.log(f"{path}/{i + 1}/sphere", _sphere(middle, 73, 0.004), static=True)
        sensitivity = result.estimate.state[4 * i : 4 * i + 3]
        axis = sensitivity / np.linalg.norm(sensitivity)
        arrow = rr.Arrows3D(origins=[middle], vectors=[1.3 * axis], colors=ACCELEROMETERS[i], radii=0.02,
                            labels=[f"E{'₁₂₃'[i]}"], show_labels=True)  # fmt: skip
        stream.log(f"{path}/{i + 1}/axis", arrow, static=True)
        points = rr.Points3D(directions + middle, colors=signed(ratios[:, i]), radii=_radii(ratios[:, i]))
        log(f"{path}/{i + 1}/residuals", points)
        rings = [_ring(middle, directions[k]) for k in marked]
        names = [f"dwell {number}: disturbed" for number in marked.values()] if i == 0 else None
        log(f"{path}/{i + 1}/disturbed", rr.LineStrips3D(rings, colors=RED, radii=0.012, labels=names))


def _directions(result: Calibration) -> Floats:
    """Return the directions (n, 3) of specific force in the platform, by the mean readings of each dwell."""
    force = np.array([visit.dwell.means[1:4] for visit in result.visits])
    return force / np.linalg.norm(force, axis=1, keepdims=True)


def _sphere(middle: Floats, points: int, radius: float) -> rr.LineStrips3D:
    """Return three circles on a unit sphere, about its axes, of so many points each."""
    turn = np.linspace(0, 2 * np.pi, points)
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    circles = [np.roll(circle, k, axis=1) + middle for k in range(3)]
    return rr.LineStrips3D(circles, colors=(75, 75, 80), radii=radius)


def _radii(ratios: Floats) -> Floats:
    return 0.03 + 0.09 * np.clip(np.abs(ratios) / _FULL, 0.0, 1.0)


def _ring(middle: Floats, direction: Floats) -> Floats:
    """Return points (n, 3) of a circle on a sphere about a direction."""
    across = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    across = across / np.linalg.norm(across)
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:, None]
    around = np.cos(turn) * across + np.sin(turn) * np.cross(direction, across)
    return np.asarray(middle + direction + 0.2 * around, float)


def signed(ratios: Floats) -> NDArray[np.uint8]:
    """RGB (n, 3): blue for residuals below zero, orange above, grey for none."""
    weight = np.clip(np.abs(ratios) / _FULL, 0.0, 1.0)[:, None]
    end = np.where(ratios[:, None] < 0.0, NEGATIVE, POSITIVE)
    return np.round(NONE + weight * (end - NONE)).astype(np.uint8)


FINAL_SIZE = 0.16  # of the largest final ellipsoid, as a part of the axis' length
THINNEST = 0.008  # thinner ones could not be seen
LARGEST = 0.7  # larger ones would hide the scene
BAR = 0.6  # at most so long is the bar that shows the scale
FLOOR = -1.35  # height at which it lies

Ellipsoid = tuple[int, Floats, Floats]
"""Accelerometer, sigmas (3,) of its sensitivity, and their directions (3, 3) as columns."""


def rounded(wanted: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above it."""
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted * (1 + 1e-9)) * decade)


def magnification(final: Sequence[Ellipsoid]) -> float | None:
    """A round factor that makes the largest final sigma visible; None: none is determined."""
    largest = max((float(spread.max()) for _, spread, _ in final), default=0.0)
    return rounded(FINAL_SIZE / largest) if largest > 0.0 else None


def ellipsoids_of(estimate: Estimate) -> list[Ellipsoid]:
    """Return those of the sensitivities that are determined."""
    determined = list[Ellipsoid]()
    for i in range(3):
        states = slice(4 * i, 4 * i + 3)
        if not estimate.unseen[states].any():
            variance, directions = np.linalg.eigh(estimate.covariance[states, states])
            determined.append((i, np.sqrt(np.maximum(variance, 0.0)), directions * np.linalg.det(directions)))
    return determined


def magnified(estimate: Estimate) -> str:
    """What the title of the view says of the ellipsoids."""
    factor = magnification(ellipsoids_of(estimate))
    return f", axes with 1σ ×{written(factor)}" if factor else ""


def _axes(estimate: Estimate) -> Floats:
    """E_i (3, 3), an axis a row."""
    sensitivity = estimate.state[:12].reshape(3, 4)[:, :3]
    return sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)


def log_platform(result: Calibration, stream: rr.RecordingStream) -> None:
    log_frame(stream)
    _log_axes(result, stream)
    numbers = [visit.dwell.number for visit in result.visits]
    steps = [ellipsoids_of(visit.estimate) for visit in result.visits]
    tips = [_axes(visit.estimate) for visit in result.visits]
    _log_ellipsoids(stream, columns_of(ends(result.visits)), numbers, steps, tips, result.bench)
    _log_directions(result, stream)


def log_frame(stream: rr.RecordingStream) -> None:
    """What stands still: the sphere of directions, the platform's axes, the nominal sensitive axes."""
    stream.log("platform", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    stream.log("platform/sphere", _sphere(np.zeros(3), 97, 0.003), static=True)
    stream.log("platform/frame", rr.Arrows3D(vectors=1.4 * np.eye(3), colors=GREY, radii=0.008), static=True)
    letters = rr.Points3D(1.5 * np.eye(3), radii=0.0, colors=GREY, labels=["X", "Y", "Z"], show_labels=True)
    stream.log("platform/frame/letters", letters, static=True)


def _log_axes(result: Calibration, stream: rr.RecordingStream) -> None:
    """Estimated sensitive axes after each dwell; those not yet determined are left out."""
    seen = [[i for i, _, _ in ellipsoids_of(visit.estimate)] for visit in result.visits]
    vectors = [_axes(visit.estimate)[own] for visit, own in zip(result.visits, seen, strict=True)]
    which = [i for own in seen for i in own]
    columns = rr.Arrows3D.columns(
        vectors=np.concatenate(vectors),
        colors=[ACCELEROMETERS[i] for i in which],
        labels=[f"E{'₁₂₃'[i]}" for i in which],
        radii=[0.016] * len(which),
    ).partition([len(own) for own in seen])
    rr.send_columns("platform/axes", columns_of(ends(result.visits)), columns, recording=stream)


def _log_ellipsoids(
    stream: rr.RecordingStream, index: list[rr.TimeColumn], numbers: Sequence[int], steps: list[list[Ellipsoid]],
    tips: list[Floats], bench: Bench,
) -> None:  # fmt: skip
    """Ellipsoids at the tips (3, 3) of the axes after each step, all magnified alike, with a bar that shows the scale.

    The first that are not too large to be drawn stay as wires, so that the others are seen to be smaller.
    """
    factor = magnification(steps[-1])
    if factor is None:
        return
    shown = [[each for each in own if factor * each[1].max() < LARGEST] for own in steps]
    fields = [_fields(own, tip, factor) for own, tip in zip(shown, tips, strict=True)]
    flat = {name: [each for own in fields for each in own[name]] for name in fields[0]}
    columns = rr.Ellipsoids3D.columns(**flat).partition([len(own) for own in shown])
    rr.send_columns("platform/uncertainty", index, columns, recording=stream)
    mode = rr.components.FillMode.TransparentFillMajorWireframe
    stream.log("platform/uncertainty", rr.Ellipsoids3D.from_fields(fill_mode=mode, line_radii=thin(0.8)), static=True)
    first = next((k for k, own in enumerate(shown) if len(own) == len(shown[-1])), len(shown) - 1)
    wires = rr.Ellipsoids3D(**fields[first], fill_mode=rr.components.FillMode.MajorWireframe, line_radii=thin(0.4))
    stream.log("platform/first", wires if first < len(shown) - 1 else rr.Clear(recursive=False), static=True)
    _log_bar(stream, bench, factor, f"; wires: orientation {numbers[first]}" if first < len(shown) - 1 else "")


def _fields(ellipsoids: list[Ellipsoid], tips: Floats, factor: float) -> dict[str, Any]:
    """Return what Rerun draws ellipsoids from."""
    return {
        "centers": [tips[i] for i, _, _ in ellipsoids],
        "half_sizes": [np.maximum(factor * sigma, THINNEST) for _, sigma, _ in ellipsoids],
        "quaternions": [Rotation.from_matrix(turn).as_quat() for _, _, turn in ellipsoids],
        "colors": [(*ACCELEROMETERS[i], 150) for i, _, _ in ellipsoids],
    }


def _log_bar(stream: rr.RecordingStream, bench: Bench, factor: float, words: str) -> None:
    """A bar of a round angle below the platform as it is seen, magnified as the ellipsoids are."""
    angle, ratio = shown("rad"), shown("1")
    length = rounded(BAR / factor * angle.per_si)
    half = 0.5 * factor * length / angle.per_si
    *ends, place = with_y_up(bench, (-half, FLOOR, 0.0), (half, FLOOR, 0.0), (0.0, FLOOR - 0.04, 0.0))
    bar = rr.LineStrips3D([ends], colors=WHITE, radii=0.012)
    stream.log("platform/scale", bar, static=True)
    same = written(float(f"{length / angle.per_si * ratio.per_si:.2g}"))
    text = f"{written(length)} {angle.label}, {same} {ratio.label if ratio.label != '1' else 'of K'}{words}"
    label = rr.Points3D([place], labels=[text], radii=0.0, colors=WHITE, show_labels=True)
    stream.log("platform/scale/label", label, static=True)


def with_y_up(bench: Bench, *vectors: Vector) -> Floats:
    """Vectors (n, 3) of a frame with y up in the platform, whatever axis of it is up where all angles are zero."""
    at_rest = np.zeros((1, len(bench.axes))) if bench.axes else np.array([[0.0, 0.0, 0.0, 1.0]])
    return bench.to_platform(np.array(vectors), at_rest)


def _log_directions(result: Calibration, stream: rr.RecordingStream) -> None:
    """Specific force of each dwell on the unit sphere: a point that stays, and an arrow while the dwell lasts.

    The point is grey where the dwell could not be judged, red where its NIS is above chi-squared's band, else white.
    """
    direction, done, count = _directions(result), ends(result.visits), len(result.visits)
    dof, nis = (np.array([getattr(visit, name) for visit in result.visits]) for name in ("dof", "nis"))
    high = nis > nis_band(dof)[:, 1]
    colours = [GREY if free <= 0 else RED if bad else WHITE for free, bad in zip(dof, high, strict=True)]
    points = rr.Points3D.columns(positions=direction, colors=colours, radii=[0.025 * crowd(count)] * count)
    rr.send_columns("platform/visited", columns_of(done), points, recording=stream)
    arrows = rr.Arrows3D.columns(
        vectors=1.25 * direction, colors=[GOLD] * count, radii=[0.016] * count, labels=["up"] * count
    )
    rr.send_columns("platform/up", columns_of(done | begins(result.visits)), arrows, recording=stream)
