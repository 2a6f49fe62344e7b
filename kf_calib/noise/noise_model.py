"""The noise model: how the readings of a platform at rest scatter, within a dwell and from dwell to dwell.

It has three parts, each given as one standard deviation. sigma_w is the noise of a reading within a dwell; its
autocorrelation is described by the inflation kappa, the spectral density at frequency zero divided by that of white
noise of the same variance, so that the mean of n readings has the variance kappa sigma_w^2 / n. sigma_alpha is the
setting error, one small rotation per dwell that all three accelerometers share. sigma_s is the scatter of each
accelerometer from dwell to dwell. The setting error and the scatter are either stated or estimated (``reml``). In
addition the biases may follow a random walk of intensity q, whose standard deviation after the time t is q sqrt(t).
The noise of the thermometer leaves a smooth error of the temperature (``temperature_course``), which enters the
readings times their sensitivity to the temperature in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells import window_average
from kf_calib.dwells.pieces import OfPieces, lagged_walk_products
from kf_calib.dwells.stack import DwellStack, Folded
from kf_calib.dwells.sufficient_statistics import Autocovariance, DwellFactor
from kf_calib.noise import random_walk
from kf_calib.noise.means import Means
from kf_calib.noise.noise_of_readings import are_alike, expected_products, unbiased
from kf_calib.noise.temperature_course import thermometer_errors

FLOOR_MPS2 = 1e-9
"""Least sigma of a reading, used where readings are exactly constant; the rounding of a double is about 1e-15 m/s^2."""

_MAX_ORDER = 20
_LONGEST = 2.0  # kappa is at most the readings in a block divided by this
_SHORT = 8.0  # if blocks are shorter than this times kappa, channels that are alike share one correlation
TOO_SHORT = 4.0
"""If blocks are shorter than this times kappa, they do not determine how slow their noise is."""

_AVERAGES = 60  # least number of averages of a block from which their own correlation is estimated
_WANDER = 6
_STEPS_ALONG = 30
_ROUNDING = 1e-14  # relative to a dwell's variance
_TURNED = 1e4  # sigmas of a mean reading: what an attitude that is not known may change it by

ATTITUDE_UNKNOWN_RAD = np.inf
"""The setting error where the attitude of the dwells is not known at all."""


@dataclass(frozen=True)
class Noise:
    """The parameters of the noise model.

    - sigma_mps2 (3,): sigma_w of each accelerometer.
    - inflation (3,): kappa of each accelerometer.
    - setting_rad: sigma_alpha; infinite where the attitude of the dwells is not known at all.
    - scatter_mps2 (3,): sigma_s of each accelerometer; zeros if not given.
    - setting_stated, scatter_stated: whether these parts were stated rather than estimated.
    - setting_judged: whether a setting error that was estimated is so clear that it counts where the misfit is judged.
    - checked: whether the setting error is weighted. It is if the scatter is stated, or if there are enough
      orientations to check that a setting error only turns the specific force; readings along the specific force, which
      no rotation changes, then get more weight. Otherwise dwells are weighted by their scatter alone and the setting
      error is a considered parameter (Schmidt), which enlarges the covariance but does not change the estimate.
    - slew_sigma_mps2 (3,): the effective sigma in slews; None if no slews are used.
    - walk_mps2_per_sqrt_s: the intensity q of the random walk of each bias.
    - walk_spread: the sigma of ln q; None if q was stated or is zero.
    - sensitivity_mps2_per_k (3, 8): change of the readings per K on the regressors 1, f and T, T f
      (``temperature_course``); None where the noise of the thermometer does not matter.
    - square_sigmas (3, 3): sigma of the sensitivity of each channel to the force along each axis, by angles between
      axes that the dwells do not tell (``free_attitude``); None where all are told.
    - flicker_mps2 (3,): sqrt(h) of 1/f noise within dwells (``nuisance_states``); None for none.
    - within_seen: whether readings within dwells showed their noise; in a table of means alone they do not.
    """

    sigma_mps2: Floats
    inflation: Floats
    setting_rad: float = 0.0
    scatter_mps2: Floats = None  # type: ignore[assignment]  # set in __post_init__
    setting_stated: bool = False
    scatter_stated: bool = False
    setting_judged: bool = False
    checked: bool = True
    slew_sigma_mps2: Floats | None = None
    walk_mps2_per_sqrt_s: float = 0.0
    walk_spread: float | None = None
    within_seen: bool = True
    sensitivity_mps2_per_k: Floats | None = None
    flicker_mps2: Floats | None = None
    square_sigmas: Floats | None = None

    def __post_init__(self) -> None:
        if self.scatter_mps2 is None:  # pyright: ignore[reportUnnecessaryComparison]
            object.__setattr__(self, "scatter_mps2", np.zeros(3))

    @property
    def effective_sigma_mps2(self) -> Floats:
        """Sigma (3,) of white readings whose mean has the same variance as the mean of the correlated readings."""
        return np.maximum(self.sigma_mps2, FLOOR_MPS2) * np.sqrt(self.inflation)

    @property
    def correlation_length(self) -> Floats:
        """The readings (3,) that count as one where variances are estimated: kappa, but at least one."""
        return np.maximum(self.inflation, 1.0)

    @property
    def weights(self) -> Noise:
        """The noise by which dwells are weighted in the fit."""
        return self if self.checked else replace(self, setting_rad=0.0)

    @property
    def for_goodness_of_fit(self) -> Noise:
        """The noise by which the misfit is judged: without scatter, and an unclear setting error, that were estimated
        from this misfit itself, unless no other noise is known."""
        if not self.within_seen:
            return self
        known = self.without_estimates()
        return replace(known, setting_rad=self.setting_rad) if self.setting_judged else known

    def without_estimates(self) -> Noise:
        """The noise without scatter and a setting error that were estimated from the misfit, which they explain."""
        return replace(
            self,
            scatter_mps2=self.scatter_mps2 if self.scatter_stated else np.zeros(3),
            setting_rad=self.setting_rad if self.setting_stated or self.attitude_unknown else 0.0,
        )

    def of(self, moving: bool) -> Noise:
        """The noise that applies in slews if ``moving``, else the noise in dwells."""
        if not moving or self.slew_sigma_mps2 is None:
            return self
        return replace(self, sigma_mps2=self.slew_sigma_mps2, inflation=np.ones(3), walk_mps2_per_sqrt_s=0.0)

    @property
    def of_readings(self) -> Noise:
        """The noise without an unknown attitude, which the readings themselves show; with angles, all of it."""
        return replace(self, setting_rad=0.0) if self.attitude_unknown else self

    @property
    def attitude_unknown(self) -> bool:
        """Whether nothing is known of the attitude of a dwell, so that only the size of the force is."""
        return not np.isfinite(self.setting_rad)


def steps(dwells: Sequence[DwellFactor], noise: Noise) -> Floats:
    """Variances (D, 2) of the steps of a bias in the pause before each dwell and over the dwell."""
    ends = DwellStack.of(dwells).folded.ends_s
    return random_walk.variances(ends[:, 0], ends[:, 1], noise.walk_mps2_per_sqrt_s)


def within_dwells(
    dwells: Sequence[DwellFactor], walk_mps2_per_sqrt_s: float = 0.0, along: Floats | None = None
) -> Noise:
    """The noise within dwells, sigma_w and kappa of each accelerometer, pooled over all pieces.

    along (D, 3): the weights of the channels in the size of the force, where nothing else is known in a dwell.

    The contribution of a random walk of known intensity is subtracted. Over a piece of n readings, the sum of squares
    about a parabola has the expectation sigma^2 (n - 3 kappa) if n is at least 40 kappa. If there is no such piece,
    sigma_w is taken from the autocovariance.
    """
    stack = DwellStack.of(dwells)
    dwells, within_seen = stack.folded.dwells, bool((stack.folded.counts > 1).any())
    if walk_mps2_per_sqrt_s:
        inflation, variance = _correlation(stack.folded, walk_mps2_per_sqrt_s)
    else:  # the same for all fits to the dwells
        if "correlation" not in stack.folded.known:
            stack.folded.known["correlation"] = _correlation(stack.folded, 0.0)
        inflation, variance = stack.folded.known["correlation"]
    if along is not None:
        return Noise(_sigma_along(stack, along, inflation), inflation, within_seen=within_seen)
    counts, of_pieces = stack.folded.piece_counts, np.repeat(stack.folded.weights, stack.folded.piece_numbers, axis=0)
    squares = of_pieces * stack.folded.squares
    if walk_mps2_per_sqrt_s:
        rest = of_pieces * np.concatenate([dwell.walk.about_parabola for dwell in dwells])[:, None]
        squares = np.maximum(squares - walk_mps2_per_sqrt_s**2 * rest, 0.0)
    on_carrier = dwells[0].width - 3
    long = counts[:, None] >= np.where(variance > 0, 40.0 * inflation, 0.0)
    freedom = np.where(long, np.maximum(counts[:, None] - 3.0 * inflation - on_carrier, 0.0), 0.0).sum(axis=0)
    pooled = np.where(long, squares, 0.0).sum(axis=0) / np.maximum(freedom, 1.0)
    sigma = np.sqrt(np.where(long.any(axis=0), pooled, variance))
    return Noise(sigma, inflation, within_seen=within_seen)


def _correlation(folded: Folded, walk_mps2_per_sqrt_s: float) -> tuple[Floats, Floats]:
    """Return kappa (3,) and the variances (3,) of readings within dwells, less those of a random walk."""
    total, dwells = folded.autocovariance, folded.dwells
    if walk_mps2_per_sqrt_s:
        total = replace(total, products=total.products - walk_mps2_per_sqrt_s**2 * _walk_products(dwells))
    known = _of_averages if dwells[0].averaged else _inflation
    inflation, variance = np.array([known(total, i) for i in range(3)]).T
    if dwells[0].averaged or total.count >= _SHORT * inflation.max() * total.blocks:
        return inflation, variance
    if are_alike(total):
        return _alike(total)
    return np.maximum(inflation, _too_short(inflation, total.count / total.blocks)), variance


def _sigma_along(stack: DwellStack, along: Floats, inflation: Floats) -> Floats:
    """Return sigma_w (3,) of the accelerometers from the readings along the force alone, which have the variance sum of
    (m_i sigma_i)^2 with m = ``along`` (D, 3).

    The likeliest variances of such gamma distributed sums, by steps that keep them positive. The readings of a dwell
    then have one weight in all channels.
    """
    weights, folded = along**2, stack.folded
    squares = folded.weights[:, 0] * folded.squares_along(along)
    freedom = np.add.reduceat(np.maximum(folded.piece_counts - 3.0 * inflation.mean(), 0.0), folded.ends[:-1])
    if not freedom.any():
        freedom = np.maximum(folded.counts - 1.0, 0.0)
    if not squares.any() or not freedom.any():
        return np.zeros(3)
    variances = np.full(3, squares.sum() / (freedom @ weights).sum())
    for _ in range(_STEPS_ALONG):
        expected = weights @ variances
        variances = variances * ((squares / expected**2) @ weights) / np.maximum((freedom / expected) @ weights, 1e-300)
    return np.sqrt(variances)


def _walk_products(dwells: Sequence[DwellFactor]) -> Floats:
    """Return what a random walk of intensity q = 1 contributes to the sums of lagged products (L + 1, 3) of all
    dwells."""
    products = 0.0 * dwells[0].autocovariance.products
    for dwell in dwells:
        known, period_s = dwell.autocovariance, (dwell.end_s - dwell.start_s) / max(dwell.count - 1, 1)
        if known.blocks:
            own = lagged_walk_products(period_s, max(round(known.count / known.blocks), 1), known.pairs)
            products = products + own[:, None] * dwell.weights
    return products


def _inflation(total: Autocovariance, channel: int) -> tuple[float, float]:
    """Return kappa and the variance of one channel from an autoregression fitted to its autocovariance
    (``autoregression``).

    kappa is limited from above to what blocks of this length can show. It is below 1 where averages fall faster than
    those of white noise, but above 1/n: that is what is left of n differences when they are added up.
    """
    if total.count < 64 or total.products[0, channel] <= 0:
        return 1.0, 0.0
    size = round(total.count / total.blocks)
    lags = min(_MAX_ORDER, total.count // 16, size // 4)
    raw = total.products[: lags + 1, channel] / np.maximum(total.pairs[: lags + 1], 1.0)
    model, variance = unbiased(raw, total.count, size)
    return min(max(model.inflation, 1.0 / size), max(size / _LONGEST, 1.0)), variance


def _alike(total: Autocovariance) -> tuple[Floats, Floats]:
    """Return kappa (3,) and the variances (3,) with one autocorrelation for all channels, for blocks that are short for
    their correlation time.

    A single channel then contains too little information. If the blocks are too short even together, kappa is set to
    the largest value that they allow.
    """
    varying = total.products[0] > 0
    channels, size = int(varying.sum()), total.count / total.blocks
    shape = np.mean(total.products[:, varying] / total.products[0, varying], axis=1, keepdims=True)
    pooled = Autocovariance(shape * total.pairs[0], total.pairs, total.count * channels, total.blocks * channels)
    kappa, variance = _inflation(pooled, 0)
    kappa = np.maximum(kappa, _too_short(np.array(kappa), size))
    return np.where(varying, kappa, 1.0), variance * total.products[0] / total.pairs[0]


def _too_short(inflation: Floats, size: float) -> Floats:
    """Return the least kappa that blocks of this size allow where they are too short to determine it, else zeros."""
    return np.where(size < TOO_SHORT * inflation, size / _LONGEST, 0.0)


def _of_averages(total: Autocovariance, channel: int) -> tuple[float, float]:
    """Return kappa and the variance of one channel for averages over overlapping windows.

    For short blocks kappa is that of averaged white noise; for long ones it is estimated, but not below that value.
    """
    if not total.count:
        return 1.0, 0.0
    size, kappa = round(total.count / total.blocks), window_average.inflation()
    if size >= _AVERAGES:
        found, variance = _inflation(total, channel)
        return max(found, kappa), variance
    kept = expected_products(np.append(window_average.correlations(), np.zeros(size))[:size], 0)[0] / size
    return kappa, float(total.products[0, channel] / total.pairs[0] / max(kept, 1e-3))


def slow_scatter(dwells: Sequence[DwellFactor], noise: Noise) -> tuple[OfPieces, Floats]:
    """Columns (pieces, nodes, 3, q) for the slow part of a stated scatter in each dwell, and the prior sigmas (q,) of
    their coefficients.

    Scatter that is stated for a bench may be flicker noise, which has the same size but is similar in consecutive
    dwells and so looks like a drift. With 1/f noise of spectral density h / f, the means of D dwells have the variance
    s^2 = h ln D about their common mean, and the component sqrt(2) cos(pi k t / T) of a run of length T has the
    variance h / k. The columns are these components for k = 1 ... 6, constant within a dwell.
    """
    return slow_waves(dwells, flicker_sigma(noise, len(dwells)))


def slow_waves(dwells: Sequence[DwellFactor], flicker_mps2: Floats) -> tuple[OfPieces, Floats]:
    """The same for 1/f noise with sqrt(h) = ``flicker_mps2`` (3,); none for an accelerometer without it."""
    channels, folded = np.flatnonzero(flicker_mps2 > 0), DwellStack.of(dwells).folded
    pieces, width = folded.ends[-1], folded.dwells[0].width
    if len(dwells) < 4 or not channels.size:
        return OfPieces(np.zeros((pieces, width, 3, 0)), folded.ends), np.zeros(0)
    begin_s, orders = folded.ends_s[0, 0], np.arange(1, _WANDER + 1)
    at = (folded.ends_s.mean(axis=1) - begin_s) / (folded.ends_s[-1, 1] - begin_s)
    waves = np.zeros((pieces, width, 3, len(channels), _WANDER))
    courses = np.sqrt(2.0) * np.cos(np.pi * orders * np.repeat(at, folded.piece_numbers)[:, None])
    waves[:, :3, channels, np.arange(len(channels))] = courses[:, None, None]
    sigma = flicker_mps2[channels, None] / np.sqrt(orders)
    return OfPieces(waves.reshape(*waves.shape[:3], -1), folded.ends), sigma.ravel()


def shared_noise(dwells: Sequence[DwellFactor], noise: Noise) -> tuple[OfPieces, Floats]:
    """Columns (pieces, nodes, 3, q) of all noise that dwells have in common, the slow part of a stated scatter, angles
    that are taken for square and the error of the temperature, and the prior sigmas (q,) of their coefficients."""
    slow, sigma = slow_scatter(dwells, noise)
    if noise.square_sigmas is not None:
        untold = changes_by_square_axes(dwells, noise.square_sigmas)
        slow, sigma = slow.beside(untold), np.append(sigma, np.ones(untold.values.shape[3]))
    if noise.sensitivity_mps2_per_k is None:
        return slow, sigma
    errors = thermometer_errors(dwells, noise.sensitivity_mps2_per_k)
    return slow.beside(errors), np.append(sigma, np.ones(errors.values.shape[3]))


def changes_by_square_axes(dwells: Sequence[DwellFactor], square_sigmas: Floats) -> OfPieces:
    """Changes (pieces, nodes, 3, k) of each dwell's readings if one of k angles that are taken for square is 1 sigma
    off."""
    stack, places = DwellStack.of(dwells), np.argwhere(square_sigmas > 0.0)
    changes = np.zeros((len(stack.force_mps2), 3, len(places)))
    for k, (channel, axis) in enumerate(places.tolist()):
        changes[:, channel, k] = stack.force_mps2[:, axis] * square_sigmas[channel, axis]
    return stack.folded.at_nodes(changes)


def flicker_sigma(noise: Noise, dwells: int) -> Floats:
    """sqrt(h) (3,) of the 1/f noise that would produce the stated scatter over ``dwells`` dwells."""
    return noise.scatter_mps2 / np.sqrt(np.log(max(dwells, 2)))


def mean_covariances(noise: Noise, means: Means, state: Floats, misfit_mps2: float = 0.0) -> Floats:
    """Covariances (D, 3, 3) of the dwells' mean readings about the model.

      diag(kappa sigma_w^2 / n + sigma_s^2) + sigma_alpha^2 S (|f|^2 I - f f^T) S^T

    S holds the sensitivities of the accelerometers in its rows, f is the specific force. An attitude that is not known
    counts as a sigma_alpha so large that it leaves the size of f alone, also where the noise is not known yet and is to
    be estimated from a misfit of this rms size.
    """
    variances = noise.effective_sigma_mps2**2 / means.counts + noise.scatter_mps2**2
    size = np.linalg.norm(means.force_mps2, axis=1).max()
    unknown_rad = _TURNED * max(float(np.sqrt(variances.max())), misfit_mps2) / size
    setting_rad = unknown_rad if noise.attitude_unknown else noise.setting_rad
    return variances[:, :, None] * np.eye(3) + setting_rad**2 * setting_covariances(means, state)


def lift_rounding(covariances: Floats) -> Floats:
    """Covariances (D, 3, 3) with a small multiple of the identity added, so that a Cholesky factor exists.

    The covariance of a setting error is singular along the specific force. If the other noise is far below the setting
    error, rounding would decide whether the matrix is positive definite.
    """
    least = _ROUNDING * np.einsum("dii->d", covariances)
    return np.asarray(covariances + least[:, None, None] * np.eye(covariances.shape[-1]), float)


def setting_covariances(means: Means, state: Floats) -> Floats:
    """Covariances (D, 3, 3) of the mean readings that a random small rotation of unit variance per axis produces."""
    force, sensitivity = means.force_mps2, means.sensitivities(state)
    across = np.einsum("di,di->d", force, force)[:, None, None] * np.eye(3) - force[:, :, None] * force[:, None, :]
    return sensitivity @ across @ np.swapaxes(sensitivity, 1, 2)


def considered_information(noise: Noise, means: Means, state: Floats) -> Floats:
    """Contribution B (D, p, p) of each dwell's setting error to the covariance P + P (sum of B) P; zeros if it is
    weighted.

      B = A^T W V W A

    A is the design, W the weights and V the setting error's covariance of the mean readings. This is the covariance of
    the Schmidt-Kalman filter (G. J. Bierman, Factorization Methods, 1977, ch. VIII); in regression it is known as a
    sandwich.
    """
    count = means.design.shape[2]
    if noise.checked or not noise.setting_rad:
        return np.broadcast_to(np.zeros((count, count)), (len(means.counts), count, count))
    weight = 1.0 / np.einsum("dii->di", mean_covariances(noise.weights, means, state))
    weighted = weight[:, :, None] * means.design
    return noise.setting_rad**2 * np.swapaxes(weighted, 1, 2) @ setting_covariances(means, state) @ weighted
