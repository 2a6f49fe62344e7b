"""Optimality criteria for sets of orientations, as functions of the information factor; smaller is better.

An ``Aim`` is a function of the factor R (p, p), where R^T R is the information about the states. Anything that can be
computed from R may be an aim, such as the sigmas of the twelve parameters or the separation of two effects. The factors
are those of a ``PredictedInformation``, of parameters in its units (rad, 1, g; effects: their scale).

  D          log of the geometric mean of the principal sigmas: the generalised variance
  A          log of the rms of all sigmas
  E          log of the largest principal sigma, of any combination of the parameters
  minimax    log of the largest sigma of a parameter, relative to what is tolerated
  condition  log of the condition number of R
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask

_TINY = 1e-12
_SOFT = (16.0, 400.0)


Score = Callable[[Floats, float], Floats]


@dataclass(frozen=True)
class Aim:
    """A criterion ``cost(factors (..., p, p), power) -> (...)``, which is the logarithm of the quantity that it
    measures.

    If the cost has kinks, the optimisation uses power means with the exponents ``powers`` in turn; infinity stands for
    the cost itself. ``tolerated`` (12,) are the sigmas that are asked for, in the units of the factors, infinity where
    none is; None if the aim is not about any.
    """

    name: str
    measures: str
    cost: Score
    powers: tuple[float, ...] = (math.inf,)
    tolerated: Floats | None = field(default=None, compare=False)

    def __call__(self, factors: Floats, power: float = math.inf) -> Floats:
        return self.cost(factors, power)


def _geometric(factors: Floats, power: float) -> Floats:
    """Return the log of the geometric mean of the principal sigmas."""
    return -np.log(np.abs(np.einsum("...ii->...i", regular(factors)))).mean(axis=-1)


def _root_mean_square(factors: Floats, power: float) -> Floats:
    """Return the log of the rms of all sigmas."""
    return 0.5 * np.log((sigmas(factors) ** 2).mean(axis=-1))


def _principal(factors: Floats, power: float) -> Floats:
    """Return the log of the largest principal sigma."""
    return _largest(-np.log(_singular(factors)), power)


def _condition(factors: Floats, power: float) -> Floats:
    """Return the log of the condition number."""
    logs = np.log(_singular(factors))
    return _largest(logs, power) + _largest(-logs, power)


D = Aim("D", "geometric mean of the principal sigmas", _geometric)
A = Aim("A", "rms of all sigmas", _root_mean_square)
E = Aim("E", "largest principal sigma", _principal, _SOFT)
CONDITION = Aim("condition", "condition number", _condition, _SOFT)


def minimax(tolerated: Floats) -> Aim:
    """The aim to minimise the largest sigma relative to ``tolerated`` (p,), in the units of the factors; infinity
    tolerates any."""
    asked = np.isfinite(tolerated)

    def cost(factors: Floats, power: float) -> Floats:
        count = len(asked)
        return _largest(np.log(sigmas(factors)[..., :count][..., asked] / tolerated[asked]), power)

    return Aim("minimax", "largest sigma relative to what is tolerated", cost, _SOFT, tolerated)


LARGEST = replace(minimax(np.ones(12)), tolerated=None)
NAMED: dict[str, Aim] = {aim.name: aim for aim in (D, A, E, LARGEST, CONDITION)}


def _largest(logs: Floats, power: float) -> Floats:
    """Return the largest of logarithms (..., n), or for finite ``power`` the logarithm of their power mean, which is
    smooth."""
    top = logs.max(axis=-1)
    if not math.isfinite(power):
        return top
    return top + np.log(np.exp(power * (logs - top[..., None])).mean(axis=-1)) / power


def regular(factors: Floats) -> Floats:
    """Triangular factors without zeros on the diagonal; states that are not determined get large but finite sigmas."""
    size = np.abs(factors).max(axis=(-2, -1))[..., None, None]
    floor = _TINY * np.where(size > 0, size, 1.0)
    diagonal = np.abs(factors) < floor
    return np.where(diagonal & np.eye(factors.shape[-1], dtype=bool), floor, factors)


def _singular(factors: Floats) -> Floats:
    """Return the singular values, none of which is zero."""
    values = np.linalg.svd(factors, compute_uv=False)
    return np.maximum(values, _TINY * np.maximum(values[..., :1], 1e-300))


def sigmas(factors: Floats) -> Floats:
    """Sigmas (..., p) of the states of factors (..., p, p)."""
    return np.linalg.norm(np.linalg.inv(regular(factors)), axis=-1)


def is_unseen(factor: Floats) -> Mask:
    """Mask (p,) of the states that a factor does not determine."""
    _, singular, right = np.linalg.svd(factor)
    lost = right[singular <= 1e-9 * max(float(singular[0]), 1e-300)]
    return np.asarray((np.abs(lost) > 1e-6).any(axis=0))


def slope(aim: Score, factor: Floats, power: float) -> Floats:
    """The gradient G (p, p) of an aim, symmetric: if the information becomes R^T (1 + B) R, the aim changes by tr(G B).

    It is computed by central differences R (1 +- h N) with upper triangular N. These are relative to R itself and so
    remain accurate however weakly parameters are determined.
    """
    count, h = len(factor), 1e-5
    rows, columns = np.triu_indices(count)
    changes = np.zeros((len(rows), count, count))
    changes[np.arange(len(rows)), rows] = h * factor[columns]
    up, down = aim(factor + changes, power), aim(factor - changes, power)
    gradient = np.zeros((count, count))
    gradient[rows, columns] = (up - down) / (4.0 * h)
    return gradient + np.triu(gradient, 1).T


def tolerated(wanted: Mapping[str, float], gravity_mps2: float) -> Floats:
    """Tolerated sigma of each parameter (12,) in rad, 1 and g, from sigmas in SI by symbol; infinity for the others."""
    sigma = np.array([wanted.get(symbol, math.inf) for symbol in paper_parameters.SYMBOLS])
    sigma[paper_parameters.BIASES] /= gravity_mps2
    return sigma
