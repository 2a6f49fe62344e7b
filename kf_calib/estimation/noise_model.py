"""The noise model: what the readings of a still platform scatter by, within a dwell and from dwell to dwell.

Three parts (all 1 sigma). sigma_w: the noise of a reading within a dwell, with an inflation kappa for its
autocorrelation (kappa = spectral density at zero frequency / that of white noise of the same variance, so that the
mean of n readings has variance kappa sigma_w^2 / n). sigma_alpha: the setting error, one small rotation a dwell, common
to the three accelerometers. sigma_s: the scatter of each sensor from dwell to dwell. Each is stated or estimated
(``reml``). Beside them the biases may walk at random, by q times the square root of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells import walk_path, window_average
from kf_calib.dwells.sufficient_statistics import Autocovariance, DwellFactor
from kf_calib.estimation import random_walk
from kf_calib.estimation.autoregression import expected_products, unbiased
from kf_calib.estimation.dwell_columns import Means

FLOOR_MPS2 = 1e-9
"""Readings that are exactly constant get this sigma: the rounding of a double is 1e-15 m/s^2."""

_MAX_ORDER = 20
_LONGEST = 2.0  # kappa at most, as a part of a block
_SHORT = 8.0  # kappa: in blocks no longer than that one correlation is found for the three channels
TOO_SHORT = 4.0
"""Kappa: blocks no longer than that do not tell how slow their noise is."""

_AVERAGES = 60  # of a block, at least, from which their own correlation is taken
_WANDER = 6
_ROUNDING = 1e-14  # of a dwell's variance


@dataclass(frozen=True)
class Noise:
    """sigma_mps2, inflation, scatter_mps2: (3,) each; setting_rad; which of the dwell parts were stated.

    checked: the scatter is stated, or the orientations are enough to check that a setting error only turns the specific
    force. The estimate then leans on the readings along it, which no rotation changes; otherwise dwells weigh by their
    scatter alone, and the setting error is *considered* (Schmidt): it enlarges the covariance and moves no estimate.
    slew_sigma_mps2 (3,): what stands for sigma and inflation in slews; None where none are used.
    walk_mps2_per_sqrt_s: intensity q of the random walk of each bias; walk_spread: 1 sigma of ln q, None where q was
    stated or is zero.
    """

    sigma_mps2: Floats
    inflation: Floats
    setting_rad: float = 0.0
    scatter_mps2: Floats = None  # type: ignore[assignment]  # set in __post_init__
    setting_stated: bool = False
    scatter_stated: bool = False
    checked: bool = True
    slew_sigma_mps2: Floats | None = None
    walk_mps2_per_sqrt_s: float = 0.0
    walk_spread: float | None = None

    def __post_init__(self) -> None:
        if self.scatter_mps2 is None:  # pyright: ignore[reportUnnecessaryComparison]
            object.__setattr__(self, "scatter_mps2", np.zeros(3))

    @property
    def effective_sigma_mps2(self) -> Floats:
        """Sigma (3,) of white readings whose mean is as uncertain as that of the true, correlated ones."""
        return np.maximum(self.sigma_mps2, FLOOR_MPS2) * np.sqrt(self.inflation)

    @property
    def weights(self) -> Noise:
        """The noise by which dwells are weighted."""
        return self if self.checked else replace(self, setting_rad=0.0)

    @property
    def judging(self) -> Noise:
        """The noise by which a misfit is judged: scatter that was estimated from the same misfit is left out."""
        return self if self.scatter_stated else replace(self, scatter_mps2=np.zeros(3))

    def of(self, moving: bool) -> Noise:
        """The noise in dwells, or that in slews."""
        if not moving or self.slew_sigma_mps2 is None:
            return self
        return replace(self, sigma_mps2=self.slew_sigma_mps2, inflation=np.ones(3), walk_mps2_per_sqrt_s=0.0)

    @property
    def dwell_sigmas(self) -> Floats:
        """Sigma (6,) of a dwell's nuisance states: three rotations in rad, three offsets in m/s^2; 0: absent."""
        return np.concatenate([np.full(3, self.setting_rad), self.scatter_mps2])


def steps(dwells: Sequence[DwellFactor], noise: Noise) -> Floats:
    """Variances (D, 2) of the steps of a bias in the pause before each dwell and over the dwell."""
    ends = np.array([(dwell.start_s, dwell.end_s) for dwell in dwells])
    return random_walk.variances(ends[:, 0], ends[:, 1], noise.walk_mps2_per_sqrt_s)


