"""Cross-validation by leaving out one orientation: its mean readings are predicted from all other dwells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import IN_MEMORY, ROUNDING, Floats, portions
from kf_calib.dwells.pieces import of_all_pieces
from kf_calib.dwells.qr import inverse_of_lower, triangle
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation import square_root_information
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.free_attitude import weights_of_size
from kf_calib.estimation.settings import Prior
from kf_calib.noise import random_walk
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import considered_information, lift_rounding, mean_covariances

SAME_POSE_DEG = 1.0
"""Dwells whose directions of gravity and poses differ by less than this are visits of one orientation."""

_DWELLS = IN_MEMORY // 1024
"""Dwells at a time: a root of the covariance of one has up to so many numbers."""


def orientations(dwells: DwellTable) -> list[list[int]]:
    """Indices of the dwells grouped by orientation, that is by direction of gravity in the platform and by pose.

    Angles that differ by whole turns are the same pose: their sines and cosines are compared.
    """
    direction = dwells.means[:, 1:4] / np.linalg.norm(dwells.means[:, 1:4], axis=1, keepdims=True)
    places = np.column_stack([direction, np.cos(dwells.poses), np.sin(dwells.poses)])
    return _grouped(places.tobytes(), len(places))


@lru_cache(maxsize=8)  # the same for every model of a run
def _grouped(places: bytes, count: int) -> list[list[int]]:
    """Compute the groups of ``orientations`` from the bytes of its places (D, k), which can be cached."""
    return grouped(np.frombuffer(places).reshape(count, -1), math.radians(SAME_POSE_DEG))


def grouped(places: Floats, apart: float) -> list[list[int]]:
    """Indices of places (D, k) in groups: each joins the first group whose first place is nearer than ``apart`` in
    every coordinate.

    Groups are looked up by the cell of their first place in the four coordinates that differ most. A cell is twice as
    wide as ``apart``, and more by rounding, so that what is near lies in the cell itself or in the neighbours on the
    nearer side. One of the other coordinates is compared first: it tells most of what is in one cell apart.
    """
    groups, at = list[list[int]](), dict[int, list[int]]()
    order = np.argsort(-np.ptp(places, axis=0))
    widest, other = places[:, order[:4]], places[:, order[:5][-1]].tolist()
    scaled = (widest - widest.min(axis=0)) / (2.0 * apart * (1.0 + ROUNDING)) + 1.0
    cells = np.floor(scaled).astype(int)
    strides = np.append(1, np.cumprod(cells.max(axis=0)[:-1] + 2))
    sides, choices = (
        np.where(scaled - cells < 0.5, -strides, strides),
        np.array([*itertools.product((0, 1), repeat=widest.shape[1])]),
    )
    for part in portions(len(places), _DWELLS):
        around = (cells[part] @ strides)[:, None] + sides[part] @ choices.T
        for k, near in enumerate(around.tolist(), part.start):
            nearby = [number for cell in near if cell in at for number in at[cell]]
            close = [number for number in nearby if abs(other[groups[number][0]] - other[k]) < apart]
            joined = [number for number in close if (np.abs(places[groups[number][0]] - places[k]) < apart).all()]
            if joined:
                groups[min(joined)].append(k)
            else:
                at.setdefault(near[0], []).append(len(groups))
                groups.append([k])
    return groups


@dataclass(frozen=True)
class HeldOut:
    """Mean readings of the dwells less their prediction from all other orientations (D, 3), and the covariance (D, 3,
    3); (D, 1) and (D, 1, 1) of the size of f where no angles are used."""

    errors_mps2: Floats
    covariance: Floats

    @property
    def rms_mps2(self) -> float:
        """Held-out error: the rms over all dwells and channels."""
        return float(np.sqrt(np.mean(self.errors_mps2**2)))

    @property
    def floor_mps2(self) -> float:
        """Noise floor: the rms that noise alone would give."""
        return float(np.sqrt(np.mean(np.einsum("dii->di", self.covariance))))

    @property
    def statistics(self) -> Floats:
        """Chi-squared (D,) of each dwell's error, with 3 degrees of freedom."""
        solved = np.linalg.solve(lift_rounding(self.covariance), self.errors_mps2[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("di,di->d", self.errors_mps2, solved))


def held_out(fitted: Fit) -> HeldOut | None:
    """The held-out errors of all dwells; None if the fit without some orientation would be undetermined, or predict
    readings to no better than gravity.

    Slews are not left out of any fit. Without angles the errors are those of |f|, one a dwell.
    """
    predicted = (_beside if fitted.noise.walk.steps else _without)(fitted, orientations(fitted.dwells))
    if predicted is None:
        return None
    means, state = fitted.linearised.means, fitted.linearised.state
    told = told_of(*predicted, means, state, fitted.noise.attitude_unknown)
    return told if told.floor_mps2 < fitted.linearised.model.bench.gravity_mps2 else None


def told_of(errors_mps2: Floats, covariance: Floats, means: Means, state: Floats, free: bool) -> HeldOut:
    """The errors (D, 3) of dwells that were held out, and their covariance; where attitudes are ``free``, those of the
    size of f."""
    if not free:
        return HeldOut(errors_mps2, covariance)
    across = weights_of_size(means, state)
    sizes = across[:, None] @ errors_mps2[:, :, None]
    return HeldOut(sizes[:, :, 0], across[:, None] @ covariance @ across[:, :, None])


def _without(fitted: Fit, groups: list[list[int]]) -> tuple[Floats, Floats] | None:
    """Return the errors (D, 3) and their covariance (D, 3, 3) if the biases are constant.

    The considered information of the dwells that are left out is left out, too.
    """
    linearised, noise = fitted.linearised, fitted.noise.for_goodness_of_fit.of_readings
    means, place = linearised.means, np.empty(len(fitted.dwells), np.intp)
    for k, group in enumerate(groups):
        place[group] = k
    estimates = _by_leverage(fitted, place) or _merged(fitted, groups)
    if estimates is None:
        return None
    states, roots = estimates
    design, extra = means.design, considered_information(noise, means, linearised.state)
    spreads = mean_covariances(noise, means, linearised.state)
    for part in portions(len(place), _DWELLS):
        ours = design[part] @ roots.of(place[part])
        spreads[part] += ours @ np.swapaxes(ours, 1, 2)
    if extra.any():
        covariances = roots.of(np.arange(len(groups)))
        covariances = covariances @ np.swapaxes(covariances, 1, 2)
        left_out = np.zeros_like(covariances)
        np.add.at(left_out, place, extra)
        gained = (covariances @ (extra.sum(axis=0) - left_out) @ covariances)[place]
        spreads += design @ gained @ np.swapaxes(design, 1, 2)
    return means.readings - (design @ states[place, :, None])[:, :, 0], spreads


@dataclass(frozen=True)
class _OfGroups:
    """Rows (N, c) of G groups, one group after the other, and the number of rows of each, (G,)."""

    rows: Floats
    sizes: NDArray[np.intp]

    @cached_property
    def firsts(self) -> NDArray[np.intp]:
        """The first row of each group."""
        return np.cumsum(self.sizes) - self.sizes

    def alike(self) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Groups (g,) of one size at a time, not too many, and the places (g, m) of their rows."""
        for size in np.unique(self.sizes).tolist():
            groups = np.flatnonzero(self.sizes == size)
            for chosen in (groups[part] for part in portions(len(groups), _DWELLS)):
                yield chosen, self.firsts[chosen, None] + np.arange(size)

    def of(self, groups: NDArray[np.intp]) -> Floats:
        """The rows (g, m, c) of some groups; those of fewer rows are padded with zeros."""
        places = np.arange(int(self.sizes[groups].max()))
        inside = places < self.sizes[groups, None]
        return np.where(inside[:, :, None], self.rows[np.where(inside, self.firsts[groups, None] + places, 0)], 0.0)


@dataclass(frozen=True)
class _Roots:
    """Roots of the covariances of the estimates without each of G orientations: ``common`` (p, p) beside ``common``
    times the transposed rows of ``more``; or, where more is None, ``common`` (G, p, p) itself."""

    common: Floats
    more: _OfGroups | None

    def of(self, groups: NDArray[np.intp]) -> Floats:
        """The roots (n, p, p + m) without some of the orientations."""
        if self.more is None:
            return self.common[groups]
        common = np.broadcast_to(self.common, (len(groups), *self.common.shape))
        return np.concatenate([common, self.common @ np.swapaxes(self.more.of(groups), 1, 2)], axis=2)


def _by_leverage(fitted: Fit, place: NDArray[np.intp]) -> tuple[Floats, _Roots] | None:
    """Return the states (G, p) without each orientation, and the roots of their covariances; None where an orientation
    tells nearly all of a state.

    The rows A = Q R of all orientations give the state x and residuals r. Without the rows Q_g of one of them

      x_g = x - R^-1 Q_g^T (I - Q_g Q_g^T)^-1 r_g,   P_g = R^-1 (I + Q_g^T (I - Q_g Q_g^T)^-1 Q_g) R^-T.
    """
    factor, of_groups = _of_all(fitted, place)
    width = len(factor)
    if square_root_information.rank(factor) < width:
        return None
    inverse = cast("Floats", np.linalg.inv(factor[:, :-1]))
    state = inverse @ factor[:, -1]
    states, more = np.empty((len(of_groups.sizes), width)), of_groups.rows[:, :-1]  # rows that are done with give way
    for groups, places in of_groups.alike():
        ours = of_groups.rows[places]
        shares = ours[..., :-1] @ inverse
        left = np.eye(places.shape[1]) - shares @ np.swapaxes(shares, 1, 2)
        if places.size and np.linalg.eigvalsh(left)[:, 0].min() < math.sqrt(ROUNDING):  # digits are lost
            return None
        residuals = ours[..., -1:] - ours[..., :-1] @ state[:, None]
        lower = cast("Floats", np.linalg.cholesky(left))
        solved = inverse_of_lower(lower) @ np.concatenate([shares, residuals], axis=2)
        more[places] = solved[..., :-1]
        states[groups] = state - (np.swapaxes(solved[..., :-1], 1, 2) @ solved[..., -1:])[:, :, 0] @ inverse.T
    return states, _Roots(inverse, replace(of_groups, rows=more))


def _of_all(fitted: Fit, place: NDArray[np.intp]) -> tuple[Floats, _OfGroups]:
    """Return the factor [R | z] (p, p + 1) of all rows, and the rows of each orientation."""
    rows, frame = _rows(fitted), _frame(fitted)
    factor = square_root_information.accumulate([np.concatenate([frame, *fitted.following, of_all_pieces(rows)])])
    return factor[: len(frame)], _of_groups(rows, place)


def _rows(fitted: Fit) -> Sequence[Floats]:
    return fitted.rows(fitted.noise.for_goodness_of_fit.weights)


def _of_groups(rows: Sequence[Floats], place: NDArray[np.intp]) -> _OfGroups:
    """Return the rows [A | z] of each group of dwells, no more than A has columns: an orthogonal transformation changes
    nothing."""
    counts = np.fromiter(map(len, rows), np.intp, len(rows))
    sizes = np.bincount(place, weights=counts).astype(int)
    in_order = of_all_pieces(rows)
    if np.any(np.diff(place) < 0):
        in_order = in_order[np.argsort(np.repeat(place, counts), kind="stable")]
    stacked, most = _OfGroups(in_order, sizes), rows[0].shape[1] - 1
    if int(sizes.max()) <= most:
        return stacked
    reduced = _OfGroups(np.empty((int(np.minimum(sizes, most).sum()), most + 1)), np.minimum(sizes, most))
    for groups, places in stacked.alike():
        ours = stacked.rows[places]
        places = reduced.firsts[groups, None] + np.arange(min(places.shape[1], most))
        reduced.rows[places] = triangle(ours)[:, :most] if ours.shape[1] > most else ours
    return reduced


def _merged(fitted: Fit, groups: list[list[int]]) -> tuple[Floats, _Roots] | None:
    """Return the states (G, p) without each orientation, and the roots of their covariances, by merging the factors of
    the orientations before it and after it; None if one is then undetermined."""
    linearised, around = fitted.linearised, fitted.linearised.model.nominal_state()
    rows, empty = _rows(fitted), _frame(fitted)
    slews = square_root_information.update(empty, np.concatenate(fitted.following))[0] if linearised.slews else empty
    heads, tails = [slews], [empty]
    for group in groups[:-1]:
        heads.append(square_root_information.update(heads[-1], np.concatenate([rows[k] for k in group]))[0])
    for group in groups[:0:-1]:
        tails.append(square_root_information.update(tails[-1], np.concatenate([rows[k] for k in group]))[0])
    merged = triangle(np.concatenate([heads, tails[::-1]], axis=1))[:, : len(empty)]
    states, _, lost = zip(*square_root_information.solve_all(merged, around), strict=True)
    if any(each.size for each in lost):
        return None
    return np.array(states), _Roots(cast("Floats", np.linalg.inv(merged[..., :-1])), None)


def _beside(fitted: Fit, groups: list[list[int]]) -> tuple[Floats, Floats] | None:
    """Return the errors and their covariance if the biases follow a random walk.

    The biases during a dwell are then estimated from the dwells before and after it by a two-filter smoother, with one
    filter forward and one backward in time (Fraser and Potter, 1969).
    """
    linearised, noise, steps = fitted.linearised, fitted.noise.for_goodness_of_fit, fitted.steps
    rows, means, around = fitted.all_rows(noise.weights), linearised.means, linearised.model.nominal_state()
    errors, spreads = np.zeros((len(rows), 3)), mean_covariances(noise.of_readings, means, linearised.state)
    spreads += (steps[:, 1] / 12.0)[:, None] * np.eye(3)  # variance of a path's mean about the mean of its ends
    first = _frame(fitted)
    alone, ways = _passes(first, rows, steps, ()), dict[int, list[tuple[int, Floats]]]()
    for group in groups:
        heads, tails = alone if len(group) == 1 else _passes(first, rows, steps, group)
        for k in group:
            upper, count = random_walk.advance(heads[k], steps[k], np.hstack([np.zeros((len(around), 3)), tails[k]]))
            order = [*range(count, upper.shape[1] - 1), *range(count), upper.shape[1] - 1]
            ways.setdefault(count, []).append((k, upper[: len(around) + count, order]))
    for count, augmented in ways.items():
        half = np.hstack([-0.5 * np.eye(3), np.zeros((3, count - 3))])  # the mean lies half a step before the end
        estimates = square_root_information.solve_all(
            np.array([upper for _, upper in augmented]), np.append(around, np.zeros(count))
        )
        for (k, _), (state, covariance, lost) in zip(augmented, estimates, strict=True):
            if lost.size:
                return None
            design = np.hstack([means.design[k], half])
            errors[k] = means.readings[k] - design @ state
            spreads[k] += design @ covariance @ design.T
    return errors, spreads


def _frame(fitted: Fit) -> Floats:
    """Return the factor that knows nothing but the states that are fixed at zero, whichever orientation is left out."""
    model, noise = fitted.linearised.model, fitted.noise
    factor = square_root_information.start(Prior(), model)
    for place in model.fixed:
        factor[place, place] = model.bench.gravity_mps2 / noise.effective_sigma_mps2.min()
    return factor


def _passes(
    first: Floats, rows: Sequence[Floats], steps: Floats, left_out: Sequence[int]
) -> tuple[list[Floats], list[Floats]]:
    """Return the factors before each dwell from ``first`` and the dwells before it, and those at its end from the
    dwells after it."""
    known = [of_dwell[:0] if k in left_out else of_dwell for k, of_dwell in enumerate(rows)]
    width, heads, tails = len(first), [first], [np.zeros_like(first)]
    for of_dwell, variances in zip(known[:-1], steps, strict=False):
        upper, count = random_walk.advance(heads[-1], variances, of_dwell)
        heads.append(upper[count : count + width, count:])
    for of_dwell, variances in zip(known[:0:-1], steps[:0:-1], strict=True):
        tails.insert(0, random_walk.recede(tails[0], variances, of_dwell))
    return heads, tails
