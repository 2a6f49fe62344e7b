"""The noise model: what the readings of a still platform scatter by, within a dwell and from dwell to dwell.

Three parts (all 1 sigma). sigma_w: the noise of a reading within a dwell, with an inflation kappa for its
autocorrelation (kappa = spectral density at zero frequency / that of white noise of the same variance, so that the
mean of n readings has variance kappa sigma_w^2 / n). sigma_alpha: the setting error, one small rotation a dwell, common
to the three accelerometers. sigma_s: the scatter of each sensor from dwell to dwell. Each is stated or estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.folding import Autocovariance, DwellFactor, Means
from kf_calib.samples import Floats
from kf_calib.triangle import triangle

FLOOR_MPS2 = 1e-9
"""Readings that are exactly constant get this sigma: the rounding of a double is 1e-15 m/s^2."""

_MAX_ORDER = 20
_WANDER = 6
_SIGNIFICANT = 5.41  # 1 % point of the likelihood ratio of a variance against zero: half of chi2 with 1 dof


@dataclass(frozen=True)
class Noise:
    """sigma_mps2, inflation, scatter_mps2: (3,) each; setting_rad; which of the dwell parts were stated.

    checked: the scatter is stated, or the orientations are enough to check that a setting error only turns the specific
    force. The estimate then leans on the readings along it, which no rotation changes; otherwise dwells weigh by their
    scatter alone, and the setting error is *considered* (Schmidt): it enlarges the covariance and moves no estimate.
    slew_sigma_mps2 (3,): what stands for sigma and inflation in slews; None where none are used.
    """

    sigma_mps2: Floats
    inflation: Floats
    setting_rad: float = 0.0
    scatter_mps2: Floats = None  # type: ignore[assignment]  # set in __post_init__
    setting_stated: bool = False
    scatter_stated: bool = False
    checked: bool = True
    slew_sigma_mps2: Floats | None = None

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
        return replace(self, sigma_mps2=self.slew_sigma_mps2, inflation=np.ones(3))

    @property
    def dwell_sigmas(self) -> Floats:
        """Sigma (6,) of a dwell's nuisance states: three rotations in rad, three offsets in m/s^2; 0: absent."""
        return np.concatenate([np.full(3, self.setting_rad), self.scatter_mps2])


def within_dwells(dwells: Sequence[DwellFactor]) -> Noise:
    """sigma_w and kappa of each accelerometer, pooled over the pieces of the dwells.

    The sum of squares about a parabola has expectation sigma^2 (n - 3 kappa) over a piece of 40 kappa readings or more;
    where there is none, sigma_w is that of the autocovariance.
    """
    total = dwells[0].autocovariance
    for dwell in dwells[1:]:
        total += dwell.autocovariance
    inflation, variance = np.array([_inflation(total, i) for i in range(3)]).T
    squares, counts = (np.concatenate([getattr(each, key) for each in dwells]) for key in ("squares", "counts"))
    on_carrier = dwells[0].width - 3
    long = counts[:, None] >= np.where(variance > 0, 40.0 * inflation, 0.0)
    freedom = np.where(long, np.maximum(counts[:, None] - 3.0 * inflation - on_carrier, 0.0), 0.0).sum(axis=0)
    pooled = np.where(long, squares, 0.0).sum(axis=0) / np.maximum(freedom, 1.0)
    return Noise(np.sqrt(np.where(long.any(axis=0), pooled, variance)), inflation)