def within_dwells(dwells: Sequence[DwellFactor], walk_mps2_per_sqrt_s: float = 0.0) -> Noise:
    """sigma_w and kappa of each accelerometer, pooled over the pieces; a known walk of the biases is not in them.

    The sum of squares about a parabola has expectation sigma^2 (n - 3 kappa) over a piece of 40 kappa readings or more;
    where there is none, sigma_w is that of the autocovariance.
    """
    total = dwells[0].autocovariance
    for dwell in dwells[1:]:
        total += dwell.autocovariance
    if walk_mps2_per_sqrt_s:
        total = replace(total, products=total.products - walk_mps2_per_sqrt_s**2 * _lagged(dwells))
    known = _of_averages if dwells[0].averaged else _inflation
    inflation, variance = np.array([known(total, i) for i in range(3)]).T
    if not dwells[0].averaged and total.count < _SHORT * inflation.max() * total.blocks:
        inflation, variance = _alike(total)
    squares, counts = (np.concatenate([getattr(each, key) for each in dwells]) for key in ("squares", "counts"))
    if walk_mps2_per_sqrt_s:
        rest = np.concatenate([dwell.walk.rest for dwell in dwells])
        squares = np.maximum(squares - walk_mps2_per_sqrt_s**2 * rest[:, None], 0.0)
    on_carrier = dwells[0].width - 3
    long = counts[:, None] >= np.where(variance > 0, 40.0 * inflation, 0.0)
    freedom = np.where(long, np.maximum(counts[:, None] - 3.0 * inflation - on_carrier, 0.0), 0.0).sum(axis=0)
    pooled = np.where(long, squares, 0.0).sum(axis=0) / np.maximum(freedom, 1.0)
    return Noise(np.sqrt(np.where(long.any(axis=0), pooled, variance)), inflation)


def _lagged(dwells: Sequence[DwellFactor]) -> Floats:
    """What a walk of q = 1 adds to the sums of lagged products (L + 1, 1) of all dwells."""
    out = 0.0 * dwells[0].autocovariance.pairs
    for dwell in dwells:
        known, period_s = dwell.autocovariance, (dwell.end_s - dwell.start_s) / max(dwell.count - 1, 1)
        if known.blocks:
            out += walk_path.lagged(period_s, max(round(known.count / known.blocks), 1), known.pairs)
    return out[:, None]


