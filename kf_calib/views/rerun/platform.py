"""The platform frame in 3-D: the sensitive axes stand still in it, gravity moves from dwell to dwell.

Ellipsoids of 1 sigma sit at the tips of the axes, magnified by one factor for the whole run, so that they are seen to
shrink: along the axis the scale factor's sigma, across it the two angles' (s_i = K_i E_i, all without unit).
"""

from __future__ import annotations

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.results import Calibration, Estimate
from kf_calib.views.rerun.names import ACCELEROMETERS, GOLD, GREY, RED, WHITE
from kf_calib.views.rerun.series import above, crowd, ends, nis_band, times

FINAL_SIZE = 0.2  # of the largest final ellipsoid, as a part of the axis' length
THINNEST = 0.015  # thinner ones could not be seen
LARGEST = 1.2  # larger ones would hide the scene


def magnification(estimate: Estimate) -> float | None:
    """1, 2 or 5 times a power of ten, that makes the largest final sigma of s_i visible; None: none is determined."""
    sigmas = [spread.max() for _, spread, _ in _ellipsoids(estimate)]
    if not sigmas or max(sigmas) <= 0:
        return None
    wanted = FINAL_SIZE / max(sigmas)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted * (1 + 1e-9)) * decade)


def _ellipsoids(estimate: Estimate) -> list[tuple[int, Floats, Floats]]:
    """(accelerometer, sigmas (3,), their directions (3, 3) as columns) of the sensitivities that are determined."""
    out = list[tuple[int, Floats, Floats]]()
    for i in range(3):
        if not estimate.unseen[4 * i : 4 * i + 3].any():
            own = slice(4 * i, 4 * i + 3)
            variance, directions = np.linalg.eigh(estimate.covariance[own, own])
            out.append((i, np.sqrt(np.maximum(variance, 0.0)), directions * np.linalg.det(directions)))
    return out


def _axes(estimate: Estimate) -> Floats:
    """E_i (3, 3), an axis a row."""
    sensitivity = estimate.state[:12].reshape(3, 4)[:, :3]
    return sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)


def log_platform(result: Calibration, stream: rr.RecordingStream) -> None:
    log_frame(stream)
    _log_axes(result, stream)
    _log_ellipsoids(result, stream)
    _log_directions(result, stream)


def log_frame(stream: rr.RecordingStream) -> None:
    """What stands still: the sphere of directions, the platform's axes, the nominal sensitive axes."""
    stream.log("platform", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    circles = [np.roll(circle, k, axis=1) for k in range(3)]
    stream.log("platform/sphere", rr.LineStrips3D(circles, colors=(75, 75, 80), radii=0.003), static=True)
    stream.log("platform/frame", rr.Arrows3D(vectors=1.4 * np.eye(3), colors=GREY, radii=0.008), static=True)
    letters = rr.Points3D(1.5 * np.eye(3), radii=0.0, colors=GREY, labels=["X", "Y", "Z"], show_labels=True)
    stream.log("platform/frame/letters", letters, static=True)


def _log_axes(result: Calibration, stream: rr.RecordingStream) -> None:
    """Estimated sensitive axes after each dwell; those not yet determined are left out."""
    seen = [[i for i, _, _ in _ellipsoids(visit.estimate)] for visit in result.visits]
    vectors = [_axes(visit.estimate)[own] for visit, own in zip(result.visits, seen, strict=True)]
    which = [i for own in seen for i in own]
    columns = rr.Arrows3D.columns(
        vectors=np.concatenate(vectors),
        colors=[ACCELEROMETERS[i] for i in which],
        labels=[f"E{'₁₂₃'[i]}" for i in which],
        radii=[0.016] * len(which),
    ).partition([len(own) for own in seen])
    rr.send_columns("platform/axes", times(*ends(result.visits)), columns, recording=stream)


def _log_ellipsoids(result: Calibration, stream: rr.RecordingStream) -> None:
    factor = magnification(result.estimate)
    if factor is None:
        return
    shown = [
        [(i, factor * s, turn) for i, s, turn in _ellipsoids(v.estimate) if factor * s.max() < LARGEST]
        for v in result.visits
    ]
    centres = [_axes(v.estimate)[[i for i, _, _ in own]] for v, own in zip(result.visits, shown, strict=True)]
    flat = [each for own in shown for each in own]
    if not flat:
        return
    columns = rr.Ellipsoids3D.columns(
        centers=np.concatenate(centres),
        half_sizes=[np.maximum(half, THINNEST) for _, half, _ in flat],
        quaternions=[Rotation.from_matrix(turn).as_quat() for _, _, turn in flat],
        colors=[(*ACCELEROMETERS[i], 120) for i, _, _ in flat],
    ).partition([len(own) for own in shown])
    rr.send_columns("platform/uncertainty", times(*ends(result.visits)), columns, recording=stream)
    stream.log("platform/uncertainty", rr.Ellipsoids3D.from_fields(fill_mode="solid"), static=True)


def _log_directions(result: Calibration, stream: rr.RecordingStream) -> None:
    """Specific force of each dwell on the unit sphere: a point that stays, and an arrow while the dwell lasts."""
    visits = result.visits
    force = np.array([visit.dwell.means[1:4] for visit in visits])
    direction = force / np.linalg.norm(force, axis=1, keepdims=True)
    done, number = ends(visits)
    begun = np.array([visit.dwell.start_s for visit in visits])
    count = len(visits)
    points = rr.Points3D.columns(positions=direction, colors=_verdicts(result), radii=[0.025 * crowd(count)] * count)
    rr.send_columns("platform/visited", times(done, number), points, recording=stream)
    arrows = rr.Arrows3D.columns(
        vectors=1.25 * direction, colors=[GOLD] * count, radii=[0.016] * count, labels=["up"] * count
    )
    rr.send_columns("platform/up", times(begun, number), arrows, recording=stream)


def _verdicts(result: Calibration) -> list[tuple[int, int, int]]:
    """Grey where a dwell could not be judged, red where its NIS is above chi-squared's 95 % band, else white."""
    dof = np.array([visit.dof for visit in result.visits])
    nis = np.array([visit.nis for visit in result.visits])
    bad = above(nis, nis_band(np.maximum(dof, 1)))
    return [GREY if free <= 0 else RED if out else WHITE for free, out in zip(dof, bad, strict=True)]
