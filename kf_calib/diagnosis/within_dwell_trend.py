"""Trends within dwells: whether what is left of the readings goes on in a dwell as noise does.

An effect that no column describes need not show in the means of dwells more than scatter would; but what jumps or turns
in the course of a dwell leaves it with a slope and a bend. Of each dwell and channel the residual is taken along smooth
shapes over it, Legendre's polynomials of degree 1 to 3 times 1 - u^2, less their mean: what shakes the platform as it
arrives and leaves is no trend. Of noise of density kappa sigma^2 each has that variance; a random walk of the biases
adds q^2 T times a constant, and 1/f noise of density h / f adds h times one, whatever the length T of the dwell
(covariances min(s, t) and -ln |s - t|).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import DwellFactor, alike
from kf_calib.estimation.dwell_columns import Carried
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.noise_model import Noise, flicker_sigma

_DEGREE = 3
_GRID = 600
_FEWEST = 8  # readings of a dwell


def shapes(u: Floats) -> Floats:
    """A constant, and the shapes at places u from -1 to 1 in a dwell, (..., 1 + degrees), not yet orthogonal."""
    values: Floats = np.polynomial.legendre.legvander(u, _DEGREE).astype(float)
    values[..., 1:] *= (1.0 - u**2)[..., None]
    return values


def variances(values: Floats) -> tuple[Floats, Floats]:
    """What a walk of q^2 T = 1 and 1/f noise of h = 1 add to the coefficients on functions (n, k) over a dwell, made
    orthogonal to those before them and of mean square 1; (k - 1,) each, the first function being constant."""
    count = len(values)
    frame = np.linalg.qr(values)[0][:, 1:] * np.sqrt(count)
    at = (np.arange(count) + 0.5) / count
    apart = np.abs(at[:, None] - at)
    np.fill_diagonal(apart, np.exp(-1.5) / count)  # the mean of -ln |s - t| over a cell
    walk = np.mean((np.cumsum(frame, axis=0) / count) ** 2, axis=0)
    return walk, np.einsum("sk,st,tk->k", frame, -np.log(apart), frame) / count**2


@cache
def _of_shapes() -> tuple[Floats, Floats]:
    return variances(shapes((2.0 * np.arange(_GRID) + 1.0) / _GRID - 1.0))


@dataclass(frozen=True)
class Trend:
    """Mean square of all trends over what noise makes of them, its p-value, and the sums of dwells and channels (D, 3)
    in that measure."""

    ratio: float
    p_value: float
    sums: Floats

    @property
    def most(self) -> tuple[int, int]:
        """The dwell and the channel, counted from 1, that show most."""
        dwell, channel = np.unravel_index(int(self.sums.argmax()), self.sums.shape)
        return int(dwell) + 1, int(channel) + 1


def trend(fitted: Fit) -> Trend | None:
    """The test of all trends that a fit leaves; None where there is nothing to judge or to judge by."""
    return trend_beside(fitted.carried, fitted.noise.judging, fitted.state)


def trend_beside(carried: Carried, noise: Noise, state: Floats) -> Trend | None:
    """The same beside the columns that are carried, of the model at ``state`` (p,).

    F distributed: kappa of n readings is known to 4 kappa / n of its square, a walk's intensity to its own spread.
    """
    from scipy.special import fdtrc

    dwells = carried.dwells
    if dwells[0].averaged or not noise.scatter_stated:
        return None
    sigma, lengths_s = noise.effective_sigma_mps2, np.array([dwell.end_s - dwell.start_s for dwell in dwells])
    squares, seen = _squares(carried, state)
    own = (sigma**2 / np.array([[dwell.count] for dwell in dwells]))[:, :, None]
    by_walk, by_flicker = _of_shapes()
    walked = noise.walk_mps2_per_sqrt_s**2 * lengths_s[:, None, None] * by_walk
    allowed = own + walked + flicker_sigma(noise, len(dwells))[:, None] ** 2 * by_flicker
    ratios = np.where(seen[:, None, :], squares / allowed, 0.0)
    count = 3 * int(seen.sum())
    if not count:
        return None
    readings = sum(dwell.count for dwell in dwells)
    unsure = float(np.mean((4.0 * noise.inflation - 2.0) / readings)) / 3.0
    unsure += (2.0 * (noise.walk_spread or 0.0) * float(np.mean(walked / allowed))) ** 2
    ratio = float(ratios.sum() / count)
    return Trend(ratio, float(fdtrc(count, 2.0 / unsure, ratio)), ratios.sum(axis=2))


def _squares(carried: Carried, state: Floats) -> tuple[Floats, Mask]:
    """Squares of the residuals' coefficients (D, 3, degrees) on shapes of mean square 1, and which degrees (D, degrees)
    a dwell has readings for."""
    out, seen = np.zeros((len(carried.dwells), 3, _DEGREE)), np.zeros((len(carried.dwells), _DEGREE), bool)
    for places in alike(carried.dwells):
        dwells, columns = [carried.dwells[k] for k in places], np.array([carried.columns[k] for k in places])
        width, triangles = dwells[0].width, np.array([dwell.triangles for dwell in dwells])
        left = triangles[:, :, :width, width:] - triangles[:, :, :width, :width] @ on_basis(columns @ state)
        frame, known = _shapes_in(dwells, triangles)
        counts = np.array([dwell.count for dwell in dwells])[:, None, None]
        along = np.swapaxes(left.reshape(len(dwells), -1, 3), 1, 2) @ frame
        out[places, :, : frame.shape[2]] = along**2 / counts
        seen[places, : frame.shape[2]] = known
    return out, seen


def _shapes_in(dwells: Sequence[DwellFactor], triangles: Floats) -> tuple[Floats, Mask]:
    """Orthonormal columns (d, r, k) on the rows of the triangles of dwells of one shape, a column a degree from one up,
    and of which each dwell tells (d, k)."""
    ends = np.array([(dwell.start_s, dwell.end_s) for dwell in dwells])
    counts, lengths = np.array([dwell.count for dwell in dwells]), ends[:, 1] - ends[:, 0]
    at = np.array([dwell.nodes.elapsed_s for dwell in dwells]).reshape(*triangles.shape[:2], 3)
    from_start = (at - ends[:, 0, None, None]) / np.where(lengths > 0.0, lengths, 1.0)[:, None, None]
    rows = triangles[:, :, : dwells[0].width, :3] @ on_basis(shapes(2.0 * from_start - 1.0))
    frame, upper = np.linalg.qr(rows.reshape(len(dwells), -1, rows.shape[3]))
    known = np.abs(np.einsum("dkk->dk", upper[:, :, : upper.shape[1]])) > 1e-6 * np.sqrt(counts)[:, None]
    known &= ((counts >= _FEWEST) & (lengths > 0.0))[:, None]
    return frame[:, :, 1:], known[:, 1:]
