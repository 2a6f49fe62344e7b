"""A check of the budget by drawing its input quantities (JCGM 101, clause 8): expanded uncertainties without the
assumptions that the sum is normal and that degrees of freedom combine by Welch and Satterthwaite."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.certificate.budget import COVERAGE, Budget, Contribution
from kf_calib.certificate.statement import DIVISORS

_BLOCK = 20_000  # draws at once
_SEED = 101


@dataclass(frozen=True)
class MonteCarloCheck:
    """expanded (12,): half of the shortest symmetric interval that holds ``COVERAGE`` of the draws. agrees: of each of
    the twelve, whether both expanded uncertainties are the same to half of the second digit of the standard one."""

    draws: int
    expanded: Floats
    agrees: tuple[bool, ...]


def monte_carlo(budget: Budget, draws: int) -> MonteCarloCheck:
    """Draw all input quantities that many times, each from its own distribution."""
    rng, parts = np.random.default_rng(_SEED), list[Floats]()
    for first in range(0, draws, _BLOCK):
        count = min(_BLOCK, draws - first)
        parts.append(sum((_drawn(line, rng, count) for line in budget.contributions), np.zeros((count, 12))))
    expanded = np.quantile(np.abs(np.concatenate(parts)), COVERAGE, axis=0)
    tolerance = [0.5 * 10.0 ** (math.floor(math.log10(u)) - 1) if u > 0.0 else 0.0 for u in budget.combined.tolist()]
    apart = np.abs(expanded - budget.expanded).tolist()
    return MonteCarloCheck(draws, expanded, tuple(d <= t for d, t in zip(apart, tolerance, strict=True)))


def _drawn(line: Contribution, rng: np.random.Generator, count: int) -> Floats:
    """Return what a line of the budget adds to the twelve, (count, 12)."""
    scales = np.ones((count, 1))  # by which draws of a normal distribution become Student's (JCGM 101, 6.4.9)
    if not math.isinf(line.dof):
        scales = np.sqrt(line.dof / rng.chisquare(line.dof, count))[:, None]
    if line.changes is None:  # of the filter: one size of all noise that was estimated
        values, vectors = np.linalg.eigh(line.covariance)
        return (rng.standard_normal((count, len(values))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T) * scales
    assert line.standard is not None
    inputs = line.standard * _standardised(line.distribution, rng, (count, line.changes.shape[1]))
    return (inputs * scales) @ line.changes.T


def _standardised(distribution: str, rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Return draws with mean 0 and standard deviation 1."""
    if distribution not in DIVISORS:
        return rng.standard_normal(shape)
    of_half_width_1 = {
        "rectangular": lambda: rng.uniform(-1.0, 1.0, shape),
        "triangular": lambda: rng.triangular(-1.0, 0.0, 1.0, shape),
        "arcsine": lambda: np.sin(2.0 * math.pi * rng.uniform(size=shape)),
    }
    return DIVISORS[distribution] * of_half_width_1[distribution]()
