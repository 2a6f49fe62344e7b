"""The block engine: a square-root information filter over dwell factors.

A dwell's factor is whitened by the noise model, its nuisance states (setting error, scatter) are eliminated, and the
rows that remain update the running factor [R | z] by QR. The posterior, least squares and leave-one-orientation-out
all come from such factors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.folding import WIDTH, DwellFactor, informative
from kf_calib.model import STATE_COUNT, Prior, dwell_map, state_map
from kf_calib.noise import Noise
from kf_calib.samples import Floats
from kf_calib.triangle import triangle


def whitened(dwells: Sequence[DwellFactor], noise: Noise, state: Floats) -> Floats:
    """Rows [H | z] of unit noise, (D, 12, 13), a dwell each, its nuisance states eliminated by QR.

    Channel i's rows are divided by the sigma of a white reading that averages like the true one; the setting error
    (three rotations) and the scatter (three offsets) enter as states with their priors, linearised at ``state``.
    """
    factors = np.array([dwell.factor for dwell in dwells]).reshape(-1, WIDTH + 3, WIDTH + 3)
    columns = np.where(informative(factors)[:, :, None], factors[:, :WIDTH, :], 0.0)
    sigma = noise.effective_sigma_mps2
    maps, nuisances = state_map(), dwell_map(state)
    used = np.flatnonzero(noise.dwell_sigmas > 0)
    count = len(used)
    out = np.zeros((len(dwells), 3 * WIDTH + count, count + STATE_COUNT + 1))
    for i in range(3):
        rows = out[:, i * WIDTH : (i + 1) * WIDTH]
        rows[:, :, :count] = columns[:, :, :WIDTH] @ nuisances[i][:, used] / sigma[i]
        rows[:, :, count:-1] = columns[:, :, :WIDTH] @ maps[i] / sigma[i]
        rows[:, :, -1] = columns[:, :, WIDTH + i] / sigma[i]
    if count:
        out[:, 3 * WIDTH :, :count] = np.diag(1.0 / noise.dwell_sigmas[used])
        out = triangle(out)[:, count:, count:]
    return out[:, : STATE_COUNT + 1]


@dataclass(frozen=True)
class Step:
    """The filter after one dwell: factor [R | z] (12, 13), normalised innovation squared and its degrees of freedom."""

    factor: Floats
    nis: float
    dof: int


def start(prior: Prior, parameters: Floats, state: Floats) -> Floats:
    """The factor [R | z] (12, 13) of a prior about the nominal ``parameters``; zeros for a diffuse one."""
    if prior.diffuse:
        return np.zeros((STATE_COUNT, STATE_COUNT + 1))
    root = np.linalg.inv(np.linalg.cholesky(prior.covariance(parameters)))
    return triangle(np.column_stack([root, root @ state]))[:STATE_COUNT]


def predict(factor: Floats, walk_variance: Floats) -> Floats:
    """Time update: the three biases take a step of variance (3,), 0: none. SRIF form, valid for a singular factor."""
    walking = np.flatnonzero(walk_variance > 0)
    count = len(walking)
    if not count:
        return factor
    biases = 4 * walking + 3
    augmented = np.zeros((count + STATE_COUNT, count + STATE_COUNT + 1))
    augmented[:count, :count] = np.diag(1.0 / np.sqrt(walk_variance[walking]))
    augmented[count:, :count] = -factor[:, biases]
    augmented[count:, count:] = factor
    return triangle(augmented)[count : count + STATE_COUNT, count:]


def update(factor: Floats, rows: Floats) -> Step:
    """Measurement update with one dwell's whitened rows (m, 13)."""
    upper = triangle(np.vstack([factor, rows]))
    after = upper[:STATE_COUNT]
    gained = rank(after) - rank(factor)
    informative_rows = int(np.linalg.matrix_rank(rows[:, :-1], rtol=1e-9)) if len(rows) else 0
    return Step(after, float(upper[STATE_COUNT, STATE_COUNT] ** 2), informative_rows - gained)


def run(first: Floats, rows: Iterable[Floats], walk_variances: Iterable[Floats]) -> list[Step]:
    """The recursion over dwells; one step of the biases' walk before each."""
    steps, factor = list[Step](), first
    for dwell_rows, variance in zip(rows, walk_variances, strict=True):
        steps.append(update(predict(factor, variance), dwell_rows))
        factor = steps[-1].factor
    return steps


def _scaled(factor: Floats) -> tuple[Floats, Floats]:
    """R in units in which its columns are of the same order, and those units (12,).

    One unit for all sensitivities and one for all biases: a column of rounding size must stay small.
    """
    size = np.linalg.norm(factor[:, :-1], axis=0).reshape(3, 4)
    largest = np.concatenate([np.full(3, size[:, :3].max()), size[:, 3:].max(axis=0)])
    scale = np.tile(np.where(largest > 0, largest, 1.0), 3)
    return factor[:, :-1] / scale, scale


def rank(factor: Floats, tolerance: float = 1e-9) -> int:
    """How many combinations of the states the factor determines."""
    singular = np.linalg.svd(_scaled(factor)[0], compute_uv=False)
    return int((singular > tolerance).sum())


def solve(factor: Floats, around: Floats, tolerance: float = 1e-9) -> tuple[Floats, Floats, Floats]:
    """State (12,), covariance (12, 12) and a basis (12, q) of the combinations not determined.

    Undetermined combinations keep their value ``around``; their variance is not in the covariance.
    """
    upper, scale = _scaled(factor)
    left, singular, right = np.linalg.svd(upper)
    seen = singular > tolerance
    inverse = (right[seen].T / singular[seen]) / scale[:, None]  # (12, rank)
    state = around + inverse @ (left[:, seen].T @ (factor[:, -1] - factor[:, :-1] @ around))
    return state, inverse @ inverse.T, right[~seen].T / scale[:, None]