def _inflation(total: Autocovariance, channel: int) -> tuple[float, float]:
    """kappa, and the variance, from an autoregression fitted to the autocovariance (Yule-Walker), its order by BIC.

    kappa = v / (gamma_0 (1 - sum a)^2), v the variance of the autoregression's innovations (Percival and Walden, 1993,
    ch. 9). The autocovariance of readings less their block's parabola is low by about 3 kappa gamma_0 / n at every lag;
    that is put back by iteration. Never below 1: a noise that averages faster than white is not relied on.
    """
    if total.count < 64 or total.products[0, channel] <= 0:
        return 1.0, 0.0
    mean_block = total.count / total.blocks
    lags = min(_MAX_ORDER, total.count // 16, int(mean_block) // 4)
    raw = total.products[: lags + 1, channel] / np.maximum(total.pairs[: lags + 1], 1.0)
    kappa, gamma = 1.0, raw
    for _ in range(10):
        gamma = raw + 3.0 * kappa * raw[0] / max(mean_block - 3.0 * kappa, 1.0)
        before, kappa = kappa, min(_autoregressive_inflation(gamma, total.count), mean_block / 12)
        if abs(kappa - before) < 1e-3 * kappa:
            break
    return max(kappa, 1.0), float(gamma[0])


def _autoregressive_inflation(gamma: Floats, count: int) -> float:
    """Levinson-Durbin over all orders; kappa of the order with the least BIC."""
    a, variance = np.zeros(0), float(gamma[0])
    best = (count * np.log(variance), 1.0)
    for order in range(1, len(gamma)):
        reflection = (gamma[order] - a @ gamma[order - 1 : 0 : -1]) / variance
        if not abs(reflection) < 1:
            break
        a = np.append(a - reflection * a[::-1], reflection)
        variance *= 1 - reflection**2
        score = count * np.log(variance) + order * np.log(count)
        gain = float((1 - a.sum()) ** 2)
        if score < best[0] and gain > 0:
            best = (score, variance / gamma[0] / gain)
    return best[1]


def with_dwell_parts(
    within: Noise,
    means: Means,
    state: Floats,
    angle_sigma_deg: float | None,
    scatter_mps2: float | None,
) -> Noise:
    """The noise with its dwell parts: as stated, else estimated by restricted maximum likelihood where significant.

    Of the parts not stated (the scatter one number for all accelerometers, or one each), the combination with the best
    likelihood is taken, each number charged for by the 1 % point of its ratio against zero. Fewer than 6 degrees of
    freedom between dwells: nothing is estimated. Too few orientations to tell a setting error from the sensors'
    scatter: the whole misfit counts as scatter.
    """
    from scipy.special import chdtrc

    stated = replace(
        within,
        setting_rad=float(np.radians(angle_sigma_deg or 0.0)),
        scatter_mps2=np.full(3, scatter_mps2 or 0.0),
        setting_stated=angle_sigma_deg is not None,
        scatter_stated=scatter_mps2 is not None,
        checked=scatter_mps2 is not None or _setting_is_checked(means.force_mps2),
    )
    freedom = means.readings.size - means.design.shape[2]
    if freedom < 6 or (stated.setting_stated and stated.scatter_stated):
        return stated
    if chdtrc(freedom, _misfit(stated.weights, means, state)) > 0.1:  # nothing to explain: spares the search
        return stated
    if not stated.checked:
        free = {("common",)}
    else:
        settings = [()] if stated.setting_stated else [(), ("setting",)]
        scatters = [()] if stated.scatter_stated else [(), ("common",), ("scatter",)]
        free = {setting + scatter for setting in settings for scatter in scatters} - {()}
    best, best_score = stated, restricted_log_likelihood(stated.weights, means, state)
    for parts in sorted(free):
        found, score = _most_likely(stated, parts, means, state)
        if score > best_score:
            best, best_score = found, score
    return best


def _setting_is_checked(force_mps2: Floats) -> bool:
    """Whether the readings along f overdetermine what they see by 3 or more: f^T S f + f^T b, 9 numbers at most."""
    x, y, z = force_mps2.T / np.linalg.norm(force_mps2, axis=1).mean()
    design = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z])
    directions = len(np.unique(np.round(design[:, 6:], 2), axis=0))
    return directions - int(np.linalg.matrix_rank(design, tol=0.02)) >= 3


def _most_likely(stated: Noise, parts: tuple[str, ...], means: Means, state: Floats) -> tuple[Noise, float]:
    """The noise with the most likely sizes of ``parts``, and its log-likelihood less the charge for them."""
    from scipy.optimize import minimize

    def cost(logs: Floats) -> float:
        return -restricted_log_likelihood(_unpack(stated, logs, parts).weights, means, state)

    begin = _spread(means, parts)
    found = minimize(cost, begin, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4, "maxiter": 600})
    return _unpack(stated, found.x, parts), -float(found.fun) - 0.5 * _SIGNIFICANT * len(begin)


def wander(dwells: Sequence[DwellFactor], noise: Noise) -> tuple[list[Floats], Floats]:
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


def scatter_gain(noise: Noise, means: Means, state: Floats) -> float:
    """What a further scatter from dwell to dwell, as likely as can be, gains in log-likelihood."""
    from scipy.optimize import minimize_scalar

    def cost(log_sigma: float) -> float:
        scatter = np.hypot(noise.scatter_mps2, np.exp(log_sigma))
        return -restricted_log_likelihood(replace(noise, scatter_mps2=scatter), means, state)

    begin = float(_spread(means, ("common",))[0])
    found = minimize_scalar(cost, bounds=(begin - 5.0, begin + 2.0), method="bounded", options={"xatol": 1e-2})
    return max(-float(found.fun) - restricted_log_likelihood(noise, means, state), 0.0)


