"""What the four noises of IEEE Std 952-2020, annex C, give of differences of block means, in closed form.

A noise y with the one-sided spectral density S(f) has a sum x(t), the integral of y. Of what does not change where a
constant is added to y, all covariances follow from a generalised covariance g of x (G. Matheron, 1973):

  cov(sum_i a_i x(s_i), sum_j b_j x(t_j)) = sum_ij a_i b_j g(s_i - t_j)

  noise               size  unit          S(f)                g(t)                    Allan variance
  quantisation        Q     m/s           (2 pi f Q)^2 2 dt   Q^2 where t = 0         3 Q^2 / tau^2
  white               N     m/s^2/√Hz     2 N^2               -N^2 |t| / 2            N^2 / tau
  bias instability    B     m/s^2         B^2 / (pi f)        B^2 t^2 ln|t| / (2 pi)  (2 ln 2 / pi) B^2
  random walk         K     m/s^3/√Hz     2 K^2/(2 pi f)^2    K^2 |t|^3 / 12          K^2 tau / 3

N is therefore the root of the two-sided density, as Kalibr and IEEE have it. All are scale-free: with the unit of time
u, a table for u = 1 holds for all u, times u^-2, u^-1, 1 and u in the variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import Floats, Ints

TERMS = ("quantisation", "white", "bias_instability", "random_walk")
POWERS = np.array([-2.0, -1.0, 0.0, 1.0])
"""Of the length of clusters in the Allan variance of each term."""
FACTORS = np.array([3.0, 1.0, 2.0 * math.log(2.0) / math.pi, 1.0 / 3.0])
"""Allan variance of each term of size 1 at a cluster of 1 s."""
FLATTEST = math.sqrt(FACTORS[2])
"""Where the Allan deviation of 1/f noise stays: 0.664 B."""
_FARTHEST = 9  # octaves between clusters, beyond which estimates hardly depend on each other
_PLACES = 16  # lags in sums over all places: within the length of a cluster, or of clusters that do not overlap


def allan_variance(tau_s: Floats) -> Floats:
    """Allan variance (m, 4) of each term of size 1 for clusters of these lengths (m,)."""
    return FACTORS * tau_s[:, None] ** POWERS


def _generalised(lag: Floats) -> Floats:
    """Generalised covariance (4, ...) of the sum of each term of size 1."""
    size = np.abs(lag)
    return np.array([
        size == 0.0, -0.5 * size, size**2 * np.log(np.where(size > 0.0, size, 1.0)) / (2.0 * math.pi), size**3 / 12.0,
    ])  # fmt: skip


def _second_differences(lag: Floats, ratio: float) -> Floats:
    """Covariance (4, ...) of second differences over clusters of 1 and of ``ratio``, the former a lag later."""
    ends = np.arange(3.0)
    apart = ends[:, None] - ratio * ends
    of_ends = _generalised(lag[..., None, None] + apart)
    return np.diff(np.diff(of_ends, 2, axis=-1), 2, axis=-2)[..., 0, 0] / ratio


def cosine_transform(values: Floats) -> Floats:
    """Cosine transform of type II, orthonormal, over the first axis (n, ...)."""
    from scipy.fft import dct

    return np.asarray(dct(values, axis=0, norm="ortho"), float)


@lru_cache(maxsize=64)
def block_spectrum(count: int) -> Floats:
    """Variances (count - 1, 4) of the cosine transform (type II, orthonormal, but for its constant) of ``count``
    means of blocks of length 1.

    For white noise and a walk that steps between blocks the transform is uncorrelated, for the others nearly so.
    """
    lags = np.arange(count, dtype=float)
    covariance = 2.0 * _generalised(lags) - _generalised(lags + 1.0) - _generalised(lags - 1.0)
    places = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    variances = []
    for own in covariance:
        transformed = cosine_transform(cosine_transform(own[places]).T)
        variances.append(np.diag(transformed)[1:])
    return np.maximum(np.array(variances).T, 0.0)


@lru_cache(maxsize=1)
def _haar_correlations() -> Floats:
    """Covariance (4, lags) of Haar differences of blocks of one length, of which the first is with itself."""
    lags = 2.0 * np.arange(_PLACES, dtype=float)
    return 0.5 * _second_differences(lags, 1.0)


def haar_freedom(sizes: Floats, counts: Ints, squares: Floats) -> Floats:
    """Effective degrees of freedom (m,) of Haar variances for clusters of these lengths (m,), s, where the terms have
    these squares (4,)."""
    scaled = (squares * sizes[:, None] ** POWERS) @ _haar_correlations()
    correlation = scaled[:, 1:] / scaled[:, :1]
    share = np.maximum(1.0 - np.arange(1, _PLACES) / counts[:, None], 0.0)
    return counts / (1.0 + 2.0 * (share * correlation**2).sum(axis=1))


@lru_cache(maxsize=128)
def _kernel(octaves: int, places: int) -> tuple[Floats, Floats]:
    """Lags (l,) in lengths of the shorter cluster, so many to one, and the covariance (4, l) at each of second
    differences over clusters 2^octaves apart."""
    ratio = 2.0**octaves
    reach = 2.0 * ratio + 2.0
    lags = np.arange(-2.0 * places - round(reach * places), round((2.0 * ratio + reach) * places) + 1) / places
    return lags, _second_differences(lags, ratio)


def _pairs(lags: Floats, first: float, second: float, lengths: Mapping[int, int]) -> Floats:
    """How many pairs of places there are at each lag, where clusters of ``first`` and ``second`` readings begin
    anywhere in stretches of these lengths (and how many of each there are)."""
    total = np.zeros(len(lags))
    for length, number in lengths.items():
        ends = length - 2.0 * first, length - 2.0 * second
        if min(ends) >= 0.0:
            overlap = np.minimum(ends[0], ends[1] + lags) - np.maximum(0.0, lags) + 1.0
            total += number * np.maximum(overlap, 0.0)
    return total


def allan_covariance(sizes: Ints, lengths: Mapping[int, int], period_s: float, squares: Floats) -> Floats:
    """Covariance (m, m) of overlapping Allan variances for clusters of these sizes (m,) in readings, where the terms
    have these squares (4,).

    The covariance of two mean squares of Gaussian differences is 2 sum_l n(l) gamma(l)^2 / (n n'), with the covariance
    gamma of differences a lag l apart, and n(l) pairs of them. lengths: of the stretches, and how many of each.
    """
    count = len(sizes)
    covariance = np.zeros((count, count))
    totals = [sum(number * max(length - 2 * int(size) + 1, 0) for length, number in lengths.items()) for size in sizes]
    for i in range(count):
        size, places = float(sizes[i]), min(int(sizes[i]), _PLACES)
        scaled = squares * (size * period_s) ** POWERS
        for j in range(i, count):
            octaves = round(math.log2(sizes[j] / size))
            if octaves > _FARTHEST:
                break
            lags, terms = _kernel(octaves, places)
            smooth, comb = scaled[1:] @ terms[1:], scaled[0] * terms[0]
            step = size / places  # readings from one lag to the next; the comb of quantisation is there for one only
            pairs = _pairs(lags * size, size, float(sizes[j]), lengths)
            total = pairs @ (step * smooth**2 + 2.0 * smooth * comb + comb**2)
            covariance[i, j] = covariance[j, i] = 0.5 * total / (totals[i] * totals[j])
    return covariance


def histogram(lengths: Sequence[int], kinds: int = 200) -> dict[int, int]:
    """Lengths and how many there are of each; where there are more than ``kinds``, lengths of the nearest are alike."""
    values, numbers = np.unique(np.asarray(lengths, np.int64), return_counts=True)
    if len(values) > kinds:
        edges = np.unique(np.round(np.geomspace(values[0], values[-1] + 1, kinds)).astype(np.int64))
        values = edges[np.searchsorted(edges, values, side="right") - 1]
    table = dict[int, int]()
    for value, number in zip(values.tolist(), numbers.tolist(), strict=True):
        table[value] = table.get(value, 0) + number
    return table
