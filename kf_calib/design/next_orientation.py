"""The choice of the next orientation: to tell effects apart, to make effects visible, or to reduce the twelve
sigmas.

Which orientation next, and for how long: the largest gain per second, with the slew and the settling in the time.

What is still missing of the targets is measured by G = ln(mean over targets of max(sigma / target, 1)^2) / 2, which is
zero when all are reached. A stay gains the fall of G that it is expected to bring. Where the noise of a mean falls with
the length of a stay and its scatter does not, the best stay is about sqrt(white / scatter x time to get there).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask, first_least
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design.gimbal_limits import GimbalLimits, can_be_reached, wrap
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.dwells.qr import inverse_of_lower, triangle
from kf_calib.effects import Effect
from kf_calib.estimation.candidate_scan import counts_of, slices
from kf_calib.estimation.cross_validation import SAME_POSE_DEG
from kf_calib.estimation.dwell_columns import candidate_columns
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.square_root_information import accumulate
from kf_calib.estimation.whitened_rows import whiten
from kf_calib.noise.noise_model import steps

ENOUGH = 6.0
"""Separation in sigma that suffices: of two equally likely effects the wrong one is then chosen once in a thousand
cases."""

_POSES = 640
_STEP_DEG = 5.0
_STEPS = 12
_WAY_S = 10.0  # assumed time to the next orientation after a single dwell
_TOLD = 0.1  # sigma; effects with a smaller separation after any next dwell cannot be told apart
_MOVE = 3.0  # dwells; the cost of one more visit
_DIGITS_KEPT = 1e-8  # share of a variance that is left, below which its fall does not tell what is left
_WAITS = (0.0, *np.geomspace(1.0 / 16.0, 1.0, 9))  # possible waits, as shares of the duration so far


@dataclass(frozen=True)
class Advice:
    """The next orientation.

    - gimbal_deg: its gimbal angles.
    - before, after: separation in sigma before and after a dwell there.
    - stay_s: how long to stay; None for a dwell of the usual length.
    - told: names of the effects that it tells apart.
    - shows: number of hidden effects that a dwell there makes visible, where this is what it is advised for; before
      and after are then no separations, but numbers of these.
    """

    gimbal_deg: tuple[float, ...]
    before: float
    after: float
    stay_s: float | None = None
    told: tuple[str, ...] = ()
    shows: int = 0


def to_tell_apart(fitted: Fit, one: Effect, coefficients: Floats, others: Sequence[Effect]) -> Advice | None:
    """The orientation after which the effect ``one`` with these coefficients differs most from each of the ``others``;
    None without gimbals.

    The separation is the size in sigma of the part of its signal that the model and the other effect cannot explain;
    the smallest over the others counts (over the model alone if there are no others). Effects that differ in their
    course in time only are told apart by waiting: a longer stay is advised if it increases the squared separation more
    per unit of time. One more visit is taken to cost three dwells, and separations above 6 sigma count as 6. Another
    effect that contains this one as a special case cannot be told apart anywhere and is left out.
    """
    poses = _poses(fitted)
    if poses is None:
        return None
    waits_s = np.array(_WAITS) * fitted.dwells[-1].end_s
    separations = {str(other): _separations(fitted, one, coefficients, [other], poses, waits_s) for other in others}
    separations = {name: own for name, own in separations.items() if own[1].max() > _TOLD}
    counted = list(separations.values()) or [_separations(fitted, one, coefficients, [], poses, waits_s)]
    before, after = min(own[0] for own in counted), np.min([own[1] for own in counted], axis=0)
    dwell_s = _each_s(fitted)
    farthest = after.max(axis=1)
    useful = np.minimum(farthest, ENOUGH) if before < ENOUGH else farthest[:1]
    wait = int(np.argmax((useful**2 - before**2) / (_MOVE * dwell_s + waits_s[: len(useful)])))
    best = first_least(-after[wait])
    stay_s = float(waits_s[wait] + dwell_s) if wait else None
    angles = tuple(np.degrees(poses[best]).round(1).tolist())
    return Advice(angles, before, float(after[wait, best]), stay_s, tuple(separations))


def _separations(
    fitted: Fit, one: Effect, coefficients: Floats, others: Sequence[Effect], poses: Floats, waits_s: Floats
) -> tuple[float, Floats]:
    """Return the separation of an effect from the model and others, in sigma: now, and after a dwell at each pose after
    each wait (w, m)."""
    factor, rows = _with_next(fitted, [*others, one], poses, waits_s=waits_s)
    count = factor.shape[1] - len(coefficients)
    mix = np.zeros((factor.shape[1], count + 1))
    mix[:count, :count], mix[count:, count] = np.eye(count), coefficients
    so_far = np.broadcast_to(factor @ mix, (*rows.shape[:2], len(factor), count + 1))
    after = np.abs(triangle(np.concatenate([so_far, rows @ mix], axis=2))[..., -1, -1])
    return abs(float(triangle(factor @ mix)[-1, -1])), after


def to_show(fitted: Fit, hidden: Sequence[Effect]) -> Advice | None:
    """The orientation that makes most of the ``hidden`` effects visible, each of the scale of its kind; None without
    gimbals."""
    poses = _poses(fitted)
    if poses is None or not hidden:
        return None
    factor, (rows,) = _with_next(fitted, hidden, poses)
    width, shown = fitted.linearised.model.count, np.zeros(len(poses))
    scales = np.array([coefficient.scale for effect in hidden for coefficient in effect.coefficients])
    added = _below(factor[:width], rows)[:, width:, width:]  # what the model leaves of each dwell
    for own in slices(counts_of(hidden)):
        so_far = triangle(factor[width:, width:][:, own])
        shown += (np.abs(_below(so_far, added[:, :, own])) * scales[own]).max(axis=(1, 2)) > 5.0
    best = int(np.argmax(shown))
    count = int(shown[best])
    return Advice(tuple(np.degrees(poses[best]).round(1).tolist()), 0.0, float(count), shows=count)


def _below(factor: Floats, rows: Floats) -> Floats:
    """Return the triangular factors (m, ...) of a factor (r, c) with each of m sets of rows (m, k, c) below it."""
    return triangle(np.concatenate([np.broadcast_to(factor, (len(rows), *factor.shape)), rows], axis=1))


@dataclass(frozen=True)
class SigmaForecast:
    """The predicted decrease of the twelve sigmas over a sequence of orientations, each of which reduces them most.

    - gimbal_deg: the first orientation.
    - sigma (N + 1, 12): the sigmas now and after each dwell.
    - dwells: number of dwells so far; each_s: duration of a dwell and the slew to it.
    """

    gimbal_deg: tuple[float, ...]
    sigma: Floats
    dwells: int
    each_s: float

    def next_reduction(self, sizes: Floats) -> tuple[str, float]:
        """The parameter whose sigma is largest relative to ``sizes`` (12,), and the factor by which the next dwell
        reduces it."""
        worst = int(np.argmax(self.sigma[0] / sizes))
        return paper_parameters.SYMBOLS[worst], float(self.sigma[1, worst] / self.sigma[0, worst])

    def seconds_to(self, wanted: Floats, sigma: Floats) -> Floats:
        """Seconds (12,) until each sigma is as small as ``wanted`` (12,); beyond the forecast, sigmas fall with the
        root of the dwells.

        ``sigma`` (12,) are the present sigmas; NaN counts as larger than any target.
        """
        last, steps = self.sigma[-1], len(self.sigma) - 1
        reached = self.sigma <= wanted
        beyond = (self.dwells + steps) * (last / wanted) ** 2 - self.dwells
        needed = np.where(reached.any(axis=0), reached.argmax(axis=0), np.ceil(beyond))
        return np.where(sigma <= wanted, 0.0, np.maximum(needed, 1.0) * self.each_s)


def forecast(fitted: Fit, sizes: Floats) -> SigmaForecast | None:
    """The sequence of orientations that reduce the twelve sigmas most, each chosen after those before it; None without
    gimbals.

    Each minimises the sum of (sigma / size)^2, which the worst parameter dominates. ``sizes`` (12,) are targets or
    scales of comparison, infinite for parameters that do not matter.
    """
    poses = _poses(fitted)
    if poses is None:
        return None
    factor, rows = factor_of(fitted), PredictedInformation.following(fitted).columns([], poses)
    jacobian = paper_parameters.jacobian(fitted.linearised.state[:STATE_COUNT])
    at_least = np.diag(1.0 / np.maximum(fitted.linearised.sizes, 1.0))  # keeps all sigmas finite, at the size of g
    root = np.asarray(np.linalg.inv(triangle(np.vstack([factor, at_least]))), float)
    sigmas, first = [sigmas_of(root, jacobian)], 0
    for number in range(_STEPS):
        best = int(np.argmin(((sigmas_after(root, rows, jacobian) / sizes) ** 2).sum(axis=1)))
        first = first if number else best
        root = root_after(root, rows[best : best + 1])[0]
        sigmas.append(sigmas_of(root, jacobian))
    angles = tuple(np.degrees(poses[first]).round(1).tolist())
    return SigmaForecast(angles, np.array(sigmas), len(fitted.dwells), _each_s(fitted))


def _each_s(fitted: Fit) -> float:
    """Return the usual duration of a dwell and the slew to it, s."""
    ends_s = fitted.linearised.means.ends_s
    lengths = np.diff(ends_s[:, 0]) if len(ends_s) > 1 else np.ptp(ends_s, axis=1) + _WAY_S
    return float(np.median(lengths))


def sigmas_of(roots: Floats, jacobian: Floats) -> Floats:
    """Sigmas (..., 12) of the paper's parameters from roots (..., p, p) of covariances."""
    return np.asarray(np.linalg.norm(jacobian @ roots[..., :STATE_COUNT, :], axis=-1))


