"""The course of the temperature over a run, a smooth curve through what a noisy thermometer read; what its error does.

A block of metal follows its surroundings slowly, so that a smooth curve through all readings of the run has much less
noise than the readings in one dwell. What is left of it is a smooth error of the curve, which is the same for all three
accelerometers.

The curve is a cubic spline with many knots whose fourth differences are held small (P. Eilers and B. Marx, 1996). How
small, and the noise of the thermometer, are those of the largest restricted likelihood. The error of the curve is that
of the posterior (G. Wahba, 1983). Where the thermometer is quiet, or where the temperature has steps that no smooth
curve follows, the temperatures are taken as they were read and count as exact.

The error of the curve, times the sensitivity of an accelerometer to the temperature, enters the readings: an error in
the variables, which counts as noise (W. Deming, 1943, the effective variance). The sensitivity is that of the model at
its estimate, as a function of the specific force f and of the temperature T: its values on the regressors 1, f, T and
T f. For an effect with a memory of the temperature, it is that to a temperature that is wrong for long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import LAST_DIGITS, Floats
from kf_calib.dwells.limits import CUBIC, FEWEST_COMPARED, FEWEST_READINGS, SIMPSON
from kf_calib.dwells.pieces import OfPieces
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable, FoldedDwells, computed_once
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C

_KNOTS, _MOST_KNOTS = 3, 200  # of a dwell, and of the run
_ORDER = CUBIC + 1  # of the differences that are held small: cubics are free, which is best for the run of a climate
_CARRIED_S = 1.5  # readings once a second are carried on to the next one, which adds to the noise of short pieces
_STEPS = 2.0  # the curve leaves at most this times the variance that parabolas within the dwells leave
_KEPT = 1e-4  # share of the variance of the errors that may be left out
_PENALTIES = np.geomspace(1e-12, 1e12, 241)

_MATTERS = 0.1  # share of the sigma of the mean of a dwell above which the error counts


@dataclass(frozen=True, eq=False)
class TemperatureCourse:
    """The temperature at the nodes of all pieces of some dwells and slews.

    - temperature_c (m,): NaN where it was not measured.
    - errors_c (m, k): by how much each of k independent errors of 1 sigma changes them.
    """

    temperature_c: Floats
    errors_c: Floats


@computed_once
def temperature_course(folded: FoldedDwells) -> TemperatureCourse:
    """The course of the temperature over dwells, and slews between them, in order of time."""
    read = folded.pieces.nodes.temperature_c
    exact = TemperatureCourse(read, np.zeros((len(read), 0)))
    if (~folded.moving).sum() < FEWEST_COMPARED or not np.isfinite(read).all():
        return exact
    if _only_scatters(folded, read):
        return TemperatureCourse(np.full(len(read), _means(folded, read).mean()), exact.errors_c)
    return _smooth(folded, read) or exact


def _only_scatters(folded: FoldedDwells, read: Floats) -> bool:
    """Tell whether temperatures at the nodes only scatter as a thermometer does in a steady room.

    They only scatter if the means of consecutive dwells differ as much as any two means do (von Neumann's ratio near 1)
    and by no more than temperatures within a dwell.
    """
    means, counts = _means(folded, read), 3 * folded.piece_numbers
    spread = np.add.reduceat((read - np.repeat(means, counts)) ** 2, np.cumsum(counts) - counts) / counts
    between, within = means.var(), float(spread.mean())
    alike = np.mean(np.diff(means) ** 2) > between  # about 2 var if consecutive means are independent
    return bool(alike and between < 2.0 * within)


def _means(folded: FoldedDwells, read: Floats) -> Floats:
    """Return the mean temperature (D,) of the nodes of each dwell."""
    return np.add.reduceat(read, 3 * folded.ends[:-1]) / (3 * folded.piece_numbers)


def _smooth(folded: FoldedDwells, read: Floats) -> TemperatureCourse | None:
    """Return the smooth course through temperatures at the nodes (m,); None where they are taken as they were read."""
    standing, ends, levels = ~folded.moving, folded.elapsed_s.reshape(-1, 3), read.reshape(-1, 3)[:, 1]
    lengths, owners = ends[:, 2] - ends[:, 0], np.repeat(np.cumsum(standing) - 1, folded.piece_numbers)
    used = (lengths > 0.0) & np.repeat(standing, folded.piece_numbers)
    ends, levels, lengths, owners = ends[used], levels[used], lengths[used], owners[used]
    if not len(levels) or np.ptp(levels) <= LAST_DIGITS * np.abs(levels).max():
        return None  # a thermometer that always reads the same
    weights = lengths**2 / (lengths + _CARRIED_S)  # over the variance of readings of 1 K per sqrt(Hz)
    within, freedom = _within_dwells(ends[:, 1], levels, weights, owners)
    if freedom < FEWEST_READINGS:
        return None
    knots = min(_KNOTS * int(standing.sum()), _MOST_KNOTS)
    begin, spacing = ends[0, 0], (ends[-1, 2] - ends[0, 0]) / (knots - 3)
    over_piece = np.einsum("j,njk->nk", SIMPSON, _bumps((ends - begin) / spacing, knots))
    spline = _Spline.through(over_piece, levels, weights)
    if spline.variance > _STEPS * within:
        return None
    there = _bumps(np.clip((folded.elapsed_s - begin) / spacing, 0.0, knots - 3), knots)
    return TemperatureCourse(levels.mean() + there @ spline.coefficients, _largest(there @ spline.errors))


def _within_dwells(middles: Floats, levels: Floats, weights: Floats, owners: NDArray[np.intp]) -> tuple[float, int]:
    """Return the weighted variance of levels about a parabola in each dwell, and its degrees of freedom."""
    squares, freedom = 0.0, 0
    for number in np.flatnonzero(np.bincount(owners) > 3):
        inside = owners == number
        u, root = middles[inside] - middles[inside].mean(), np.sqrt(weights[inside])
        basis = np.linalg.qr(np.vander(u / np.abs(u).max(), 3) * root[:, None])[0]
        left = root * (levels[inside] - levels[inside].mean())
        squares += float(np.sum((left - basis @ (basis.T @ left)) ** 2))
        freedom += int(inside.sum()) - 3
    return squares / max(freedom, 1), freedom


def _bumps(places: Floats, count: int) -> Floats:
    """Return cubic B-splines (..., count) at places in units of the distance of the knots; that of number k has its
    middle at k - 1."""
    x = np.abs(places[..., None] - np.arange(-1, count - 1))
    inner, outer = 2.0 / 3.0 - x**2 + 0.5 * x**3, np.maximum(2.0 - x, 0.0) ** 3 / 6.0
    return np.where(x < 1.0, inner, outer)


@dataclass(frozen=True)
class _Spline:
    """A penalised spline: its coefficients (c,) about the mean of the levels, their independent errors (c, c) of 1
    sigma, and the variance of a level of weight 1."""

    coefficients: Floats
    errors: Floats
    variance: float

    @classmethod
    def through(cls, basis: Floats, levels: Floats, weights: Floats) -> _Spline:
        """The spline of the largest restricted likelihood; basis (n, c).

        In the coordinates in which both the information A = B' W B and the penalty P are diagonal, a + l p, the
        likelihood costs little for each penalty l.
        """
        count, away = basis.shape[1], levels - levels.mean()
        information, along = basis.T @ (weights[:, None] * basis), basis.T @ (weights * away)
        penalty = np.diff(np.eye(count), _ORDER, axis=0)
        penalty = penalty.T @ penalty * (np.trace(information) / count)
        lower = np.linalg.cholesky(information + penalty)
        shares, turn = np.linalg.eigh(_between(lower, penalty))
        shares = np.clip(shares, 0.0, 1.0)  # of the penalty in their sum
        back = np.linalg.solve(lower.T, turn)
        squares, total = (back.T @ along) ** 2, float(weights @ away**2)
        sizes = (1.0 - shares) + _PENALTIES[:, None] * shares
        freedom = len(levels) - _ORDER
        variances = np.maximum(total - (squares / sizes).sum(axis=1), 1e-12 * total) / freedom
        costs = freedom * np.log(variances) + np.log(sizes).sum(axis=1) - (count - _ORDER) * np.log(_PENALTIES)
        best = int(np.argmin(costs))
        coefficients = back @ ((back.T @ along) / sizes[best])
        return cls(coefficients, back * np.sqrt(variances[best] / sizes[best]), float(variances[best]))


def _between(lower: Floats, matrix: Floats) -> Floats:
    """Return L^-1 M L^-T."""
    return np.asarray(np.linalg.solve(lower, np.linalg.solve(lower, matrix).T), float)


def _largest(errors: Floats) -> Floats:
    """Return the fewest independent errors (m, k) that make up nearly all of the variance of ``errors`` (m, c)."""
    values, vectors = np.linalg.eigh(errors.T @ errors)
    left_out = np.cumsum(np.maximum(values, 0.0)) < _KEPT * values.sum()
    return errors @ vectors[:, ~left_out]


def sensitivity_to_temperature(
    dwells: Sequence[Dwell], change_mps2_per_k: Callable[[], Floats], sigma_mps2: Floats
) -> Floats | None:
    """Change of the readings per K (3, 8) on the regressors 1, f, T, T f; None where the error of the temperature does
    not matter.

    change_mps2_per_k: gives the change per K (m, 3) at the nodes of all dwells by the model at its state. sigma_mps2
    (3,): noise of white readings.
    """
    folded = DwellTable.of(dwells).folded
    errors_c = temperature_course(folded).errors_c
    if not errors_c.shape[1]:
        return None
    change = change_mps2_per_k()
    if not change.any():
        return None
    counts = np.repeat(folded.counts, 3 * folded.piece_numbers)
    variance = change**2 * np.sum(errors_c**2, axis=1, keepdims=True) * counts[:, None]
    if variance.max() < (_MATTERS * sigma_mps2.min()) ** 2:
        return None
    return np.asarray(np.linalg.lstsq(_regressors(dwells), change, rcond=1e-9)[0].T, float)


def thermometer_errors(dwells: Sequence[Dwell], sensitivity_mps2_per_k: Floats) -> OfPieces:
    """Changes of the readings at the nodes of each dwell by each independent error of the temperature of 1 sigma,
    (pieces, nodes, 3, k)."""
    folded = DwellTable.of(dwells).folded
    errors_c = temperature_course(folded).errors_c
    change = (_regressors(dwells) @ sensitivity_mps2_per_k.T)[:, :, None] * errors_c[:, None, :]
    return folded.at_nodes(change)


def _regressors(dwells: Sequence[Dwell]) -> Floats:
    """Return 1, f, T and T f at the nodes of all dwells, (m, 8)."""
    table = DwellTable.of(dwells)
    regressors = np.hstack([np.ones((len(table.force_mps2), 1)), table.force_mps2])
    warmth = temperature_course(table.folded).temperature_c - REFERENCE_TEMPERATURE_C
    return np.hstack([regressors, warmth[:, None] * regressors])
