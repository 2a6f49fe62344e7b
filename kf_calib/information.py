"""The block engine: a square-root information filter whose memory is one triangular factor a dwell.

Each dwell's rows [X | z] (regressors, three readings) are folded by QR into one upper-triangular factor of 7 x 7
numbers, unwhitened. That factor is all there is of the dwell: whitening by the noise model, eliminating the dwell's
nuisance states, the posterior, least squares and leave-one-orientation-out all work on the factors, with no second
pass over the data. Factors of the same dwell from two places merge by stacking and one more QR.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.model import REGRESSORS, STATE_COUNT, Prior, Rows, dwell_map, state_map
from kf_calib.noise import Noise
from kf_calib.samples import Floats, Mask
from kf_calib.triangle import triangle

_WIDTH = len(REGRESSORS)
_LAGS = 64
_CORRELATED_SAMPLES = 8192  # readings of a dwell whose autocovariance is accumulated
_FIRST_SNAPSHOT = 64


@dataclass(frozen=True)
class Autocovariance:
    """Sums of lagged products of the innovations within blocks: products (L + 1, 3), pairs (L + 1,), blocks' n."""

    products: Floats = field(default_factory=lambda: np.zeros((_LAGS + 1, 3)))
    pairs: Floats = field(default_factory=lambda: np.zeros(_LAGS + 1))
    count: int = 0
    blocks: int = 0

    def __add__(self, other: Autocovariance) -> Autocovariance:
        return Autocovariance(
            self.products + other.products,
            self.pairs + other.pairs,
            self.count + other.count,
            self.blocks + other.blocks,
        )

    @classmethod
    def of(cls, innovation: Floats) -> Autocovariance:
        """Of innovations (3, n)."""
        count = innovation.shape[1]
        padded = 1 << (count + _LAGS).bit_length()
        spectrum = np.fft.rfft(innovation, padded, axis=1)
        products = np.zeros((_LAGS + 1, 3))
        lags = min(_LAGS, count - 1) + 1
        products[:lags] = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, :lags].T
        return cls(products, np.maximum(count - np.arange(_LAGS + 1), 0).astype(float), count, 1)


@dataclass(frozen=True)
class DwellFactor:
    """One dwell, folded: factor (7, 7) upper triangular over [1 f_x f_y f_z | z1 z2 z3], count of readings."""

    number: int
    start_s: float
    end_s: float
    count: int
    factor: Floats
    pose: Floats  # (k,), mean
    temperature_c: float
    autocovariance: Autocovariance
    snapshots: tuple[tuple[float, int, Floats], ...] = ()  # (end_s, count, factor) at doublings of the count

    @property
    def means(self) -> Floats:
        """Means of the regressors and readings, (7,): 1, f (3), z (3)."""
        return self.factor[0] / self.factor[0, 0]

    def merged(self, other: DwellFactor) -> DwellFactor:
        """The same dwell from two stretches of samples, this one the earlier."""
        count = self.count + other.count
        shared = (self.count * self.pose + other.count * other.pose) / count
        return replace(
            self,
            end_s=max(self.end_s, other.end_s),
            count=count,
            factor=triangle(np.vstack([self.factor, other.factor])),
            pose=shared,
            temperature_c=(self.count * self.temperature_c + other.count * other.temperature_c) / count,
            autocovariance=self.autocovariance + other.autocovariance,
            snapshots=self.snapshots + other.snapshots,
        )


def fold(rows: Rows, correlated: bool = True) -> DwellFactor:
    """One block as a factor of its own; ``correlated``: its autocovariance too."""
    stacked = np.concatenate([rows.columns, rows.readings], axis=1)
    return DwellFactor(
        number=rows.dwell,
        start_s=float(rows.elapsed_s[0]),
        end_s=float(rows.elapsed_s[-1]),
        count=len(stacked),
        factor=_triangle(stacked),
        pose=rows.pose,
        temperature_c=rows.temperature_c,
        autocovariance=Autocovariance.of(rows.innovation) if correlated else Autocovariance(),
    )


