"""Where to go next: the orientation that tells two suspects apart, shows what none has, or sharpens the twelve."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.design.gimbal_limits import wrapped
from kf_calib.design.predicted_information import Prospect
from kf_calib.dwells.qr import triangle
from kf_calib.effects import Effect
from kf_calib.estimation.cross_validation import SAME_POSE_DEG
from kf_calib.estimation.dwell_columns import candidate_columns
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.noise_model import Noise, steps
from kf_calib.estimation.square_root_information import accumulate, whiten

ENOUGH = 6.0
"""Sigma apart: of two equally likely the wrong one is taken once in a thousand, and more tells no more."""

_POSES = 640
_STEP_DEG = 5.0
_STEPS = 12
_WAY_S = 10.0  # to the next orientation, where there has been none
_TOLD = 0.1  # sigma: effects that are less apart after any next dwell are told apart by none
_MOVE = 3.0  # dwells: what it costs to go somewhere and stay for one
_WAITS = (0.0, 0.25, 1.0)  # of the run so far, that may be spent where it goes next


@dataclass(frozen=True)
class Advice:
    """Gimbal angles of the next orientation, deg; separation: in sigma, before and after a dwell there.

    stay_s: how long to stay there, where it takes more than a dwell as they were so far.
    told: what it tells apart.
    """

    gimbal_deg: tuple[float, ...]
    before: float
    after: float
    stay_s: float | None = None
    told: tuple[str, ...] = ()


def to_tell_apart(fitted: Fit, one: Effect, coefficients: Floats, others: Sequence[Effect]) -> Advice | None:
    """The orientation after which the effect ``one`` of this size differs most from each of the ``others``.

    Separation: what is left of its signal, in sigma, when the model and the other have explained all they can; the
    smallest over the others (no others: over the model alone). What differs in time only is told apart by time: a
    longer stay is advised where the square of the separation grows by more an hour with it, to go somewhere being worth
    three dwells, and 6 sigma as much as more. An effect that holds this one as a special case is told apart nowhere,
    and left out.
    """
    poses = _poses(fitted)
    if poses is None:
        return None
    waits_s = np.array(_WAITS) * fitted.dwells[-1].end_s
    each = {str(other): _separations(fitted, one, coefficients, [other], poses, waits_s) for other in others}
    each = {name: own for name, own in each.items() if own[1].max() > _TOLD}
    every = list(each.values()) or [_separations(fitted, one, coefficients, [], poses, waits_s)]
    before, after = min(own[0] for own in every), np.min([own[1] for own in every], axis=0)
    dwell_s = _each_s(fitted)
    farthest = after.max(axis=1)
    useful = np.minimum(farthest, ENOUGH) if before < ENOUGH else farthest[:1]
    wait = int(np.argmax((useful**2 - before**2) / (_MOVE * dwell_s + waits_s[: len(useful)])))
    best = int(np.argmax(after[wait]))
    stay_s = float(waits_s[wait] + dwell_s) if wait else None
    angles = tuple(np.degrees(poses[best]).round(1).tolist())
    return Advice(angles, before, float(after[wait, best]), stay_s, tuple(each))


def _separations(
    fitted: Fit, one: Effect, coefficients: Floats, others: Sequence[Effect], poses: Floats, waits_s: Floats
) -> tuple[float, Floats]:
    """What is left of an effect, in sigma, when the model and others have explained all they can: now, and after a
    dwell at each pose after each wait (w, m)."""
    factor, rows = _with_next(fitted, [*others, one], poses, waits_s=waits_s)
    count = factor.shape[1] - len(coefficients)
    mix = np.zeros((factor.shape[1], count + 1))
    mix[:count, :count], mix[count:, count] = np.eye(count), coefficients
    so_far = np.broadcast_to(factor @ mix, (*rows.shape[:2], len(factor), count + 1))
    after = np.abs(triangle(np.concatenate([so_far, rows @ mix], axis=2))[..., -1, -1])
    return abs(float(triangle(factor @ mix)[-1, -1])), after


def to_show(fitted: Fit, hidden: Sequence[Effect]) -> tuple[Advice, int] | None:
    """The orientation that shows most of what is ``hidden`` so far, each at the scale of its kind; and how many."""
    poses = _poses(fitted)
    if poses is None or not hidden:
        return None
    factor, (rows,) = _with_next(fitted, hidden, poses)
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


@dataclass(frozen=True)
class Course:
    """How the twelve sigmas would fall over the orientations that sharpen them most, one after another.

    gimbal_deg: the first of them; sigma (N + 1, 12): now and after each; dwells: so far; each_s: a dwell and the way
    to it.
    """

    gimbal_deg: tuple[float, ...]
    sigma: Floats
    dwells: int
    each_s: float

    def sharpened(self, sizes: Floats) -> tuple[str, float]:
        """The parameter whose sigma is largest over ``sizes`` (12,), and by which factor its sigma falls next."""
        worst = int(np.argmax(self.sigma[0] / sizes))
        return paper_parameters.SYMBOLS[worst], float(self.sigma[1, worst] / self.sigma[0, worst])

    def seconds_to(self, wanted: Floats, sigma: Floats) -> Floats:
        """Seconds (12,) until each sigma is as wanted (12,); beyond the course they fall by the root of the dwells.

        ``sigma`` (12,): as they are now; NaN counts as far from any target.
        """
        last, steps = self.sigma[-1], len(self.sigma) - 1
        reached = self.sigma <= wanted
        beyond = (self.dwells + steps) * (last / wanted) ** 2 - self.dwells
        needed = np.where(reached.any(axis=0), reached.argmax(axis=0), np.ceil(beyond))
        return np.where(sigma <= wanted, 0.0, np.maximum(needed, 1.0) * self.each_s)


def course(fitted: Fit, sizes: Floats, count: int = _STEPS) -> Course | None:
    """The orientations that sharpen the twelve parameters most, each chosen after those before it.

    Of the candidates the one that makes the sum of (sigma / size)^2 smallest, which is ruled by the worst. ``sizes``
    (12,): targets, or what sigmas are compared by; inf for what does not matter. None without gimbals.
    """
    poses = _poses(fitted)
    if poses is None:
        return None
    factor, (rows,) = _with_next(fitted, [], poses, fitted.noise)
    jacobian = paper_parameters.jacobian(fitted.carried.state[:STATE_COUNT])
    at_least = np.diag(1.0 / np.maximum(fitted.carried.sizes, 1.0))  # what is not seen at all: to the size of g
    root = np.asarray(np.linalg.inv(triangle(np.vstack([factor, at_least]))), float)
    sigmas, first = [_sigmas(root, jacobian)], 0
    for number in range(count):
        after = _narrowed(root, rows)
        reached = _sigmas(after, jacobian)
        best = int(np.argmin(((reached / sizes) ** 2).sum(axis=1)))
        first = first if number else best
        root = after[best]
        sigmas.append(reached[best])
    angles = tuple(np.degrees(poses[first]).round(1).tolist())
    return Course(angles, np.array(sigmas), len(fitted.dwells), _each_s(fitted))


def _each_s(fitted: Fit) -> float:
    """How long a dwell and the way to it take."""
    ends_s = fitted.carried.means.ends_s
    lengths = np.diff(ends_s[:, 0]) if len(ends_s) > 1 else np.ptp(ends_s, axis=1) + _WAY_S
    return float(np.median(lengths))


def _sigmas(roots: Floats, jacobian: Floats) -> Floats:
    """Sigmas (..., 12) of the paper's parameters from roots (..., p, p) of covariances."""
    return np.asarray(np.linalg.norm(jacobian @ roots[..., :STATE_COUNT, :], axis=-1))


