"""Marginal likelihood of coefficients with a normal prior in a linear model with normal noise, which is exact.

With A the information of the coefficients, b their score (A x = b has the estimate x) and S the standard deviations of
their prior, the likelihood averaged over the prior, divided by that without the coefficients, is

    log L = 1/2 b' S (1 + S A S)^-1 S b - 1/2 log |1 + S A S|

A prior of a size that nobody knows is averaged over the sizes of a grid in equal steps of the logarithm.
"""

from __future__ import annotations

import math

import numpy as np

from kf_calib.bench.arrays import Floats

STEP = 2.0
"""Ratio of a size to the one before."""
FLAT = 1e6
"""Sigmas of one run: the prior of a coefficient of which nothing is known."""


def sizes(low: float, high: float, step: float = STEP) -> Floats:
    """Sizes from low to high in equal steps of the logarithm, at most ``step`` times the one before."""
    return np.geomspace(low, high, max(math.ceil(math.log(high / low) / math.log(step)), 1) + 1)


def log_evidence(info: Floats, score: Floats, prior: Floats) -> Floats:
    """log L (...,) of information (..., q, q), score (..., q) and standard deviations of the prior (..., q)."""
    info, score, prior = _alike(info, score, prior)
    if not score.shape[-1]:
        return np.zeros(score.shape[:-1])
    lower = np.linalg.cholesky(_within(info, prior))
    along = np.linalg.solve(lower, (prior * score)[..., None])[..., 0]
    return 0.5 * np.sum(along**2, axis=-1) - np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)


def posterior(info: Floats, score: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Mean (q,) and covariance (q, q) of the coefficients, with the same arguments."""
    inverse = np.linalg.inv(_within(info, prior))
    covariance = prior[:, None] * (0.5 * (inverse + inverse.T)) * prior
    return covariance @ score, covariance


def modes(info: Floats, score: Floats) -> tuple[Floats, Floats, Floats]:
    """Eigenvalues (..., q), score (..., q) and rows (..., q, q) of the directions in which the information is apart."""
    values, vectors = np.linalg.eigh(info)
    turned = np.swapaxes(vectors, -1, -2)
    return np.maximum(values, 0.0), (turned @ score[..., None])[..., 0], turned


def log_evidence_of_modes(values: Floats, score: Floats, size: Floats | float) -> Floats:
    """log L (...,) of eigenvalues and score (..., q) along them, for one ``size`` of all coefficients."""
    gain = np.asarray(size, float)[..., None] ** 2
    return 0.5 * np.sum(score**2 * gain / (1.0 + gain * values) - np.log1p(gain * values), axis=-1)


def log_mean(logarithms: Floats, axis: int | tuple[int, ...] | None = None) -> Floats:
    """Logarithm of the mean of numbers that are given by their logarithms."""
    whole = np.logaddexp.reduce(logarithms, axis=axis)
    return whole - np.log(logarithms.size / whole.size)


def _within(info: Floats, prior: Floats) -> Floats:
    """Return 1 + S A S."""
    return np.eye(info.shape[-1]) + prior[..., :, None] * info * prior[..., None, :]


def _alike(info: Floats, score: Floats, prior: Floats) -> tuple[Floats, Floats, Floats]:
    shape = np.broadcast_shapes(info.shape[:-2], score.shape[:-1], prior.shape[:-1])
    count = score.shape[-1]
    return (
        np.broadcast_to(info, (*shape, count, count)),
        np.broadcast_to(score, (*shape, count)),
        np.broadcast_to(prior, (*shape, count)),
    )
