"""The square-root information filter that takes in one dwell at a time.

The whitened rows of a dwell (``whitened_rows``) update the running factor [R | z] by QR, where R'R is the information
and z = R x.
The estimate after each dwell, the batch solution and the leave-one-orientation-out predictions are all computed from
such factors (G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Prior
from kf_calib.noise import random_walk

_STILL = np.zeros((2, 3))


@dataclass(frozen=True)
class FilterStep:
    """The filter after one dwell and the slew that follows it.

    - factor (p, p + 1): the factor [R | z].
    - nis: the normalised innovation squared of the dwell.
    - dof: the degrees of freedom of ``nis``.
    """

    factor: Floats
    nis: float
    dof: int


def prior_covariance(prior: Prior, model: Model) -> Floats:
    """Covariance (p, p) of a stated prior about the nominal parameters; the sigma of each effect's coefficient is its
    ``scale``."""
    out = np.diag([0.0] * STATE_COUNT + [coefficient.scale**2 for coefficient in model.coefficients])
    out[:STATE_COUNT, :STATE_COUNT] = prior.covariance(paper_parameters.nominal(model.bench.nominal))
    return out


def start(prior: Prior, model: Model) -> Floats:
    """Factor [R | z] (p, p + 1) of the prior about the nominal parameters and no effects; zeros for a diffuse prior."""
    if prior.diffuse:
        return np.zeros((model.count, model.count + 1))
    root = np.linalg.inv(np.linalg.cholesky(prior_covariance(prior, model)))
    return triangle(np.column_stack([root, root @ model.nominal_state()]))[: model.count]


def update(factor: Floats, rows: Floats, walked: Floats = _STILL) -> tuple[Floats, float]:
    """Time and measurement update with whitened rows (m, s + p + 1): the new factor and the normalised innovation
    squared.

      without a walk: QR of [R | z] stacked on the rows gives [R+ | z+] stacked on [0 | e],  NIS = e' e

    ``walked`` (2, 3) are the variances of the biases' steps in the pause before the dwell and within the dwell.
    """
    width, (upper, count) = len(factor), random_walk.advance(factor, walked, rows)
    left = upper[count + width :, -1]
    return upper[count : count + width, count:], float(left @ left)


def restrict(factor: Floats, kept: Sequence[int]) -> Floats:
    """Factor [R | z] (k, k + 1) of the states with indices ``kept``, in that order, with all other states fixed at
    zero.

    A filter may carry effects that are not in its model. This conditions on their absence by one small QR; the full
    factor remains available for when they are added.
    """
    return triangle(factor[:, [*kept, -1]])[: len(kept)]


def row_rank(rows: Floats) -> int:
    """Number of rows [H | z] of a dwell that depend on the states."""
    return int(rows[:, :-1].any(axis=1).sum())


def row_ranks(rows: Sequence[Floats]) -> int:
    """Number of all rows that depend on the states; rows of a prior, which come first, lack the columns of steps that
    those of the dwells have where the biases walk."""
    if isinstance(rows, OfPieces):
        return row_rank(rows.values)
    return sum(row_rank(np.concatenate(list(alike))) for _, alike in itertools.groupby(rows, lambda own: own.shape[1]))


def run(
    first: Floats, rows: Iterable[Floats], walked: Iterable[Floats], following: Iterable[Floats]
) -> list[FilterStep]:
    """Run the filter over all dwells and return its state after each.

    - first: the factor of the prior.
    - rows: the whitened rows of each dwell.
    - walked: the variances (2, 3) of the biases' steps before and within each dwell.
    - following: the whitened rows of the slew after each dwell, which may be empty.

    A step's factor is the one after the slew; its innovation is that of the dwell alone.
    """
    factors, after, tests = [first], list[Floats](), list[tuple[float, int]]()
    for dwell_rows, variances, more in zip(rows, walked, following, strict=True):
        updated, nis = update(factors[-1], dwell_rows, variances)
        after.append(updated)
        tests.append((nis, row_rank(dwell_rows)))
        factors.append(update(updated, more)[0] if len(more) else updated)
    gained = ranks(np.array(after)) - ranks(np.array(factors[:-1]))
    return [
        FilterStep(factor, nis, count - new)
        for factor, (nis, count), new in zip(factors[1:], tests, gained.tolist(), strict=True)
    ]


def accumulate(rows: Sequence[Floats], walked: Floats | None = None, first: Floats | None = None) -> Floats:
    """Triangular factor [H | z] of all rows and of those of a prior, ``first``, which is diffuse without; the last row
    holds the norm of the residual.

    ``walked`` (D, 2, 3) are the variances of the biases' steps before and within each dwell; the dwells' rows are the
    last D in ``rows``. Without a walk all rows are reduced by one QR.
    """
    if walked is None or not walked.any():
        stacked = rows[0] if len(rows) == 1 else of_all_pieces(rows)
        stacked = stacked if first is None else np.concatenate([first, stacked])
        lacking = max(stacked.shape[1] - len(stacked), 0)
        return triangle(np.vstack([stacked, np.zeros((lacking, stacked.shape[1]))]) if lacking else stacked)
    rows, width = rows if first is None else [first, *rows], rows[-1].shape[1] - 4
    factor, left = np.zeros((width, width + 1)), 0.0
    padded = np.concatenate([np.zeros((len(rows) - len(walked), 2, 3)), walked])
    for own, variances in zip(rows, padded, strict=True):
        upper, count = random_walk.advance(factor, variances, own)
        factor, left = upper[count : count + width, count:], np.hypot(left, np.linalg.norm(upper[count + width :, -1]))
    return np.vstack([factor, np.append(np.zeros(width), left)])


def scale_columns(factor: Floats) -> tuple[Floats, Floats]:
    """R (..., p, p) of a factor with its columns scaled to a similar size, and the scales (..., p).

    All sensitivities share one scale and all biases another, so that a column of rounding size remains small.
    """
    size = np.linalg.norm(factor[..., :-1], axis=-2)
    twelve = size[..., :STATE_COUNT].reshape(*size.shape[:-1], 3, 4)
    largest = np.repeat(twelve.max(axis=-2)[..., 3:], 4, axis=-1)
    largest[..., :3] = twelve[..., :3].max(axis=(-2, -1))[..., None]
    scale = np.concatenate([np.tile(largest, 3), size[..., STATE_COUNT:]], axis=-1)
    scale = np.where(scale > 0, scale, 1.0)
    return factor[..., :-1] / scale[..., None, :], scale


def rank(factor: Floats, tolerance: float = ROUNDING) -> int:
    """Number of combinations of states that the factor determines: the rank of R."""
    return int(ranks(factor, tolerance))


def ranks(factors: Floats, tolerance: float = ROUNDING) -> NDArray[np.intp]:
    """Ranks (...) of many factors (..., p, p + 1), as ``rank``."""
    singular = np.linalg.svd(scale_columns(factors)[0], compute_uv=False)
    return np.asarray((singular > tolerance).sum(axis=-1))


def lost(factor: Floats) -> Floats:
    """An orthonormal basis (p, q) of what R does not determine, of states in units of their columns' scales."""
    _, singular, right = np.linalg.svd(scale_columns(factor)[0])
    return np.asarray(right[singular <= ROUNDING].T)