def sigmas_after(root: Floats, rows: Floats, jacobian: Floats) -> Floats:
    """Sigmas (m, 12) of the paper's parameters after each of m sets of whitened rows (m, r, p), from the root before.

    A variance a a^T falls by |M^-1 W a^T|^2, with W and M as below; where that leaves little of it, by the roots.
    """
    seen, along = rows @ root, jacobian @ root[:STATE_COUNT]
    before = np.square(along).sum(axis=1)
    fallen = inverse_of_lower(np.swapaxes(_rooted(seen), 1, 2)) @ (seen @ along.T)
    variances = before - np.square(fallen).sum(axis=1)
    if (variances < _DIGITS_KEPT * before).any():
        return sigmas_of(root_after(root, rows), jacobian)
    return np.sqrt(variances)


def _rooted(seen: Floats) -> Floats:
    """Return the upper triangles M^T (m, r, r) of M M^T = I + W W^T, for W = ``seen`` (m, r, p)."""
    upper = _below(np.eye(seen.shape[1]), np.swapaxes(seen, 1, 2))
    return upper * np.where(np.einsum("mrr->mr", upper) < 0.0, -1.0, 1.0)[:, :, None]


def root_after(root: Floats, rows: Floats) -> Floats:
    """Roots S (m, p, p) of the covariance S S^T after each of m sets of whitened rows (m, r, p), from the root
    before.

    The new root is S - S W^T M^-T (M + I)^-1 W, where W are the rows times S and M M^T = I + W W^T (Andrews, 1968).
    """
    seen = rows @ root
    turned, one, upper = np.swapaxes(seen, 1, 2), np.eye(rows.shape[1]), _rooted(seen)
    gain = (root @ turned) @ np.linalg.inv(upper) @ np.linalg.inv(np.swapaxes(upper, 1, 2) + one)
    return root - gain @ seen