def _spread(means: Means, parts: tuple[str, ...]) -> Floats:
    """A starting point of the search: log sigmas at the size of the misfit of the dwell means."""
    design = means.design.reshape(-1, means.design.shape[2])
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    fitted = design / scale @ np.linalg.lstsq(design / scale, means.readings.ravel(), rcond=1e-9)[0]
    size = np.sqrt(np.mean((means.readings - fitted.reshape(-1, 3)) ** 2, axis=0)) + FLOOR_MPS2
    gravity = np.linalg.norm(means.force_mps2, axis=1).mean()
    logs = (
        ([np.log(size.mean() / gravity)] if "setting" in parts else [])
        + (list(np.log(size)) if "scatter" in parts else [])
        + ([np.log(size.mean())] if "common" in parts else [])
    )
    return np.array(logs)


def _unpack(noise: Noise, logs: Floats, parts: tuple[str, ...]) -> Noise:
    if "setting" in parts:
        noise = replace(noise, setting_rad=float(np.exp(logs[0])))
    if "scatter" in parts:
        noise = replace(noise, scatter_mps2=np.exp(logs[-3:]))
    if "common" in parts:
        noise = replace(noise, scatter_mps2=np.full(3, np.exp(logs[-1])))
    return noise


def mean_covariances(noise: Noise, means: Means, state: Floats) -> Floats:
    """Covariance (D, 3, 3) of the dwells' mean readings about the model.

    diag(kappa sigma_w^2 / n + sigma_s^2) + sigma_alpha^2 S (|f|^2 I - f f^T) S^T, S the sensitivities (rows).
    """
    own = noise.effective_sigma_mps2**2 / means.counts[:, None] + noise.scatter_mps2**2
    return own[:, :, None] * np.eye(3) + noise.setting_rad**2 * _turned(means, state)


def _turned(means: Means, state: Floats) -> Floats:
    """Covariance (D, 3, 3) of the mean readings per unit variance of a random small rotation."""
    force, sensitivity = means.force_mps2, state[:12].reshape(3, 4)[:, :3]
    across = np.einsum("di,di->d", force, force)[:, None, None] * np.eye(3) - force[:, :, None] * force[:, None, :]
    return sensitivity @ across @ sensitivity.T


def considered(noise: Noise, means: Means, state: Floats) -> Floats:
    """What each dwell's setting error adds to the information about the gain, (D, p, p); zeros where it is weighted.

    With weights W and design A, the covariance is P + P B P, B = sum A^T W dV W A, dV the setting error's part: the
    Schmidt-Kalman filter's covariance (Bierman, 1977, ch. VIII), in batch terms a sandwich.
    """
    count = means.design.shape[2]
    if noise.checked or not noise.setting_rad:
        return np.zeros((len(means.counts), count, count))
    weight = 1.0 / np.einsum("dii->di", mean_covariances(noise.weights, means, state))
    weighted = weight[:, :, None] * means.design
    return noise.setting_rad**2 * np.swapaxes(weighted, 1, 2) @ _turned(means, state) @ weighted


def _misfit(noise: Noise, means: Means, state: Floats) -> float:
    """Chi-squared of the dwell means about their generalised least-squares fit."""
    return float(_between(noise, means, state)[0][-1, -1] ** 2)


def restricted_log_likelihood(noise: Noise, means: Means, state: Floats) -> float:
    """REML of the dwell means: -1/2 (sum log|V_d| + log|sum A' V^-1 A| + r' V^-1 r), up to a constant."""
    upper, log_roots = _between(noise, means, state)
    size = np.abs(np.diag(upper))[:-1]
    seen = size > 1e-9 * size.max()
    return float(-log_roots - np.log(size[seen]).sum() - 0.5 * upper[-1, -1] ** 2)


def _between(noise: Noise, means: Means, state: Floats) -> tuple[Floats, float]:
    """Triangle (p + 1, p + 1) of the whitened dwell means [A | z], A in units of its size; sum of log|V_d|^(1/2)."""
    root = np.linalg.cholesky(mean_covariances(noise, means, state))
    scale = np.linalg.norm(means.design, axis=(0, 1))
    design = means.design / np.where(scale > 0, scale, 1.0)
    stacked = np.concatenate([design, means.readings[:, :, None]], axis=2)
    upper = triangle(np.linalg.solve(root, stacked).reshape(-1, stacked.shape[2]))
    return upper, float(np.log(np.einsum("dii->di", root)).sum())