def solve(factor: Floats, around: Floats, tolerance: float = ROUNDING) -> tuple[Floats, Floats, Floats]:
    """State (p,), covariance (p, p) and a basis (p, q) of the combinations of states that are not determined.

      x = R^-1 z,  P = R^-1 R^-T

    Combinations that are not determined keep their value in ``around`` (p,), and the covariance does not include their
    variance. ``tolerance`` is the singular value of the scaled R below which a combination is not determined.
    """
    return solve_all(factor[None], around, tolerance)[0]


def solve_all(factors: Floats, around: Floats, tolerance: float = ROUNDING) -> list[tuple[Floats, Floats, Floats]]:
    """Solve many factors (n, p, p + 1); each result is as in ``solve``."""
    upper, scale = scale_columns(factors)
    left, singular, right = np.linalg.svd(upper)
    seen = singular > tolerance
    back = np.swapaxes(right, 1, 2) / scale[:, :, None]
    inverse = back * (seen / np.where(seen, singular, 1.0))[:, None, :]  # (n, p, p), zeros where not determined
    beside = factors[:, :, -1] - factors[:, :, :-1] @ around
    states = around + (inverse @ (np.swapaxes(left, 1, 2) @ beside[:, :, None]))[:, :, 0]
    covariances = inverse @ np.swapaxes(inverse, 1, 2)
    lost = [own[:, ~known] for own, known in zip(back, seen, strict=True)]
    return list(zip(states, covariances, lost, strict=True))
