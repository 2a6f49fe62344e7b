"""Where to go next: the orientation that tells two suspects apart, or shows what none has shown yet."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.effects import Effect
from kf_calib.fitting import Fit
from kf_calib.folding import candidate_columns
from kf_calib.information import accumulated, whitened
from kf_calib.noise import steps
from kf_calib.prospect import Prospect
from kf_calib.samples import Floats
from kf_calib.triangle import triangle

_POSES = 160
_STEP_DEG = 5.0


@dataclass(frozen=True)
class Advice:
    """Gimbal angles of the next orientation, deg; separation: in sigma, before and after a dwell there."""

    gimbal_deg: tuple[float, ...]
    before: float
    after: float


def to_tell_apart(fitted: Fit, one: Effect, coefficients: Floats, others: Sequence[Effect]) -> Advice | None:
    """The orientation after which the effect ``one`` of this size differs most from each of the ``others``.

    Separation: what is left of its signal, in sigma, when the model and the other have explained all they can; the
    smallest over the others (no others: over the model alone).
    """
    poses = _poses(fitted)
    if poses is None:
        return None
    before, after = math.inf, np.full(len(poses), np.inf)
    for rival in [[other] for other in others] or [[]]:
        factor, rows = _with_next(fitted, [*rival, one], poses)
        count = factor.shape[1] - len(coefficients)
        mix = np.zeros((factor.shape[1], count + 1))
        mix[:count, :count], mix[count:, count] = np.eye(count), coefficients
        before = min(before, abs(float(triangle(factor @ mix)[-1, -1])))
        so_far = np.broadcast_to(factor @ mix, (len(rows), len(factor), count + 1))
        after = np.minimum(after, np.abs(triangle(np.concatenate([so_far, rows @ mix], axis=1))[:, -1, -1]))
    best = int(np.argmax(after))
    return Advice(tuple(np.degrees(poses[best]).round(1).tolist()), before, float(after[best]))


def to_show(fitted: Fit, hidden: Sequence[Effect]) -> tuple[Advice, int] | None:
    """The orientation that shows most of what is ``hidden`` so far, each at the scale of its kind; and how many."""
    poses = _poses(fitted)
    if poses is None or not hidden:
        return None
    factor, rows = _with_next(fitted, hidden, poses)
    width, shown = fitted.carried.model.count, np.zeros(len(poses))
    ends = np.cumsum([width, *(len(effect.coefficients) for effect in hidden)]).tolist()
    scales = np.array([coefficient.scale for effect in hidden for coefficient in effect.coefficients])
    for start, end in itertools.pairwise(ends):
        kept = np.r_[0:width, start:end]
        so_far = np.broadcast_to(factor[:, kept], (len(rows), len(factor), len(kept)))
        left = np.abs(triangle(np.concatenate([so_far, rows[:, :, kept]], axis=1))[:, width:, width:])
        shown += (left * scales[start - width : end - width]).max(axis=(1, 2)) > 5.0
    best = int(np.argmax(shown))
    return Advice(tuple(np.degrees(poses[best]).round(1).tolist()), 0.0, float(shown[best])), int(shown[best])


def _poses(fitted: Fit) -> Floats | None:
    """Gimbal angles (m, k) to choose from, rad: multiples of 45 deg and a spread of others; None without gimbals."""
    count = len(fitted.carried.model.bench.axes)
    if not count:
        return None
    rng = np.random.default_rng(0)
    coarse = rng.integers(-4, 4, (_POSES // 2, count)) * 45.0
    fine = np.round(rng.uniform(-180.0, 180.0, (_POSES // 2, count)) / _STEP_DEG) * _STEP_DEG
    return np.radians(np.concatenate([coarse, fine]))


def _with_next(fitted: Fit, effects: Sequence[Effect], poses: Floats) -> tuple[Floats, Floats]:
    """Triangle of the run so far over [H | G], and whitened rows (m, 3, p + q) of a dwell's mean at each pose."""
    carried, noise = fitted.carried, fitted.noise.judging
    model, state = carried.model, carried.state
    added = candidate_columns(carried.dwells, effects, model.bench, state)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(carried.columns, added, strict=True)]
    upper = accumulated(whitened(carried.dwells, columns, noise, state), steps(carried.dwells, noise))
    prospect = replace(Prospect.following(fitted), noise=noise)
    return upper[:-1, :-1], prospect.columns(effects, poses)
