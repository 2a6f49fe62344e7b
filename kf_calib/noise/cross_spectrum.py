"""Noise that accelerometers share, as of a base that shakes or of one reference voltage: the correlations of the means.

A vector autoregression x_t = sum A_k x_(t-k) + e_t of the three channels is fitted to the covariances Gamma_k of
x_t with x_(t-k) of all dwells by the Yule-Walker equations. At frequency zero its spectral density is

  S = B cov(e) B^T  with  B = (1 - sum A_k)^-1,

and the mean of many readings has a covariance in proportion to it (H. Luetkepohl, New Introduction to Multiple Time
Series Analysis, 2005, ch. 2 and 3). What channels share of a quick vibration is thus told from what their means share.

What shakes up and down, and a noisy reference, is felt along the force, in each dwell by other channels. The S_d of the
dwells have an inverse Wishart distribution about that of all: with n_d readings and nu_0 degrees of freedom of this
distribution, the most likely ones, each dwell has the posterior mean (nu_0 S + n_d S_d) / (nu_0 + n_d).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.limits import CURVE
from kf_calib.dwells.sufficient_statistics import CROSS_LAGS, Autocovariance
from kf_calib.support.tail_probabilities import VARIANCE_SEEN

_PER_NUMBER = 16  # readings for each number of a model, and for each lag of a block
_FEWEST = 9 * _PER_NUMBER
_BEFORE = 4.0  # readings that are uncorrelated, as known beforehand: no two channels have quite the same noise
_SHAPES = np.geomspace(2.0, 1e5, 60)  # nu_0; of the last all dwells are alike


def correlations(of_dwells: Sequence[Autocovariance], total: Autocovariance) -> Floats:
    """Correlations (D, 3, 3) of the means of three channels in each dwell, from the sums of their lagged products and
    those of all dwells; identities where channels share no noise that is clear."""
    alone = np.tile(np.eye(3), (len(of_dwells), 1, 1))
    if total.crossed < _FEWEST or not (np.diag(total.across[0]) > 0.0).all():
        return alone
    lags = min(CROSS_LAGS, total.count // max(total.blocks, 1) // _PER_NUMBER, total.crossed // _FEWEST)
    model, of_all = _of_channels(_covariances([total], lags), total.crossed)
    known = [k for k, each in enumerate(of_dwells) if each.crossed > CURVE and (np.diag(each.across[0]) > 0.0).all()]
    if not known:
        return np.tile(of_all, (len(of_dwells), 1, 1))
    counts = np.array([of_dwells[k].crossed - CURVE for k in known], float)
    own = _densities(model, _covariances([of_dwells[k] for k in known], lags))
    shape = _likeliest_shape(of_all, own, counts)
    result = np.tile(of_all, (len(of_dwells), 1, 1))
    if shape < _SHAPES[-1]:
        result[known] = (shape * of_all + counts[:, None, None] * own) / (shape + counts)[:, None, None]
    return result


def _covariances(sums: Sequence[Autocovariance], lags: int) -> Floats:
    """Return the covariances (D, lags + 1, 3, 3) of readings in units of their own sigma."""
    across = np.array([each.across[: lags + 1] for each in sums])
    scales = np.sqrt(np.einsum("dii->di", across[:, 0]))
    gammas = across / (scales[:, :, None] * scales[:, None, :])[:, None]
    gammas[:, 0] += _BEFORE / np.array([each.crossed for each in sums])[:, None, None] * np.eye(3)
    return gammas


def _lagged(gammas: Floats) -> Floats:
    """Covariance (..., (L + 1) c, (L + 1) c) of x_t, x_(t-1), ... x_(t-L) from those (..., L + 1, c, c) of each lag."""
    lags, channels = gammas.shape[-3], gammas.shape[-1]
    both = np.concatenate([np.swapaxes(gammas[..., :0:-1, :, :], -1, -2), gammas], axis=-3)
    steps = np.arange(lags)
    blocks = both[..., lags - 1 + steps - steps[:, None], :, :]
    return np.swapaxes(blocks, -3, -2).reshape(*gammas.shape[:-3], lags * channels, lags * channels)


def _of_channels(gammas: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the coefficients (3, 3 p) of the autoregression of three channels that has the least BIC, and the
    correlation (3, 3) of their means; those of one for each channel, and the identity, where these have a lower one."""
    together, (model,) = _least_bic(gammas, count)
    separate = np.einsum("lii->il", gammas[0])[:, :, None, None]
    alone, models = _least_bic(separate, count)
    if together.sum() < alone.sum():
        return model, _densities(model, gammas)[0]
    lags = max(each.shape[1] for each in models)
    coefficients = np.zeros((3, lags, 3))
    for i, each in enumerate(models):
        coefficients[i, : each.shape[1], i] = each[0]
    return coefficients.reshape(3, 3 * lags), np.eye(3)