def _triangle(stacked: Floats) -> Floats:
    """The (7, 7) triangle of rows (n, 7), padded with zeros where there are fewer rows than columns."""
    width = stacked.shape[1]
    if len(stacked) < width:
        stacked = np.vstack([stacked, np.zeros((width - len(stacked), width))])
    return triangle(stacked)


class Folder:
    """Folds rows into the list of dwell factors, dwell after dwell."""

    def __init__(self) -> None:
        self.dwells: list[DwellFactor] = []

    def add(self, rows: Rows) -> None:
        current = self.dwells[-1] if self.dwells else None
        if current is None or current.number != rows.dwell:
            self.dwells.append(replace(fold(rows), snapshots=_early_snapshots(rows)))
            return
        block = fold(rows, correlated=current.autocovariance.count < _CORRELATED_SAMPLES)
        if block.count + current.count >= 2 * _last_count(current):
            block = replace(block, snapshots=((current.end_s, current.count, current.factor),))
        self.dwells[-1] = current.merged(block)


def _last_count(dwell: DwellFactor) -> int:
    return dwell.snapshots[-1][1] if dwell.snapshots else _FIRST_SNAPSHOT


def _early_snapshots(rows: Rows) -> tuple[tuple[float, int, Floats], ...]:
    """Factors of the first 64, 128, 256 ... readings of a dwell's first block, for curves within the dwell."""
    stacked = np.concatenate([rows.columns, rows.readings], axis=1)
    out, size, done, factor = list[tuple[float, int, Floats]](), _FIRST_SNAPSHOT, 0, np.empty((0, stacked.shape[1]))
    while size < len(stacked):
        factor = _triangle(np.vstack([factor, stacked[done:size]]))
        out.append((float(rows.elapsed_s[size - 1]), size, factor))
        done, size = size, 2 * size
    return tuple(out)


def informative(factors: Floats) -> Mask:
    """Which of the first 4 rows of factors (D, 7, 7) carry model columns, (D, 4) bool.

    A still platform has one: the mean. The others then hold columns of rounding size and are noise.
    """
    size = np.linalg.norm(factors[:, :_WIDTH, :_WIDTH], axis=2)
    return size > 1e-9 * size[:, :1]


def whitened(dwells: Sequence[DwellFactor], noise: Noise, state: Floats) -> Floats:
    """Rows [H | z] of unit noise, (D, 12, 13), a dwell each, its nuisance states eliminated by QR.

    Channel i's rows are divided by the sigma of a white reading that averages like the true one; the setting error
    (three rotations) and the scatter (three offsets) enter as states with their priors, linearised at ``state``.
    """
    factors = np.array([dwell.factor for dwell in dwells]).reshape(-1, _WIDTH + 3, _WIDTH + 3)
    columns = np.where(informative(factors)[:, :, None], factors[:, :_WIDTH, :], 0.0)
    sigma = noise.effective_sigma_mps2
    maps, nuisances = state_map(), dwell_map(state)
    used = np.flatnonzero(noise.dwell_sigmas > 0)
    count = len(used)
    out = np.zeros((len(dwells), 3 * _WIDTH + count, count + STATE_COUNT + 1))
    for i in range(3):
        rows = out[:, i * _WIDTH : (i + 1) * _WIDTH]
        rows[:, :, :count] = columns[:, :, :_WIDTH] @ nuisances[i][:, used] / sigma[i]
        rows[:, :, count:-1] = columns[:, :, :_WIDTH] @ maps[i] / sigma[i]
        rows[:, :, -1] = columns[:, :, _WIDTH + i] / sigma[i]
    if count:
        out[:, 3 * _WIDTH :, :count] = np.diag(1.0 / noise.dwell_sigmas[used])
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
