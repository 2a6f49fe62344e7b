"""The restricted likelihood of the variances in correlated means, and its maximum.

The means are z = A x + e, where e has the covariance V = V_0 + sum v_k K_k. With the coefficients x integrated out
(Patterson and Thompson, 1971), the log-likelihood of the variances v_k is, up to a constant,

  l = -1/2 (log|V| + log|A' V^-1 A| + z' P z),  P = V^-1 - V^-1 A (A' V^-1 A)^-1 A' V^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import AT_ONCE, LAST_DIGITS, Floats
from kf_calib.dwells.qr import square_triangle, triangle
from kf_calib.noise import banded
from kf_calib.noise.noise_model import lift_rounding
from kf_calib.support.searches import ENOUGH, MOST_HALVINGS, MOST_STEPS

_LEAST = 1e-4  # relative to the size at which a search begins; smaller sizes count as zero
_NEAR = 0.5  # if ln of a size changes by more, the search did not begin near its end


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
    - upper (p + 1, p + 1): the triangular factor of the whitened rows [A | z] and of the prior.
    - whitened: the means of all parts.
    """

    cost: float
    misfit: float
    upper: Floats
    whitened: list[_Whitened]


@dataclass(frozen=True)
class _Whitened:
    """Some of the means: their covariance V and its root, both in the layouts of ``banded``, and their rows (3 d, p +
    1) divided by the root."""

    covariance: Floats
    lower: Floats
    rows: Floats


@dataclass(frozen=True)
class Restricted:
    """The restricted likelihood as a function of the variances.

    - rows (3 D, p + 1): [A | z].
    - prior (q, p + 1): whitened rows of prior knowledge of x.
    - fixed (D, 6, 3), shapes: V_0 and some of the K_k (k, D, 6, 3) each, in the layout of ``banded``; (D, 3, 3) and
      (k, D, 3, 3) where no means are correlated, (k, 1, 3, 3) where they are the same for all.
    """

    rows: Floats
    prior: Floats
    fixed: Floats
    shapes: tuple[Floats, ...]

    @property
    def count(self) -> int:
        """Number of the variances."""
        return sum(map(len, self.shapes))

    def at(self, variances: Floats) -> Point:
        """The likelihood and its derivatives at ``variances`` (k,)."""
        return self._with_derivatives(self._level(variances))

    def cost(self, variances: Floats) -> float:
        """Minus the log-likelihood at ``variances`` (k,)."""
        return self._level(variances).cost

    @cached_property
    def _parts(self) -> list[slice]:
        """The means that are worked on together: all where they are correlated, else as many as stay in the cache."""
        count = len(self.fixed)
        size = AT_ONCE if self.fixed.shape[1] == 3 else count
        return [slice(k, min(k + size, count)) for k in range(0, count, size)]

    def _shapes_of(self, part: slice) -> Floats:
        """Return the K_k of a part of the means, (k, d, 6, 3) or (k, d, 3, 3)."""
        alike = self.fixed[part].shape
        shapes = [np.broadcast_to(own[:, part] if own.shape[1] > 1 else own, (len(own), *alike)) for own in self.shapes]
        return np.concatenate([np.zeros((0, *alike)), *shapes])

    def _whitened(self, variances: Floats, part: slice) -> _Whitened:
        """Return the means of a part, whitened at ``variances`` (k,)."""
        fixed = self.fixed[part]
        covariance = fixed + (variances @ self._shapes_of(part).reshape(len(variances), fixed.size)).reshape(
            fixed.shape
        )
        covariance[:, :3] = lift_rounding(covariance[:, :3])
        lower = banded.root(covariance)
        return _Whitened(covariance, lower, banded.solve(lower, self.rows[3 * part.start : 3 * part.stop]))

    def _level(self, variances: Floats) -> _Level:
        """Return the likelihood at ``variances`` (k,), without its derivatives, which take more time."""
        whitened = [self._whitened(variances, part) for part in self._parts]
        upper = square_triangle(np.concatenate([self.prior, *(triangle(part.rows) for part in whitened)]))
        determinant = sum(float(np.log(banded.diagonal(part.lower)).sum()) for part in whitened)
        misfit = float(upper[-1, -1] ** 2)
        cost = determinant + float(np.log(np.abs(np.diag(upper)[:-1])).sum()) + 0.5 * misfit
        return _Level(cost, misfit, upper, whitened)

    def _with_derivatives(self, level: _Level) -> Point:
        """Return the likelihood with its derivatives.

        With y = P z, the derivatives of the cost are (tr(P K_k) - y' K_k y) / 2 (Searle, Casella and McCulloch, 1992,
        sec. 6.6), and y' K_k P K_l y / 2 is the average of observed and expected information (Gilmour, Thompson and
        Cullis, 1995).
        """
        count, width = self.count, len(level.upper) - 1
        slope, squares, within = np.zeros(count), np.zeros((count, count)), np.zeros((width, count))
        inverse, along = np.linalg.inv(level.upper[:-1, :-1]), level.upper[:-1, -1]
        for part, whitened in zip(self._parts, level.whitened, strict=True) if count else ():
            lower, shapes, basis = whitened.lower, self._shapes_of(part), whitened.rows[:, :-1] @ inverse
            rest = whitened.rows[:, -1] - basis @ along
            back = banded.solve(lower, np.column_stack([basis, rest]), transposed=True)
            inner = banded.inverse(whitened.covariance, lower) - banded.outer(back, whitened.covariance.shape[1])
            moved = banded.solve(lower, banded.products(shapes, back[:, -1]))
            slope += 0.5 * banded.traces(inner, shapes)
            squares += moved.T @ moved
            within += basis.T @ moved
        return Point(level.cost, level.misfit, slope, 0.5 * (squares - within.T @ within))

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
        return self._search(np.ones(self.count))

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
        for _ in range(MOST_STEPS):
            slope = 2.0 * sizes * point.slope
            curve = 4.0 * np.outer(sizes, sizes) * point.information + np.diag(2.0 * np.abs(point.slope) + 1e-12)
            free = (sizes > _LEAST) | (slope < 0.0)
            step = np.zeros_like(sizes)
            step[free] = -np.linalg.solve(curve[np.ix_(free, free)], slope[free])
            enough = max(ENOUGH, LAST_DIGITS * abs(point.cost))  # for thousands of dwells the cost is no more exact
            lower = self._lower(sizes, step, point) if -0.5 * slope @ step > enough else None
            if lower is None:
                break
            sizes, point = lower
        return np.where(sizes > _LEAST, sizes, 0.0), point

    def _lower(self, sizes: Floats, step: Floats, point: Point) -> tuple[Floats, Point] | None:
        """Return the sizes and the point after the step, halved until the cost is lower; None if it never is."""
        for _ in range(MOST_HALVINGS):
            moved = np.maximum(sizes + step, _LEAST)
            there = self._level(moved**2)
            if there.cost < point.cost:
                return moved, self._with_derivatives(there)
            step = 0.5 * step
        return None