def _poses(fitted: Fit) -> Floats | None:
    """Return gimbal angles (m, k), rad, to choose from; None without gimbals, or where the limits leave none."""
    bench = fitted.linearised.model.bench
    if not bench.axes:
        return None
    poses = poses_within(GimbalLimits.of(bench))
    poses = poses[is_elsewhere(poses, fitted.dwells[-1].pose)]
    return poses if len(poses) else None


def poses_within(limits: GimbalLimits) -> Floats:
    """Gimbal angles (m, k), rad, that a bench can take: multiples of 45 deg, and random multiples of 5 deg."""
    count, (low, high) = len(limits.bench.axes), np.degrees(limits.bounds).T
    rng = np.random.default_rng(0)
    coarse = rng.integers(-4, 4, (_POSES // 2, count)) * 45.0
    fine = np.round(rng.uniform(low, high, (_POSES // 2, count)) / _STEP_DEG) * _STEP_DEG
    poses = np.radians(np.concatenate([coarse, fine]))
    return poses if limits.free else poses[limits.allowed(poses)]


def is_elsewhere(poses: Floats, pose: Floats) -> Mask:
    """Mask of the poses (m, k) that differ from ``pose`` (k,): one that is the same would not be set anew."""
    return np.abs(wrap(poses - pose)).max(axis=1) > np.radians(SAME_POSE_DEG)


def _with_next(
    fitted: Fit, effects: Sequence[Effect], poses: Floats, waits_s: Sequence[float] | Floats = (0.0,)
) -> tuple[Floats, Floats]:
    """Return the triangular factor of [H | G] of the run so far, and the whitened rows (w, m, 3, p + q) of a dwell's
    mean after each wait at each pose, in the noise by which the misfit is judged."""
    linearised, noise = fitted.linearised, fitted.noise.for_goodness_of_fit
    added = candidate_columns(linearised.dwells_at_state, effects, linearised.model.bench, linearised.state)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(linearised.columns, added, strict=True)]
    so_far = whiten(linearised.dwells_at_state, columns, noise, linearised.state)
    information = replace(PredictedInformation.following(fitted), noise=noise)
    rows = np.array([information.columns(effects, poses, float(wait_s)) for wait_s in waits_s])
    return accumulate(so_far, steps(linearised.dwells, noise))[:-1, :-1], rows


def factor_of(fitted: Fit) -> Floats:
    """The triangular factor (p, p) of the whitened columns of the run so far, without a prior."""
    return accumulate(fitted.all_rows(), fitted.steps)[:-1, :-1]


STAYS_S = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0)
"""Lengths of a stay that are compared, s, of readings that count."""


@dataclass(frozen=True)
class SlewTimes:
    """How fast a bench is.

    rate_degps, acceleration_degps2: of its gimbals. overhead_s: what a stay takes beside the readings that count, s:
    until the platform stands, has settled, and is told to go on.
    """

    rate_degps: float = 20.0
    acceleration_degps2: float = 40.0
    overhead_s: float = 2.5

    def slews_s(self, start: Floats, end: Floats) -> Floats:
        """Durations of slews between poses (..., k), rad, in s: that of the gimbal with the longest way."""
        way = np.degrees(np.abs(start - end)).max(axis=-1)
        rising = self.rate_degps / self.acceleration_degps2
        short = way < self.rate_degps * rising
        return np.where(short, 2.0 * np.sqrt(way / self.acceleration_degps2), way / self.rate_degps + rising)


@dataclass(frozen=True)
class Stay:
    """A stay in an orientation (k,), rad, for ``stay_s`` of readings that count; ``seconds`` is all the time that it
    takes. sigma (12,): what is expected after it."""

    pose: Floats
    stay_s: float
    seconds: float
    sigma: Floats


@dataclass(frozen=True)
class Outlook:
    """What further stays will bring.

    fitted: the run so far. wanted (12,): targets of the sigmas, infinite where there is none. pending: poses (k,) and
    seconds of readings that are not in ``fitted``; the last of them is where the platform stands. limits, slew_times:
    of the bench.
    """

    fitted: Fit
    wanted: Floats
    pending: Sequence[tuple[Floats, float]]
    limits: GimbalLimits
    slew_times: SlewTimes

    @cached_property
    def _information(self) -> PredictedInformation:
        return replace(PredictedInformation.following(self.fitted), noise=self.fitted.noise)

    @cached_property
    def rate_hz(self) -> float:
        """Readings a second."""
        seconds = sum(dwell.end_s - dwell.start_s for dwell in self.fitted.dwells)
        return sum(dwell.count for dwell in self.fitted.dwells) / max(seconds, 1e-9)

    def _rows(self, poses: Floats, seconds: float) -> Floats:
        """Return the whitened rows (m, 3, p) of a stay at each pose (m, k)."""
        readings = max(self.rate_hz * seconds, 1.0)
        return replace(self._information, readings=readings).columns([], poses)

    @cached_property
    def _root(self) -> Floats:
        """Return a root of the covariance with the pending stays included; of the size of g where nothing is known."""
        factor, linearised = factor_of(self.fitted), self.fitted.linearised
        rows = [self._rows(pose[None], seconds)[0] for pose, seconds in self.pending if seconds > 0.0]
        at_least = np.diag(1.0 / np.maximum(linearised.sizes, 1.0))
        return np.asarray(np.linalg.inv(triangle(np.vstack([factor, at_least, *rows]))), float)

    @cached_property
    def _jacobian(self) -> Floats:
        return paper_parameters.jacobian(self.fitted.linearised.state[:STATE_COUNT])

    @cached_property
    def sigma(self) -> Floats:
        """Sigmas (12,) with the pending stays included."""
        return sigmas_of(self._root, self._jacobian)

    def missing(self, sigma: Floats) -> Floats:
        """G (...) of sigmas (..., 12); zero where all targets are reached."""
        ratios = sigma[..., np.isfinite(self.wanted)] / self.wanted[np.isfinite(self.wanted)]
        return np.asarray(0.5 * np.log(np.mean(np.maximum(ratios, 1.0) ** 2, axis=-1)))

    def best(self, stays_s: Sequence[float] = STAYS_S) -> Stay | None:
        """The stay with the largest gain per second; None where no other orientation can be reached."""
        here = self.pending[-1][0]
        poses = poses_within(self.limits)
        poses = poses[is_elsewhere(poses, here)]
        poses = poses[can_be_reached(self.limits, here, poses)]
        if not len(poses):
            return None
        going_s, before = self.slew_times.slews_s(here, poses) + self.slew_times.overhead_s, self.missing(self.sigma)
        stays = list[tuple[float, Stay]]()
        for stay_s in stays_s:
            sigma = sigmas_after(self._root, self._rows(poses, stay_s), self._jacobian)
            rates = (before - self.missing(sigma)) / (going_s + stay_s)
            k = int(np.argmax(rates))
            stays.append((float(rates[k]), Stay(poses[k], stay_s, float(going_s[k] + stay_s), sigma[k])))
        return max(stays, key=lambda stay: stay[0])[1]

    def share_s(self, poses: Floats) -> float:
        """How long to stay in each of the poses (n, k) that are to be visited anyway, s.

        The length with which the targets are expected soonest: if they are missed after the last pose, the time is
        taken to grow with the variance.
        """
        way = np.vstack([self.pending[-1][0], poses])
        going_s = float(self.slew_times.slews_s(way[:-1], way[1:]).sum()) + len(poses) * self.slew_times.overhead_s
        expected_s = list[float]()
        for stay_s in STAYS_S:
            rows = self._rows(poses, stay_s).reshape(-1, len(self._root))
            sigma = sigmas_of(root_after(self._root, rows[None])[0], self._jacobian)
            worst = float(np.max(sigma / self.wanted))
            expected_s.append((going_s + len(poses) * stay_s) * max(worst, 1.0) ** 2)
        return STAYS_S[int(np.argmin(expected_s))]