def _least_bic(gammas: Floats, count: int) -> tuple[Floats, list[Floats]]:
    """Return, for each of S sets of c channels with covariances (S, L + 1, c, c), the least BIC (S,) of its
    autoregressions over all orders p and the coefficients (c, c p) of the one that has it."""
    sets, orders, channels = gammas.shape[:3]
    lagged = _lagged(gammas)
    scores, models = np.empty((orders, sets)), list[Floats]()
    for order in range(orders):
        past = slice(channels, channels * (order + 1))
        across = lagged[:, :channels, past]
        solution = np.linalg.solve(lagged[:, past, past], np.swapaxes(across, 1, 2))
        model = np.swapaxes(solution, 1, 2).astype(float)
        left = np.linalg.slogdet(lagged[:, :channels, :channels] - model @ np.swapaxes(across, 1, 2))[1]
        scores[order] = count * left + (channels**2 * order + channels * (channels + 1) / 2) * np.log(count)
        models.append(model)
    best = np.argmin(scores, axis=0)
    return scores[best, np.arange(sets)], [models[order][i] for i, order in enumerate(best)]


def _densities(model: Floats, gammas: Floats) -> Floats:
    """Correlations (D, c, c) at frequency zero of readings with covariances (D, L + 1, c, c), by an autoregression
    (c, c p) and by the innovations that it leaves of them."""
    channels = gammas.shape[-1]
    filters = np.hstack([np.eye(channels), -model])
    lagged = _lagged(gammas)[:, : filters.shape[1], : filters.shape[1]]
    gain = np.linalg.inv(np.eye(channels) - model.reshape(channels, -1, channels).sum(axis=1)) @ filters
    densities = gain @ lagged @ gain.T
    sizes = np.sqrt(np.einsum("dii->di", densities))
    return densities / (sizes[:, :, None] * sizes[:, None, :])


def _likeliest_shape(of_all: Floats, of_dwells: Floats, counts: Floats) -> float:
    """Return the likeliest nu_0 for correlations (D, 3, 3) of so many readings (D,) about that of all; the last of
    ``_SHAPES`` where no smaller one is clearly likelier."""
    shapes = _SHAPES[:, None] + 4.0  # the mean of an inverse Wishart distribution of nu has nu - 4 for nu
    prior = _SHAPES[:, None, None, None] * of_all
    determinants = np.linalg.slogdet(prior + counts[:, None, None] * of_dwells)[1]
    logs = _log_gamma(shapes + counts) - _log_gamma(shapes)
    logs = logs + 0.5 * shapes * np.linalg.slogdet(prior)[1] - 0.5 * (shapes + counts) * determinants
    logs = logs.sum(axis=1)
    best = int(np.argmax(logs))
    return float(_SHAPES[best] if 2.0 * (logs[best] - logs[-1]) > VARIANCE_SEEN else _SHAPES[-1])


def _log_gamma(freedom: Floats) -> Floats:
    """Logarithm of the multivariate gamma function of half of it, of three channels, but for a constant."""
    different, positions = np.unique(freedom, return_inverse=True)
    logs = [sum(math.lgamma(0.5 * (value - k)) for k in range(3)) for value in different.tolist()]
    return np.array(logs)[positions].reshape(freedom.shape)