def _inflation(total: Autocovariance, channel: int) -> tuple[float, float]:
    """kappa, and the variance, from an autoregression fitted to the autocovariance (``autoregression``).

    Never below 1: a noise that averages faster than white is not relied on; and no larger than a block can tell.
    """
    if total.count < 64 or total.products[0, channel] <= 0:
        return 1.0, 0.0
    size = round(total.count / total.blocks)
    lags = min(_MAX_ORDER, total.count // 16, size // 4)
    raw = total.products[: lags + 1, channel] / np.maximum(total.pairs[: lags + 1], 1.0)
    model, variance = unbiased(raw, total.count, size)
    return min(max(model.inflation, 1.0), max(size / _LONGEST, 1.0)), variance


def _alike(total: Autocovariance) -> tuple[Floats, Floats]:
    """The same of blocks that are short for their correlation, of which a channel alone tells little: one for all.

    Where they are too short to tell, it is taken to be as slow as they allow.
    """
    varying = total.products[0] > 0
    channels, size = int(varying.sum()), total.count / total.blocks
    shape = np.mean(total.products[:, varying] / total.products[0, varying], axis=1, keepdims=True)
    pooled = Autocovariance(shape * total.pairs[0], total.pairs, total.count * channels, total.blocks * channels)
    kappa, variance = _inflation(pooled, 0)
    kappa = max(kappa, size / _LONGEST) if size < TOO_SHORT * kappa else kappa
    return np.where(varying, kappa, 1.0), variance * total.products[0] / total.pairs[0]


def _of_averages(total: Autocovariance, channel: int) -> tuple[float, float]:
    """The same of averages over windows that overlap: of few what white noise makes, of many no less."""
    if not total.count:
        return 1.0, 0.0
    size, kappa = round(total.count / total.blocks), window_average.inflation()
    if size >= _AVERAGES:
        found, variance = _inflation(total, channel)
        return max(found, kappa), variance
    kept = expected_products(np.append(window_average.correlations(), np.zeros(size))[:size], 0)[0] / size
    return kappa, float(total.products[0, channel] / total.pairs[0] / max(kept, 1e-3))


def slow_scatter(dwells: Sequence[DwellFactor], noise: Noise) -> tuple[list[Floats], Floats]:
    """The slow part of a stated scatter: columns at the nodes of each dwell (pieces, nodes, 3, q), constant in it, and
    the sigma (q,) of their coefficients.

    What a bench states as scatter from dwell to dwell may be flicker: as large, but alike in dwells that follow each
    other, which looks like a drift. Of 1/f noise of density h / f, dwell means vary by s^2 = h ln D about the mean of D
    dwells, and its part sqrt(2) cos(pi k t / T) of a run of length T has the variance h / k.
    """
    channels = np.flatnonzero(noise.scatter_mps2 > 0)
    if len(dwells) < 4 or not channels.size:
        return [np.zeros((len(dwell.pieces), 3, 3, 0)) for dwell in dwells], np.zeros(0)
    start, span = dwells[0].start_s, dwells[-1].end_s - dwells[0].start_s
    orders, out = np.arange(1, _WANDER + 1), list[Floats]()
    for dwell in dwells:
        own = np.zeros((len(dwell.pieces), dwell.width, 3, len(channels), _WANDER))
        at = (0.5 * (dwell.start_s + dwell.end_s) - start) / span
        own[:, :3, channels, np.arange(len(channels))] = np.sqrt(2.0) * np.cos(np.pi * orders * at)
        out.append(own.reshape(*own.shape[:3], -1))
    sigma = flicker_sigma(noise, len(dwells))[channels, None] / np.sqrt(orders)
    return out, sigma.ravel()


def flicker_sigma(noise: Noise, dwells: int) -> Floats:
    """sqrt(h) (3,) of a scatter stated for so many dwells, were it flicker."""
    return noise.scatter_mps2 / np.sqrt(np.log(max(dwells, 2)))


def mean_covariances(noise: Noise, means: Means, state: Floats) -> Floats:
    """Covariance (D, 3, 3) of the dwells' mean readings about the model.

    diag(kappa sigma_w^2 / n + sigma_s^2) + sigma_alpha^2 S (|f|^2 I - f f^T) S^T, S the sensitivities (rows).
    """
    own = noise.effective_sigma_mps2**2 / means.counts[:, None] + noise.scatter_mps2**2
    return own[:, :, None] * np.eye(3) + noise.setting_rad**2 * setting_covariances(means, state)


def lift_rounding(covariances: Floats) -> Floats:
    """Covariances (D, 3, 3) with as much more in all directions as is rounding: a setting error alone does not turn the
    force along itself, and where noise is far below it, rounding decides whether there is a root."""
    least = _ROUNDING * np.einsum("dii->d", covariances)
    return np.asarray(covariances + least[:, None, None] * np.eye(3), float)


def setting_covariances(means: Means, state: Floats) -> Floats:
    """Covariance (D, 3, 3) of the mean readings per unit variance of a random small rotation."""
    force, sensitivity = means.force_mps2, state[:12].reshape(3, 4)[:, :3]
    across = np.einsum("di,di->d", force, force)[:, None, None] * np.eye(3) - force[:, :, None] * force[:, None, :]
    return sensitivity @ across @ sensitivity.T


def considered_information(noise: Noise, means: Means, state: Floats) -> Floats:
    """What each dwell's setting error adds to the information about the gain, (D, p, p); zeros where it is weighted.

    With weights W and design A, the covariance is P + P B P, B = sum A^T W dV W A, dV the setting error's part: the
    Schmidt-Kalman filter's covariance (Bierman, 1977, ch. VIII), in batch terms a sandwich.
    """
    count = means.design.shape[2]
    if noise.checked or not noise.setting_rad:
        return np.zeros((len(means.counts), count, count))
    weight = 1.0 / np.einsum("dii->di", mean_covariances(noise.weights, means, state))
    weighted = weight[:, :, None] * means.design
    return noise.setting_rad**2 * np.swapaxes(weighted, 1, 2) @ setting_covariances(means, state) @ weighted
