"""The effect of a random walk of the biases on the rows of a dwell.

The bias is b(t) = b(t_0) + W(t), where W is a Brownian path of intensity q (m/s^2 per sqrt(s)) that steps from reading
to reading. Of each piece of a dwell, the coefficients of a parabola are kept; the covariance of those of W is known in
closed form. The filter's bias is the one at the end of a dwell. Therefore the rows of a dwell begin with columns for
the step s that the biases take within it; given s, the path within the dwell is independent of all other dwells. The
deviation of W from the parabolas is not used and is subtracted from the noise of a reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import Floats

_LEAST = 1e-12  # relative to the largest variance; smaller modes are rounding


@dataclass(frozen=True)
class WalkPath:
    """The effect of a random walk of intensity q = 1 on the r rows of a dwell's triangles.

    - step (r,): the change of the rows per unit of the bias's step s over the dwell, for a given bias at its end.
    - modes (r, k), variances (k,): principal axes of the remaining covariance, given s.
    - about_parabola (pieces,): the contribution of W to the sums of squares about the parabolas.
    """

    step: Floats
    modes: Floats
    variances: Floats
    about_parabola: Floats

    def whiten(self, rows: Floats, ratio: float) -> Floats:
        """Rows (r, c) of unit noise multiplied by V^(-1/2), where V = I + ``ratio``^2 sum of variances times modes
        modes^T."""
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + ratio**2 * self.variances)
        return rows - self.modes @ (shrink[:, None] * (self.modes.T @ rows))


def walk_path_of(begins_s: Floats, ends_s: Floats, counts: Sequence[int], triangles: Floats) -> WalkPath:
    """The effect for a dwell with the given pieces.

    - begins_s, ends_s (pieces,): first and last time of each piece; counts: their numbers of readings.
    - triangles (pieces, K, K): triangular factors over the basis [1 u u^2 ...].
    """
    root, end = _root(begins_s, ends_s, counts)
    onto = (triangles[:, :, :3] @ root).reshape(-1, root.shape[2])
    total = float(end @ end)
    share = onto @ end / total if total > 0 else np.zeros(len(onto))
    axes, sizes, _ = np.linalg.svd(onto - np.outer(share, end), full_matrices=False)
    significant = sizes**2 > _LEAST * max(float(sizes[0]) ** 2, 1e-300)
    spans = np.maximum(ends_s - begins_s, 0.0)
    about_parabola = spans * np.array([_moments(count)[1] / max(count - 1, 1) for count in counts])
    return WalkPath(share - triangles[:, :, 0].ravel(), axes[:, significant], sizes[significant] ** 2, about_parabola)


def _root(begins_s: Floats, ends_s: Floats, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Return W as a linear function of n independent unit normals: its parabolas' coefficients (pieces, 3, n) and its
    last value (n,).

    There are four normals for each piece: three for the coefficients of its parabola and one for the value of W when
    the next piece begins.
    """
    size = len(counts)
    pauses = np.maximum(np.append(begins_s[1:] - ends_s[:-1], 0.0), 0.0)
    coefficients, level = np.zeros((size, 3, 4 * size)), np.zeros(4 * size)
    for k, count in enumerate(counts):
        normals = slice(4 * k, 4 * k + 4)
        joint = _moments(count)[0] * max(ends_s[k] - begins_s[k], 0.0) / max(count - 1, 1)
        joint[3, 3] += pauses[k]
        values, vectors = np.linalg.eigh(joint)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        coefficients[k, 0] = level
        coefficients[k, :, normals] = root[:3]
        level[normals] = root[3]
    return coefficients, level


_MANY = 1 << 14
"""Readings of a piece above which the moments of a walk are those of a continuous one, to 1e-4 of them."""


@lru_cache(maxsize=4096)
def _moments(count: int) -> tuple[Floats, float]:
    """Return moments of a walk with unit steps over ``count`` readings that begins at zero.

    They are the covariance (4, 4) of the coefficients of its parabola on 1, u, u^2 and of its last value, and the mean
    sum of squares about the parabola.
    """
    if count > _MANY:  # of so many readings, it grows with their number, and the mean square with that of its square
        covariance, squares = _moments(_MANY)
        return covariance * (count / _MANY), squares * (count / _MANY) ** 2
    u = np.linspace(-1.0, 1.0, count)
    design = np.column_stack([np.ones(count), u, u * u]) if count > 1 else np.array([[1.0, 0.0, 0.0]])
    last = np.zeros((count, 1))
    last[-1] = 1.0
    weights = np.hstack([np.linalg.pinv(design).T, last])
    later = np.cumsum(weights[::-1], axis=0)[::-1][1:]  # each step moves all later readings
    covariance = later.T @ later
    inside = float(np.trace(design.T @ design @ covariance[:3, :3]))
    return covariance, max(0.5 * count * (count - 1) - inside, 0.0)


def lagged_products(period_s: float, size: int, pairs: Floats) -> Floats:
    """Contribution of a walk of intensity q = 1 to the sums of lagged products (L + 1,) about the parabolas of blocks
    of ``size`` readings.

    The residual has its mean square at lag 0 and loses half of q^2 times the lag, as the walk itself does. ``pairs`` (L
    + 1,) are the numbers of products.
    """
    return period_s * pairs * np.maximum(_moments(size)[1] / size - 0.5 * np.arange(len(pairs)), 0.0)
