"""The innovation gate: rejects and counts single readings that disagree with the rest of their dwell.

The innovation of a reading is taken about the level of the dwell itself, so that an orientation in which the model
fails, which is the evidence for a missing effect, is never rejected as a whole. Innovations are stored as (3, n), one
row per channel, because reductions along contiguous memory are several times faster.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats, Mask

_GAUSSIAN_MAD = 1.4826  # median absolute deviation -> sigma, for Gaussian noise


def innovations(columns: Floats, readings: Floats, static: bool, keep: Mask | None = None) -> Floats:
    """Readings (n, 3) less their least-squares fit by the columns (n, c) within the block, as (3, n).

    In a ``static`` block (constant columns, platform at rest) the fit is the mean. ``keep`` selects the readings that
    are fitted.
    """
    channels = np.ascontiguousarray(readings.T)
    chosen = slice(None) if keep is None else keep
    if static:
        return channels - channels[:, chosen].mean(axis=1, keepdims=True)
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0, scale, 1.0)
    fitted = np.linalg.lstsq(scaled[chosen], readings[chosen], rcond=1e-10)[0]
    return channels - fitted.T @ scaled.T


def inliers(columns: Floats, readings: Floats, innovation: Floats, static: bool, threshold: float) -> Mask | None:
    """Mask (n,) of the readings that pass the gate; None if all do.

    A reading is rejected if the innovation in any channel differs from the block's median by more than ``threshold``
    robust standard deviations: 1.4826 times the median absolute deviation or, where that is zero because of coarse
    quantisation, the ordinary standard deviation.
    """
    count = len(readings)
    if count < 8:
        return None
    if _plainly_clean(innovation, threshold):
        return None
    keep: Mask = np.ones(count, bool)
    kept_innovation = innovation
    for _ in range(5):
        centre = np.median(kept_innovation, axis=1, keepdims=True)
        sigma = _GAUSSIAN_MAD * np.median(np.abs(kept_innovation - centre), axis=1, keepdims=True)
        sigma = np.where(sigma > 0, sigma, kept_innovation.std(axis=1, keepdims=True))
        inlying: Mask = np.all(np.abs(innovation - centre) <= threshold * np.maximum(sigma, 1e-12), axis=0)
        if (inlying == keep).all():
            break
        keep = inlying
        innovation = innovations(columns, readings, static, keep)
        kept_innovation = innovation[:, keep]
    return None if keep.all() or keep.sum() < 4 else keep


def channels(rejected: Floats, kept: Floats, threshold: float) -> Mask:
    """Mask (3, m) of the channels in which rejected readings are outliers, from the innovations of rejected (3, m) and
    kept (3, n) readings.

    At least one channel is marked, the one with the largest deviation in its own sigma.
    """
    score = np.abs(rejected) / np.maximum(kept.std(axis=1, keepdims=True), 1e-12)
    return score >= np.minimum(threshold, score.max(axis=0))


def _plainly_clean(innovation: Floats, threshold: float) -> bool:
    """Tell whether a quick test already shows that there are no outliers, so that the medians need not be computed.

    No reading may stand out, and the rms must agree with a robust estimate from a sample.
    """
    rms = np.sqrt(np.einsum("ij,ij->i", innovation, innovation) / innovation.shape[1])
    if (np.maximum(innovation.max(axis=1), -innovation.min(axis=1)) > min(4.5, threshold) * rms).any():
        return False
    sample = innovation[:, :: max(1, innovation.shape[1] // 256)]
    bulk = _GAUSSIAN_MAD * np.median(np.abs(sample), axis=1)
    return bool((rms <= 1.5 * bulk).all())
