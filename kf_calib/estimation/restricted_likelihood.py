"""The restricted likelihood of the variances in correlated means, and where it is largest.

Means z = A x + e of covariance V = V_0 + sum v_k K_k; the coefficients x are integrated out (Patterson and Thompson,
1971): l = -1/2 (log|V| + log|A' V^-1 A| + z' P z), P = V^-1 - V^-1 A (A' V^-1 A)^-1 A' V^-1, but for a constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.estimation import banded
from kf_calib.estimation.noise_model import lift_rounding

_LEAST = 1e-4  # of the size that a search begins with: as small is none
_NEAR = 0.5  # ln of a size: a search that moves it by more did not begin close to its end
_ENOUGH = 1e-9  # what is left to gain of the log-likelihood ends a search
_STEPS, _HALVES = 100, 30


@dataclass(frozen=True)
class Point:
    """At some variances: minus the log-likelihood, chi-squared z' P z, the cost's derivatives (k,) by the variances,
    and their information (k, k)."""

    cost: float
    misfit: float
    slope: Floats
    information: Floats


@dataclass(frozen=True)
class Restricted:
    """rows [A | z] (3 D, p + 1); prior (q, p + 1): rows of unit noise of what is known of x; V_0 (D, 6, 3) and K_k
    (k, D, 6, 3), kept as ``banded`` does."""

    rows: Floats
    prior: Floats
    fixed: Floats
    shapes: Floats

    def at(self, variances: Floats) -> Point:
        """With y = P z the derivatives are (tr(P K_k) - y' K_k y) / 2 (Searle, Casella and McCulloch, 1992, sec. 6.6);
        y' K_k P K_l y / 2 is the mean of the information observed and expected (Gilmour, Thompson and Cullis, 1995)."""
        wider = variances @ self.shapes.reshape(len(variances), self.fixed.size)
        covariance = self.fixed + wider.reshape(self.fixed.shape)
        covariance[:, :3] = lift_rounding(covariance[:, :3])
        lower, known = banded.root(covariance), len(self.prior)
        whitened = np.concatenate([self.prior, banded.solved(lower, self.rows)])
        basis, upper = np.linalg.qr(whitened[:, :-1])
        rest = whitened[:, -1] - basis @ (basis.T @ whitened[:, -1])
        cost = np.log(lower[0]).sum() + np.log(np.abs(np.diag(upper))).sum() + 0.5 * rest @ rest
        basis, misfit = basis[known:], float(rest @ rest)
        back = banded.solved(lower, np.column_stack([basis, rest[known:]]), transposed=True)
        inner = banded.inverse(covariance, lower) - banded.outer(back)
        moved = banded.solved(lower, banded.products(self.shapes, back[:, -1]))
        within = basis.T @ moved
        information = 0.5 * (moved.T @ moved - within.T @ within)
        return Point(float(cost), misfit, 0.5 * banded.traces(inner, self.shapes), information)

    def most_likely(self, near: Floats | None = None) -> tuple[Floats, Point]:
        """The likeliest sizes (k,), roots of the variances, and the point there.

        The search begins at ones. It is shorter from sizes ``near`` its end; if it does not end near them, they count
        for nothing.
        """
        if near is not None:
            begin = np.maximum(near, 10.0 * _LEAST)
            sizes, point = self._search(begin)
            if (np.abs(np.log(np.maximum(sizes, 10.0 * _LEAST) / begin)) < _NEAR).all():
                return sizes, point
        return self._search(np.ones(len(self.shapes)))

    def curvature(self, sizes: Floats) -> Floats:
        """Second derivatives (k, k) of the cost by the logarithms of the sizes: differences of the first."""
        step, out = 1e-3, np.zeros((len(sizes),) * 2)
        for k in range(len(sizes)):
            for sign in (1.0, -1.0):
                moved = sizes.copy()
                moved[k] *= np.exp(sign * step)
                out[k] += sign * moved**2 * self.at(moved**2).slope / step
        return 0.5 * (out + out.T)

    def _search(self, sizes: Floats) -> tuple[Floats, Point]:
        """Newton's method by the sizes s, to which the cost is even: the way to zero has no edge.

        The curvature there is 4 s s' times that by the variances, and on its diagonal 2 slope, taken as positive: from
        far above a step then loses about half of a size, from far below it doubles it.
        """
        point = self.at(sizes**2)
        for _ in range(_STEPS):
            slope = 2.0 * sizes * point.slope
            curve = 4.0 * np.outer(sizes, sizes) * point.information + np.diag(2.0 * np.abs(point.slope) + 1e-12)
            free = (sizes > _LEAST) | (slope < 0.0)
            step = np.zeros_like(sizes)
            step[free] = -np.linalg.solve(curve[np.ix_(free, free)], slope[free])
            found = self._lower(sizes, step, point) if -0.5 * slope @ step > _ENOUGH else None
            if found is None:
                break
            sizes, point = found
        return np.where(sizes > _LEAST, sizes, 0.0), point

    def _lower(self, sizes: Floats, step: Floats, point: Point) -> tuple[Floats, Point] | None:
        """Where a step leads, or the first of its halves that costs less; None where none does."""
        for _ in range(_HALVES):
            moved = np.maximum(sizes + step, _LEAST)
            there = self.at(moved**2)
            if there.cost < point.cost:
                return moved, there
            step = 0.5 * step
        return None
