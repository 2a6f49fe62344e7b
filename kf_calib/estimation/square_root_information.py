"""The block engine: a square-root information filter over dwell factors.

A dwell's factor is whitened by the noise model, its nuisance states (setting error, scatter) are eliminated, and the
rows that remain update the running factor [R | z] by QR. The posterior, least squares and leave-one-orientation-out
all come from such factors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import DwellFactor, alike
from kf_calib.estimation import random_walk
from kf_calib.estimation.measurement_model import STATE_COUNT, Model, dwell_map
from kf_calib.estimation.noise_model import FLOOR_MPS2, Noise, flicker_sigma, slow_scatter
from kf_calib.estimation.prior import Prior

_SLOW = np.arange(1, 5)
_STILL = np.zeros(2)
_AT_ONCE = 1 << 17  # numbers of rows worked on together, so that they stay in the cache


def whiten(
    dwells: Sequence[DwellFactor],
    columns: Sequence[Floats],
    noise: Noise,
    state: Floats,
    about: Floats | None = None,
    flicker_mps2: Floats | None = None,
    reduced: bool = True,
) -> list[Floats]:
    """Rows [S | H | z] of unit noise (r, s + p + 1) of each dwell, its nuisance states eliminated by QR.

    S: of the steps that the biases take in the dwell, where they walk (s 3, else 0); H has the biases at its end.

    ``columns``: the model's, at the nodes of each dwell. Channel i's rows are divided by the sigma of a white reading
    that averages like the true one; the setting error (three rotations) and the scatter (three offsets) enter as states
    with their priors, linearised at ``state``. What a dwell's rows leave over among themselves is not in the result.
    ``about`` (p,): z is the readings less what the model reads there, and states solved for count from it. A reading of
    size g is 1e6 sigma and more: its rounding is then no longer the largest error of whatever follows.
    ``flicker_mps2`` (3,): sqrt(h) of 1/f noise of density h / f, whose slow parts within a dwell are states, too.
    ``reduced``: to as few rows as the columns have rank; else all are there, which is faster where columns are many.
    """
    inside = 3 if noise.walk_mps2_per_sqrt_s else 0
    informative = np.append(np.ones(inside), _units(columns)) if reduced else None
    out = list[Floats]([np.empty((0, 0))] * len(dwells))
    for places in _batches(dwells, columns[0].shape[-1]):
        batch, stacked = [dwells[k] for k in places], np.array([columns[k] for k in places])
        rows, count = _weighted(batch, stacked, noise, state, about, flicker_mps2)
        if informative is None:
            found = list(_less(rows, count))
        else:
            found = _informative(triangle(rows)[:, count:, count:], informative)
        for k, own in zip(places, found, strict=True):
            out[k] = own
    return out


def _batches(dwells: Sequence[DwellFactor], width: int) -> Iterator[list[int]]:
    """Places of dwells whose rows are of one shape, as many at once as leave their ``width`` columns in the cache."""
    for places in alike(dwells):
        first = dwells[places[0]]
        most = max(_AT_ONCE // (3 * len(first.pieces) * first.width * (width + 1)), 1)
        yield from (places[k : k + most] for k in range(0, len(places), most))


def _weighted(
    dwells: Sequence[DwellFactor],
    columns: Floats,
    noise: Noise,
    state: Floats,
    about: Floats | None,
    flicker_mps2: Floats | None,
) -> tuple[Floats, int]:
    """Rows [nuisances | S | H | z] of unit noise of dwells of one shape (d, r, n), and how many nuisances they have.

    ``columns`` (d, pieces, K, 3, p). The rows of the channels come one after another, then those of the priors.
    """
    sigma, sigmas = noise.effective_sigma_mps2, noise.dwell_sigmas
    used, slow = np.flatnonzero(sigmas > 0), 0 if flicker_mps2 is None else len(_SLOW)
    offsets, priors = len(used), sigmas[used]
    if flicker_mps2 is not None:
        priors = np.append(priors, np.outer(np.maximum(flicker_mps2, FLOOR_MPS2), 1.0 / np.sqrt(_SLOW)))
    count, (many, pieces, functions, _, width) = len(priors), columns.shape
    inside, size = 3 if noise.walk_mps2_per_sqrt_s else 0, pieces * functions
    triangles = np.array([dwell.triangles for dwell in dwells])
    carried = triangles[:, :, :functions, :functions]
    regressors = np.array([dwell.regressors for dwell in dwells])
    nuisances = dwell_map(state)[:, :, used]
    waves = carried[..., :3] @ on_basis(np.array([_waves(dwell) for dwell in dwells])) if slow else None
    rows = np.zeros((many, 3 * size + count, count + inside + width + 1))
    for i in range(3):
        part = rows[:, i * size : (i + 1) * size]
        part[..., :offsets] = (regressors @ nuisances[i]).reshape(many, size, offsets)
        if waves is not None:
            first = offsets + slow * i
            part[..., first : first + slow] = waves.reshape(many, size, slow)
        part[..., count + inside : -1] = (carried @ on_basis(columns[..., i, :])).reshape(many, size, width)
        readings = triangles[:, :, :functions, functions + i, None]
        if about is not None:
            readings = readings - carried @ on_basis((columns[..., i, :] @ about)[..., None])
        part[..., -1] = readings.reshape(many, size)
        if inside:
            part[..., count + i] = [dwell.walk.step for dwell in dwells]
        part /= sigma[i]
        if inside:
            for own, dwell in zip(part, dwells, strict=True):
                own[:] = dwell.walk.whiten(own, float(noise.walk_mps2_per_sqrt_s / sigma[i]))
    rows[:, 3 * size :, :count] = np.diag(1.0 / priors)
    return rows, count


def _less(rows: Floats, count: int) -> Floats:
    """Rows (d, r, n) without the first ``count`` columns, projected off them."""
    nuisances = np.linalg.qr(rows[..., :count])[0]
    return rows[..., count:] - nuisances @ (np.swapaxes(nuisances, 1, 2) @ rows[..., count:])


def misfit_rows(
    dwells: Sequence[DwellFactor],
    columns: Sequence[Floats],
    noise: Noise,
    state: Floats,
    width: int,
    reduced: bool = True,
) -> tuple[list[Floats], int]:
    """Rows [H | W | G | z] by which a misfit is judged, and how many columns come before G (of the first ``width``: H).

    W: what a stated scatter may have in common in dwells that follow each other (``noise_model.slow_scatter``); its
    coefficients have a prior, the rows of which come first. Within dwells it may go on as 1/f noise does.
    """
    slow, sigma = slow_scatter(dwells, noise)
    if not sigma.size:
        return whiten(dwells, columns, noise, state, reduced=reduced), width
    flicker = flicker_sigma(noise, len(dwells))
    count, places = columns[0].shape[3] + len(sigma) + 1, width + np.arange(len(sigma))
    prior = np.zeros((len(sigma), count))
    prior[np.arange(len(sigma)), places] = 1.0 / sigma
    both = [
        np.concatenate([own[..., :width], more, own[..., width:]], axis=3)
        for own, more in zip(columns, slow, strict=True)
    ]
    return [prior, *whiten(dwells, both, noise, state, flicker_mps2=flicker, reduced=reduced)], width + len(sigma)


def misfit_columns(dwells: Sequence[DwellFactor], columns: Sequence[Floats], noise: Noise, state: Floats) -> Floats:
    """G (m, q) alone of ``misfit_rows``, all its rows, for a noise in which the biases do not walk."""
    count = len(slow_scatter(dwells, noise)[1])
    flicker = flicker_sigma(noise, len(dwells)) if count else None
    rows = whiten(dwells, columns, noise, state, flicker_mps2=flicker, reduced=False)
    return np.concatenate([np.zeros((count, columns[0].shape[3])), *(own[:, :-1] for own in rows)])


def _waves(dwell: DwellFactor) -> Floats:
    """sqrt(2) cos(pi k t / T) over a dwell of length T, (pieces, nodes, k)."""
    at = np.array([piece.nodes.elapsed_s for piece in dwell.pieces]) - dwell.start_s
    return np.sqrt(2.0) * np.cos(np.pi * _SLOW * (at / max(dwell.end_s - dwell.start_s, 1e-9))[..., None])


def _units(columns: Sequence[Floats]) -> Floats:
    """The largest each column becomes in the run (p,); one figure for all sensitivities."""
    largest = np.max([np.abs(own).max(axis=(0, 1, 2)) for own in columns], axis=0)
    largest[:STATE_COUNT] = np.tile([*[largest[:STATE_COUNT].max()] * 3, 1.0], 3)
    return np.where(largest > 0, largest, 1.0)


def _informative(rows: Floats, units: Floats) -> list[Floats]:
    """Of rows [H | z] of dwells (d, r, n) as few as H has rank: what the rows leave over is split off.

    A still dwell has rank 3. By SVD: QR would spread the residuals over rows that columns of rounding size lead.
    """
    left, singular, _ = np.linalg.svd(rows[..., :-1] / units, full_matrices=False)
    ranks = (singular > 1e-9 * singular[:, :1]).sum(axis=1)
    most = int(ranks.max())
    turned = np.swapaxes(left[..., :most], 1, 2) @ rows
    return [own[:rank].copy() for own, rank in zip(turned, ranks, strict=True)]


@dataclass(frozen=True)
class FilterStep:
    """The filter after one dwell and its slew: factor [R | z] (p, p + 1); the dwell's normalised innovation squared and
    its degrees of freedom."""

    factor: Floats
    nis: float
    dof: int


def prior_covariance(prior: Prior, model: Model) -> Floats:
    """Covariance (p, p) of a stated prior about the nominal parameters; effects have the scale of their kind."""
    out = np.diag([0.0] * STATE_COUNT + [coefficient.scale**2 for coefficient in model.coefficients])
    out[:STATE_COUNT, :STATE_COUNT] = prior.covariance(paper_parameters.nominal(model.bench.nominal))
    return out


def start(prior: Prior, model: Model) -> Floats:
    """The factor [R | z] (p, p + 1) of a prior about the nominal parameters and no effect; zeros for a diffuse one."""
    if prior.diffuse:
        return np.zeros((model.count, model.count + 1))
    root = np.linalg.inv(np.linalg.cholesky(prior_covariance(prior, model)))
    return triangle(np.column_stack([root, root @ model.nominal_state()]))[: model.count]


def update(factor: Floats, rows: Floats, walked: Floats = _STILL) -> tuple[Floats, float]:
    """Time and measurement update with whitened rows (m, s + p + 1): the factor, and the normalised innovation squared.

    ``walked`` (2,): variances of the biases' steps in the pause before the dwell and in the dwell.
    """
    width, (upper, count) = len(factor), random_walk.advance(factor, walked, rows)
    left = upper[count + width :, -1]
    return upper[count : count + width, count:], float(left @ left)


def restrict(factor: Floats, kept: Sequence[int]) -> Floats:
    """The factor [R | z] (k, k + 1) of the states ``kept``, in that order, the others held at zero: one small QR.

    What a filter carries of effects that are not in its model is conditioned away, and is there when they are added.
    """
    return triangle(factor[:, [*kept, -1]])[: len(kept)]


def row_rank(rows: Floats) -> int:
    """How many rows [H | z] of a dwell carry something of the model."""
    return int(rows[:, :-1].any(axis=1).sum())


def run(
    first: Floats, rows: Iterable[Floats], walked: Iterable[Floats], following: Iterable[Floats]
) -> list[FilterStep]:
    """The recursion over dwells, ``walked`` the variances of the biases' steps of each; rows ``following`` of its slew.

    A step's factor is that after the slew, its innovation that of the dwell.
    """
    factors, after, told = [first], list[Floats](), list[tuple[float, int]]()
    for dwell_rows, variances, more in zip(rows, walked, following, strict=True):
        own, nis = update(factors[-1], dwell_rows, variances)
        after.append(own)
        told.append((nis, row_rank(dwell_rows)))
        factors.append(update(own, more)[0] if len(more) else own)
    gained = ranks(np.array(after)) - ranks(np.array(factors[:-1]))
    return [
        FilterStep(factor, nis, count - new)
        for factor, (nis, count), new in zip(factors[1:], told, gained.tolist(), strict=True)
    ]


def accumulate(rows: Sequence[Floats], walked: Floats | None = None) -> Floats:
    """The triangle [H | z] of all rows (a diffuse prior), the residual in its last row.

    ``walked`` (D, 2): variances of the biases' steps before and in each dwell, the last D of the rows; without a walk
    all rows are folded at once.
    """
    if walked is None or not walked.any():
        stacked = rows[0] if len(rows) == 1 else np.concatenate(rows)
        lacking = max(stacked.shape[1] - len(stacked), 0)
        return triangle(np.vstack([stacked, np.zeros((lacking, stacked.shape[1]))]) if lacking else stacked)
    width = rows[-1].shape[1] - 4
    factor, left = np.zeros((width, width + 1)), 0.0
    padded = np.vstack([np.zeros((len(rows) - len(walked), 2)), walked])
    for own, variances in zip(rows, padded, strict=True):
        upper, count = random_walk.advance(factor, variances, own)
        factor, left = upper[count : count + width, count:], np.hypot(left, np.linalg.norm(upper[count + width :, -1]))
    return np.vstack([factor, np.append(np.zeros(width), left)])


def scale_columns(factor: Floats) -> tuple[Floats, Floats]:
    """R (..., p, p) of a factor in units in which its columns are of the same order, and those units (..., p).

    One unit for all sensitivities and one for all biases: a column of rounding size must stay small.
    """
    size = np.linalg.norm(factor[..., :-1], axis=-2)
    twelve = size[..., :STATE_COUNT].reshape(*size.shape[:-1], 3, 4)
    largest = np.repeat(twelve.max(axis=-2)[..., 3:], 4, axis=-1)
    largest[..., :3] = twelve[..., :3].max(axis=(-2, -1))[..., None]
    scale = np.concatenate([np.tile(largest, 3), size[..., STATE_COUNT:]], axis=-1)
    scale = np.where(scale > 0, scale, 1.0)
    return factor[..., :-1] / scale[..., None, :], scale


def rank(factor: Floats, tolerance: float = 1e-9) -> int:
    """How many combinations of the states the factor determines."""
    return int(ranks(factor, tolerance))


def ranks(factors: Floats, tolerance: float = 1e-9) -> NDArray[np.intp]:
    """The same of many factors (..., p, p + 1)."""
    singular = np.linalg.svd(scale_columns(factors)[0], compute_uv=False)
    return np.asarray((singular > tolerance).sum(axis=-1))


def solve(factor: Floats, around: Floats, tolerance: float = 1e-9) -> tuple[Floats, Floats, Floats]:
    """State (p,), covariance (p, p) and a basis (p, q) of the combinations not determined.

    Undetermined combinations keep their value ``around``; their variance is not in the covariance.
    """
    return solve_all(factor[None], around, tolerance)[0]


def solve_all(factors: Floats, around: Floats, tolerance: float = 1e-9) -> list[tuple[Floats, Floats, Floats]]:
    """The same of many factors (n, p, p + 1)."""
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