def _narrowed(root: Floats, rows: Floats) -> Floats:
    """Roots S (m, p, p) of the covariance S S^T after each of m sets of whitened rows (m, r, p), from that before.

    S - S W^T M^-T (M + I)^-1 W, W the rows times S, M M^T = I + W W^T (Andrews, 1968).
    """
    seen = rows @ root
    turned, one = np.swapaxes(seen, 1, 2), np.eye(rows.shape[1])
    upper = triangle(np.concatenate([np.broadcast_to(one, (len(rows), *one.shape)), turned], axis=1))
    upper = upper * np.where(np.einsum("mrr->mr", upper) < 0.0, -1.0, 1.0)[:, :, None]
    gain = (root @ turned) @ np.linalg.inv(upper) @ np.linalg.inv(np.swapaxes(upper, 1, 2) + one)
    return root - gain @ seen


def _poses(fitted: Fit) -> Floats | None:
    """Gimbal angles (m, k) to choose from, rad: multiples of 45 deg and a spread of others, but not where the platform
    is, which would not be set anew; None without gimbals."""
    count = len(fitted.carried.model.bench.axes)
    if not count:
        return None
    rng = np.random.default_rng(0)
    coarse = rng.integers(-4, 4, (_POSES // 2, count)) * 45.0
    fine = np.round(rng.uniform(-180.0, 180.0, (_POSES // 2, count)) / _STEP_DEG) * _STEP_DEG
    poses = np.radians(np.concatenate([coarse, fine]))
    turn = np.abs(wrapped(poses - fitted.dwells[-1].pose)).max(axis=1)
    return poses[turn > np.radians(SAME_POSE_DEG)]


def _with_next(
    fitted: Fit,
    effects: Sequence[Effect],
    poses: Floats,
    noise: Noise | None = None,
    waits_s: Sequence[float] | Floats = (0.0,),
) -> tuple[Floats, Floats]:
    """Triangle of the run so far over [H | G], and whitened rows (w, m, 3, p + q) of a dwell's mean after each wait at
    each pose."""
    carried, noise = fitted.carried, noise or fitted.noise.judging
    model, state = carried.model, carried.state
    added = candidate_columns(carried.dwells, effects, model.bench, state)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(carried.columns, added, strict=True)]
    upper = accumulate(whiten(carried.dwells, columns, noise, state), steps(carried.dwells, noise))
    prospect = replace(Prospect.following(fitted), noise=noise)
    return upper[:-1, :-1], np.array([prospect.columns(effects, poses, float(wait_s)) for wait_s in waits_s])
