"""The innovation gate: single readings that disagree with the rest of their dwell are rejected and counted.

The innovation of a reading is judged after the dwell's own level has been removed, so that an orientation in which
the model fails (the evidence of a missing effect) is never rejected as a whole.
Innovations are (3, n), a channel a row: reductions along contiguous memory are several times faster.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats, Mask

_GAUSSIAN_MAD = 1.4826  # median absolute deviation -> sigma, for Gaussian noise


def innovations(columns: Floats, readings: Floats, static: bool, keep: Mask | None = None) -> Floats:
    """Readings (n, 3) less their least-squares fit by the columns (n, c) within the block; (3, n).

    In a ``static`` block (constant columns, a still platform) the fit is the mean. ``keep``: the readings fitted.
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
    """Which readings pass, (n,) bool; None: all of them.

    A reading is rejected where any channel's innovation, from the block's median, exceeds ``threshold`` robust sigma
    (1.4826 times the median absolute deviation; the plain deviation where that is zero, as on coarse steps).
    """
    count = len(readings)
    if count < 8:
        return None
    if _plainly_clean(innovation, threshold):
        return None
    keep: Mask = np.ones(count, bool)
    kept = innovation
    for _ in range(5):
        centre = np.median(kept, axis=1, keepdims=True)
        sigma = _GAUSSIAN_MAD * np.median(np.abs(kept - centre), axis=1, keepdims=True)
        sigma = np.where(sigma > 0, sigma, kept.std(axis=1, keepdims=True))
        now: Mask = np.all(np.abs(innovation - centre) <= threshold * np.maximum(sigma, 1e-12), axis=0)
        if (now == keep).all():
            break
        keep = now
        innovation = innovations(columns, readings, static, keep)
        kept = innovation[:, keep]
    return None if keep.all() or keep.sum() < 4 else keep


def channels(rejected: Floats, kept: Floats, threshold: float) -> Mask:
    """In which channels rejected readings lie out, (3, m) bool, from innovations (3, m) and those kept (3, n).

    One at least: the channel that is farthest out in its own sigma.
    """
    score = np.abs(rejected) / np.maximum(kept.std(axis=1, keepdims=True), 1e-12)
    return score >= np.minimum(threshold, score.max(axis=0))


def _plainly_clean(innovation: Floats, threshold: float) -> bool:
    """Whether the medians can be spared: no reading stands out, and the rms is that of the bulk (of a sample of it)."""
    rms = np.sqrt(np.einsum("ij,ij->i", innovation, innovation) / innovation.shape[1])
    if (np.maximum(innovation.max(axis=1), -innovation.min(axis=1)) > min(4.5, threshold) * rms).any():
        return False
    sample = innovation[:, :: max(1, innovation.shape[1] // 256)]
    bulk = _GAUSSIAN_MAD * np.median(np.abs(sample), axis=1)
    return bool((rms <= 1.5 * bulk).all())
