"""The noise of readings within dwells: sigma_w of each accelerometer, and the inflation of the variance of means by its
autocorrelation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells import window_average
from kf_calib.dwells.pieces import lagged_walk_products
from kf_calib.dwells.sufficient_statistics import LAGS, Autocovariance, Dwell
from kf_calib.dwells.table import DwellTable, FoldedDwells, computed_once
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.noise_of_readings import (
    are_alike,
    expected_products,
    pooled_autocovariance,
    shares_in_correlation,
    unbiased,
)
from kf_calib.support.searches import MOST_STEPS

TOO_SHORT = 4.0
"""If blocks are shorter than this times kappa, they do not determine how slow their noise is. kappa is then as large as
in blocks half as long as they would have to be; in blocks up to twice as long, channels that are alike share one
correlation."""
_LONGEST, _SHORT = TOO_SHORT / 2.0, TOO_SHORT * 2.0


def within_dwells(
    dwells: Sequence[Dwell], walk_mps2_per_sqrt_s: Floats | float = 0.0, along: Floats | None = None
) -> Noise:
    """The noise within dwells, sigma_w and kappa of each accelerometer, pooled over all pieces.

    along (D, 3): the weights of the channels in the size of the force, where nothing else is known in a dwell.

    The contribution of a random walk of known intensity is subtracted. Over a piece of n readings, the sum of squares
    about a parabola has the expectation sigma^2 (n - 3 kappa) if n is at least 40 kappa. If there is no such piece,
    sigma_w is taken from the autocovariance.
    """
    table = DwellTable.of(dwells)
    within_seen = bool((table.folded.counts > 1).any())
    if np.any(walk_mps2_per_sqrt_s):
        shares = shares_in_correlation(table.folded) if along is None else table.folded.weights
        inflation, variance = _correlation(table.folded, shares, walk_mps2_per_sqrt_s)
    else:  # the same for all fits to the dwells
        inflation, variance = (_without_walk if along is None else _in_the_hand)(table.folded)
    if along is not None:
        return Noise(_sigma_along(table, along, inflation), inflation, within_seen=within_seen)
    counts, of_pieces = table.folded.piece_counts, np.repeat(table.folded.weights, table.folded.piece_numbers, axis=0)
    squares = of_pieces * table.folded.squares
    if np.any(walk_mps2_per_sqrt_s):
        rest = of_pieces * np.concatenate([walk.about_parabola for walk in table.folded.walks])[:, None]
        squares = np.maximum(squares - walk_mps2_per_sqrt_s**2 * rest, 0.0)
    on_carrier = table.folded.width - 3
    long = counts[:, None] >= np.where(variance > 0, 40.0 * inflation, 0.0)
    freedom = np.where(long, np.maximum(counts[:, None] - 3.0 * inflation - on_carrier, 0.0), 0.0).sum(axis=0)
    pooled = np.where(long, squares, 0.0).sum(axis=0) / np.maximum(freedom, 1.0)
    sigma = np.sqrt(np.where(long.any(axis=0), pooled, variance))
    return Noise(sigma, inflation, within_seen=within_seen)


@computed_once
def _without_walk(folded: FoldedDwells) -> tuple[Floats, Floats]:
    return _correlation(folded, shares_in_correlation(folded))


@computed_once
def _in_the_hand(folded: FoldedDwells) -> tuple[Floats, Floats]:
    """As all tremble, each dwell counts by the weights of its readings."""
    return _correlation(folded, folded.weights)


def _correlation(
    folded: FoldedDwells, shares: Floats, walk_mps2_per_sqrt_s: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Return kappa (3,) and the variances (3,) of readings within dwells of these shares, less those of a walk."""
    total = pooled_autocovariance(folded, shares)
    if np.any(walk_mps2_per_sqrt_s):
        total = replace(total, products=total.products - walk_mps2_per_sqrt_s**2 * _walk_products(folded, shares))
    known = _of_averages if folded.averaged else _inflation
    inflation, variance = np.array([known(total, i) for i in range(3)]).T
    if folded.averaged or total.count >= _SHORT * inflation.max() * total.blocks:
        return inflation, variance
    if are_alike(total):
        return _alike(total)
    return np.maximum(inflation, _too_short(inflation, total.count / total.blocks)), variance


def _sigma_along(table: DwellTable, along: Floats, inflation: Floats) -> Floats:
    """Return sigma_w (3,) of the accelerometers from the readings along the force alone, which have the variance sum of
    (m_i sigma_i)^2 with m = ``along`` (D, 3).

    The likeliest variances of such gamma distributed sums, by steps that keep them positive. The readings of a dwell
    then have one weight in all channels.
    """
    weights, folded = along**2, table.folded
    squares = folded.weights[:, 0] * folded.squares_along(along)
    freedom = np.add.reduceat(np.maximum(folded.piece_counts - 3.0 * inflation.mean(), 0.0), folded.ends[:-1])
    if not freedom.any():
        freedom = np.maximum(folded.counts - 1.0, 0.0)
    if not squares.any() or not freedom.any():
        return np.zeros(3)
    variances = np.full(3, squares.sum() / (freedom @ weights).sum())
    for _ in range(MOST_STEPS):
        expected = weights @ variances
        variances = variances * ((squares / expected**2) @ weights) / np.maximum((freedom / expected) @ weights, 1e-300)
    return np.sqrt(variances)


def _walk_products(folded: FoldedDwells, shares: Floats) -> Floats:
    """Return what a random walk of intensity q = 1 contributes to the sums of lagged products (L + 1, 3) of all
    dwells."""
    periods_s = np.diff(folded.ends_s, axis=1)[:, 0] / np.maximum(folded.counts - 1.0, 1.0)
    products = 0.0 * folded.autocovariances[0].products
    for known, period_s, share in zip(folded.autocovariances, periods_s.tolist(), shares, strict=True):
        if known.blocks:
            own = lagged_walk_products(period_s, max(round(known.count / known.blocks), 1), known.pairs)
            products = products + own[:, None] * share
    return products


def _inflation(total: Autocovariance, channel: int) -> tuple[float, float]:
    """Return kappa and the variance of one channel from an autoregression fitted to its autocovariance
    (``autoregression``).

    kappa is limited from above to what blocks of this length can show. It is below 1 where averages fall faster than
    those of white noise, but above 1/n: that is what is left of n differences when they are added up.
    """
    if total.count < LAGS or total.products[0, channel] <= 0:
        return 1.0, 0.0
    size = round(total.count / total.blocks)
    lags = min(LAGS, total.count // 16, size // 4)
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
    if size >= LAGS:
        found, variance = _inflation(total, channel)
        return max(found, kappa), variance
    kept = expected_products(np.append(window_average.correlations(), np.zeros(size))[:size], 0)[0] / size
    return kappa, float(total.products[0, channel] / total.pairs[0] / max(kept, 1e-3))
