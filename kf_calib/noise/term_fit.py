"""Sizes of the noise terms of a channel with 95 % intervals, in two ways, from differences of block means.

- ``AllanFit``: generalised least squares of the logarithms of the overlapping Allan variances. With the effective
  degrees of freedom nu = 2 s^4 / var(s^2), ln s^2 has the mean ln sigma^2 + psi(nu / 2) - ln(nu / 2) and the variance
  psi'(nu / 2); correlations are those of ``power_laws.allan_covariance``.
- ``LikelihoodFit``: the likelihood of the readings as a Gaussian process, in an orthogonal transform in which the terms
  are nearly uncorrelated: Haar differences of blocks of all lengths, cosine transform of the longest blocks' means,

    -2 ln L = sum_k w_k (ln lambda_k + s_k / lambda_k),   lambda = columns . theta,

  with squares s_k of w_k degrees of freedom and their expectation lambda_k, linear in theta = (Q^2, N^2, B^2, K^2): a
  Whittle likelihood with exact expectations (A. Sykulski et al., 2019), of wavelets for short times (S. Guerrier et
  al., 2013).

Both are minimised over theta >= 0 by Fisher's scoring; an interval has its ends where the profile of the objective is
3.84 above its minimum. A term is seen where the minimum without it lies 5.41 higher (1 % point of half chi-squared); of
one that is not, an upper limit is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.support.searches import ENOUGH, MOST_HALVINGS, MOST_STEPS
from kf_calib.support.tail_probabilities import SIGMAS_95, VARIANCE_SEEN

_WIDTH = 2e-3  # relative, of an end


class Size(NamedTuple):
    """Size of a term, and its 95 % interval: value is None where it is not seen, low is then 0 and high a limit."""

    value: float | None
    low: float
    high: float


class Objective(Protocol):
    """-2 ln L but for a constant, at squares theta (4,): its value, gradient (4,) and expected curvature (4, 4)."""

    def __call__(self, squares: Floats) -> tuple[float, Floats, Floats]: ...
    def start(self) -> Floats:
        """Squares (4,) to begin with, all positive."""
        ...


@dataclass(frozen=True, eq=False)
class AllanFit:
    """columns (m, 4): Allan variance of each term of size 1. logs (m,): of the variances, free of bias. weight (m, m):
    inverse of their covariance."""

    columns: Floats
    logs: Floats
    weight: Floats

    @classmethod
    def of(cls, columns: Floats, variance: Floats, covariance: Floats, model: Floats) -> AllanFit:
        """From variances (m,); covariance (m, m): of these where their expectation is ``model`` (m,)."""
        from scipy.special import polygamma, psi

        sigma = np.sqrt(np.diag(covariance))
        half = (model / sigma) ** 2  # nu / 2
        logs = np.log(variance) - psi(half) + np.log(half)
        values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
        correlation = (vectors * np.maximum(values, 1e-3)) @ vectors.T  # far octaves are taken for uncorrelated
        spread = np.sqrt(polygamma(1, half))
        return cls(columns, logs, np.linalg.inv(correlation * np.outer(spread, spread)))

    def __call__(self, squares: Floats) -> tuple[float, Floats, Floats]:
        model = self.columns @ squares
        residual, slopes = np.log(model) - self.logs, self.columns / model[:, None]
        weighted = self.weight @ residual
        return float(residual @ weighted), 2.0 * slopes.T @ weighted, 2.0 * slopes.T @ self.weight @ slopes

    def start(self) -> Floats:
        return _least(self.columns, np.exp(self.logs))


@dataclass(frozen=True, eq=False)
class LikelihoodFit:
    """columns (k, 4): expectation of each square where a term is of size 1. squares (k,), and weights (k,): their
    degrees of freedom."""

    columns: Floats
    squares: Floats
    weights: Floats

    def __call__(self, squares: Floats) -> tuple[float, Floats, Floats]:
        model = self.columns @ squares
        ratio, slopes = self.squares / model, self.columns / model[:, None]
        value = float(self.weights @ (np.log(model) + ratio))
        return value, slopes.T @ (self.weights * (1.0 - ratio)), (slopes.T * self.weights) @ slopes

    def start(self) -> Floats:
        return _least(self.columns, self.squares)


def _least(columns: Floats, variances: Floats) -> Floats:
    """Squares of the terms of which each alone gives the least of the variances at most, and a share of it."""
    shares = variances[:, None] / np.maximum(columns, np.finfo(float).tiny)
    return 0.5 * np.maximum(shares.min(axis=0), 1e-12 * np.median(shares, axis=0)) + np.finfo(float).tiny


class Minimum(NamedTuple):
    """Where the objective is least, and its value there."""

    squares: Floats
    value: float


def minimum(objective: Objective, start: Floats, free: Mask | None = None) -> Minimum:
    """The least value over the free squares, which are not negative; the others stay as they are at the start.

    Each step is that of a quadratic objective within the same bounds, halved as long as the value does not fall.
    """
    from scipy.optimize import nnls

    squares = start.copy()
    places = np.flatnonzero(np.ones(len(start), bool) if free is None else free)
    value, gradient, curvature = objective(squares)
    for _ in range(MOST_STEPS):
        inner, scale = curvature[np.ix_(places, places)], 1.0 / np.sqrt(np.diag(curvature)[places])
        factor = np.linalg.cholesky(inner * np.outer(scale, scale) + 1e-10 * np.eye(len(places)))
        target = factor.T @ (squares[places] / scale) - np.linalg.solve(factor, gradient[places] * scale)
        step = nnls(factor.T, target)[0] * scale - squares[places]
        for halving in range(MOST_HALVINGS):
            trial = squares.copy()
            trial[places] = np.maximum(squares[places] + step * 0.5**halving, 0.0)
            if not trial.any():
                continue
            new = objective(trial)
            if new[0] <= value:
                break
        else:
            break
        fall, squares = value - new[0], trial
        value, gradient, curvature = new
        if fall < ENOUGH:
            break
    return Minimum(squares, value)


class TermSizes(NamedTuple):
    """The sizes of the terms, and the places of those that explain the data together and of which none can be left out.

    A place in ``needed`` whose size has no value can be left out where another one takes its part. squares (4,): of the
    terms that are needed, where these alone are fitted; 0 of the others.
    """

    sizes: list[Size]
    needed: list[int]
    squares: Floats


def sizes(objective: Objective, best: Minimum, inflation: float = 1.0) -> TermSizes:
    """The sizes of the terms (the roots of the squares) with their intervals.

    Values are those of the model that is left when terms that are not needed are taken out one by one. As a square
    cannot be negative, a term that is absent takes a part of its neighbours' in half of all data; so an interval
    reaches over both, that of the model with all terms and that of the terms that are needed.

    inflation: of all variances, where the model does not fit; the objective counts that much less.
    """
    count = len(best.squares)
    everything = _Profile(objective, best, np.ones(count, bool), inflation)
    needed = everything
    while True:
        rises = {term: needed.rise(term, 0.0) for term in np.flatnonzero(needed.free).tolist()}
        weakest = min(rises, key=lambda term: rises[term])
        if rises[weakest] > VARIANCE_SEEN or len(rises) == 1:
            break
        needed = needed.without(weakest)
    return TermSizes([_size(everything, needed, term) for term in range(count)], list(rises), needed.best.squares)


def _size(everything: _Profile, needed: _Profile, term: int) -> Size:
    low, high = everything.interval(term)
    if low == 0.0 or not needed.free[term]:
        return Size(None, 0.0, high)
    lower, higher = needed.interval(term)
    return Size(math.sqrt(needed.best.squares[term]), min(low, lower), max(high, higher))


@dataclass(frozen=True, eq=False)
class _Profile:
    """The objective over the squares of some terms (4,), and where it is least; the others are zero."""

    objective: Objective
    best: Minimum
    free: Mask
    inflation: float

    def without(self, term: int) -> _Profile:
        """The same with one term less."""
        free = self.free & (np.arange(len(self.free)) != term)
        return _Profile(self.objective, minimum(self.objective, self._start(term, 0.0), free), free, self.inflation)

    def rise(self, term: int, square: float) -> float:
        """By how much the objective is higher with this square of the term."""
        free = self.free & (np.arange(len(self.free)) != term)
        if not free.any():
            start = self._start(term, square)
            value = self.objective(start)[0] if square else math.inf
        else:
            value = minimum(self.objective, self._start(term, square), free).value
        return (value - self.best.value) / self.inflation

    def _start(self, term: int, square: float) -> Floats:
        """Squares to begin with: all that are free are positive."""
        start = np.where(self.free, np.maximum(self.best.squares, 1e-3 * self.objective.start()), 0.0)
        start[term] = square
        return start

    def interval(self, term: int) -> tuple[float, float]:
        """The ends of the interval of a size; the lower one is 0 where the term is not seen."""
        square = float(self.best.squares[term])
        scale = square if square > 0.0 else float(self.objective.start()[term])

        def above(trial: float) -> float:
            return self.rise(term, trial) - SIGMAS_95**2

        high = math.sqrt(_end(above, square, scale))
        if self.rise(term, 0.0) <= VARIANCE_SEEN:
            return 0.0, high
        return math.sqrt(_between(above, square, 0.0)), high


def _end(above: Callable[[float], float], square: float, scale: float) -> float:
    """The square above the estimate where a function that rises with it becomes positive."""
    inside, factor = square, 1e-4
    for _ in range(MOST_STEPS):
        outside = square + factor * scale
        if above(outside) >= 0.0:
            return _between(above, inside, outside)
        inside, factor = outside, 4.0 * factor
    return math.inf


def _between(above: Callable[[float], float], inside: float, outside: float) -> float:
    """The square where a function is zero, between one where it is negative and one where it is positive."""
    from scipy.optimize import brentq

    accuracy = _WIDTH * max(abs(outside - inside), np.finfo(float).tiny)
    root: Any = brentq(above, inside, outside, xtol=accuracy, maxiter=MOST_STEPS)
    return float(root)
