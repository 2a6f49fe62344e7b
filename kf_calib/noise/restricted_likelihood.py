"""The restricted likelihood of the variances in correlated means, and its maximum.

The means are z = A x + e, where e has the covariance V = V_0 + sum v_k K_k. With the coefficients x integrated out
(Patterson and Thompson, 1971), the log-likelihood of the variances v_k is, up to a constant,

  l = -1/2 (log|V| + log|A' V^-1 A| + z' P z),  P = V^-1 - V^-1 A (A' V^-1 A)^-1 A' V^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import orthonormal, square_triangle
from kf_calib.noise import banded
from kf_calib.noise.noise_model import lift_rounding

_LEAST = 1e-4  # relative to the size at which a search begins; smaller sizes count as zero
_NEAR = 0.5  # if ln of a size changes by more, the search did not begin near its end
_ENOUGH = 1e-9  # the search ends when less log-likelihood than this can be gained,
_ROUNDING = 1e-12  # or less than this share of the cost, which for thousands of dwells is not computed better
_STEPS, _HALVES = 100, 12


@dataclass(frozen=True)
class Point:
    """The likelihood at given variances.

    - cost: minus the log-likelihood.
    - misfit: chi-squared z' P z.
    - slope (k,): derivatives of the cost by the variances.
    - information (k, k): average of their observed and expected information.
    """

    cost: float
    misfit: float
    slope: Floats
    information: Floats


@dataclass(frozen=True)
class _Level:
    """The likelihood at given variances, and what its derivatives are made from.

    - cost, misfit: as of a point.
    - covariance (D, 6, 3), lower (6, 3 D), or (D, 3, 3) where no means are correlated: V and its Cholesky factor, in
      the layouts of ``banded``.
    - basis (3 D, p), rest (3 D,): of the whitened rows, an orthonormal basis of A and what it leaves of z.
    """

    cost: float
    misfit: float
    covariance: Floats
    lower: Floats
    basis: Floats
    rest: Floats


@dataclass(frozen=True)
class Restricted:
    """The restricted likelihood as a function of the variances.

    - rows (3 D, p + 1): [A | z].
    - prior (q, p + 1): whitened rows of prior knowledge of x.
    - fixed (D, 6, 3), shapes (k, D, 6, 3): V_0 and K_k, in the layout of ``banded``; (D, 3, 3) and (k, D, 3, 3) where
      no means are correlated.
    """

    rows: Floats
    prior: Floats
    fixed: Floats
    shapes: Floats

    def at(self, variances: Floats) -> Point:
        """The likelihood and its derivatives at ``variances`` (k,)."""
        return self._with_derivatives(self._level(variances))

    def root_of(self, variances: Floats, places: slice) -> tuple[Floats, Floats]:
        """A root (q, q) of the information on the coefficients of some columns at ``variances`` (k,), all others
        integrated out, and the readings (q,) in its rows: root @ x is what the readings say of them."""
        whitened, columns = self._whitened(variances)[1], np.arange(self.rows.shape[1] - 1)
        chosen = columns[places]
        order = np.concatenate([np.setdiff1d(columns, chosen), chosen, [len(columns)]])
        upper, first = square_triangle(whitened[:, order]), len(columns) - len(chosen)
        return upper[first:-1, first:-1], upper[first:-1, -1]

    def _whitened(self, variances: Floats) -> tuple[tuple[Floats, Floats], Floats]:
        """Return the covariance V and its root at ``variances`` (k,), and the rows [A | z] whitened by it, those of
        prior knowledge first."""
        wider = variances @ self.shapes.reshape(len(variances), self.fixed.size)
        covariance = self.fixed + wider.reshape(self.fixed.shape)
        covariance[:, :3] = lift_rounding(covariance[:, :3])
        lower = banded.root(covariance)
        whitened = banded.solve(lower, self.rows)
        return (covariance, lower), np.concatenate([self.prior, whitened]) if len(self.prior) else whitened

    def _level(self, variances: Floats) -> _Level:
        """Return the likelihood at ``variances`` (k,), without its derivatives, which take more time."""
        (covariance, lower), whitened = self._whitened(variances)
        known = len(self.prior)
        basis, upper = orthonormal(whitened[:, :-1].copy())
        rest = whitened[:, -1] - basis @ (basis.T @ whitened[:, -1])
        cost = np.log(banded.diagonal(lower)).sum() + np.log(np.abs(np.diag(upper))).sum() + 0.5 * rest @ rest
        return _Level(float(cost), float(rest @ rest), covariance, lower, basis[known:], rest[known:])

    def _with_derivatives(self, level: _Level) -> Point:
        """Return the likelihood with its derivatives.

        With y = P z, the derivatives of the cost are (tr(P K_k) - y' K_k y) / 2 (Searle, Casella and McCulloch, 1992,
        sec. 6.6), and y' K_k P K_l y / 2 is the average of observed and expected information (Gilmour, Thompson and
        Cullis, 1995).
        """
        covariance, lower, basis, rest = level.covariance, level.lower, level.basis, level.rest
        back = banded.solve(lower, np.column_stack([basis, rest]), transposed=True)
        inner = banded.inverse(covariance, lower) - banded.outer(back, covariance.shape[1])
        moved = banded.solve(lower, banded.products(self.shapes, back[:, -1]))
        within = basis.T @ moved
        information = 0.5 * (moved.T @ moved - within.T @ within)
        return Point(level.cost, level.misfit, 0.5 * banded.traces(inner, self.shapes), information)

    def most_likely(self, start: Floats | None = None) -> tuple[Floats, Point]:
        """The sizes (k,), roots of the variances, at which the likelihood is largest, and the likelihood there.

        The search begins at ones, or at ``start``, which makes it shorter. If it ends far from ``start``, it is
        repeated from ones, so that ``start`` has no influence on the result.
        """
        if start is not None:
            begin = np.maximum(start, 10.0 * _LEAST)
            sizes, point = self._search(begin)
            if (np.abs(np.log(np.maximum(sizes, 10.0 * _LEAST) / begin)) < _NEAR).all():
                return sizes, point
        return self._search(np.ones(len(self.shapes)))

    def curvature(self, sizes: Floats) -> Floats:
        """Second derivatives (k, k) of the cost by the logarithms of the sizes, from differences of the first
        derivatives."""
        step, second = 1e-3, np.zeros((len(sizes),) * 2)
        for k in range(len(sizes)):
            for sign in (1.0, -1.0):
                moved = sizes.copy()
                moved[k] *= np.exp(sign * step)
                second[k] += sign * moved**2 * self.at(moved**2).slope / step
        return 0.5 * (second + second.T)

    def _search(self, sizes: Floats) -> tuple[Floats, Point]:
        """Minimise the cost by Newton's method over the sizes s, in which the cost is an even function, so that zero is
        no boundary.

        The Hessian is taken as 4 s s' times the information about the variances plus 2 |slope| on its diagonal. From
        far above the minimum, a step then halves a size approximately; from far below it doubles it.
        """
        point = self.at(sizes**2)
        for _ in range(_STEPS):
            slope = 2.0 * sizes * point.slope
            curve = 4.0 * np.outer(sizes, sizes) * point.information + np.diag(2.0 * np.abs(point.slope) + 1e-12)
            free = (sizes > _LEAST) | (slope < 0.0)
            step = np.zeros_like(sizes)
            step[free] = -np.linalg.solve(curve[np.ix_(free, free)], slope[free])
            enough = max(_ENOUGH, _ROUNDING * abs(point.cost))
            lower = self._lower(sizes, step, point) if -0.5 * slope @ step > enough else None
            if lower is None:
                break
            sizes, point = lower
        return np.where(sizes > _LEAST, sizes, 0.0), point

    def _lower(self, sizes: Floats, step: Floats, point: Point) -> tuple[Floats, Point] | None:
        """Return the sizes and the point after the step, halved until the cost is lower; None if it never is."""
        for _ in range(_HALVES):
            moved = np.maximum(sizes + step, _LEAST)
            there = self._level(moved**2)
            if there.cost < point.cost:
                return moved, self._with_derivatives(there)
            step = 0.5 * step
        return None
