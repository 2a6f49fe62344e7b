"""An effect that some units have and others do not: which, and what share of them.

A unit has the effect with a probability p, the share, of which nothing is known before. The size of the effect in a
unit that has it is either normal about zero, or the same in all of these in units of their noise with any direction;
both are as likely before, and the evidence is averaged over the size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis import bayes_factor
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.evidence import log_evidence_of_modes, log_mean, modes, sizes, weights
from kf_calib.fleet.population import Own

_SHARES = (np.arange(50) + 0.5) / 50.0
_LEAST = 1.0  # sigma of one run: the smallest size that is expected
_SEEN = 1e-6  # of the largest information of a unit: what is less counts as not seen
_DRAWS = 4000
_LIKELY = 1e-4  # weights below this are left out of the draws


@dataclass(frozen=True)
class Members:
    """Which units have an effect.

    - log_odds: log evidence that some have it, each its own, against that none has it.
    - probabilities (n,): that each unit has it. share: their share, with its 95 % interval, among these units.
    - size: likeliest spread of the coefficients of a unit that has it, in ``Group.sigma``.
    """

    log_odds: float
    probabilities: Floats
    share: float
    interval: tuple[float, float]
    size: float


def members(group: Group, own: Own) -> Members:
    """Which units have the effect, from what each tells of its coefficients beside all else."""
    tried = sizes(_LEAST, group.largest)
    values, along, _ = modes(own.info, own.score)
    ratios = np.stack([_normal(values, along, tried), _of_one_size(values, along, tried)], axis=1)  # (n, 2, t)
    with np.errstate(over="ignore"):
        odds = np.logaddexp(np.log(_SHARES)[:, None] + ratios[:, :, None, :], np.log1p(-_SHARES)[:, None])
    logs = odds.sum(axis=0)  # (2, shares, t)
    weight = weights(logs)
    each = np.exp(np.log(_SHARES)[:, None] + ratios[:, :, None, :] - odds)  # (n, 2, shares, t)
    probabilities = np.sum(each * weight, axis=(1, 2, 3))
    size = float(tried[np.unravel_index(np.argmax(logs), logs.shape)[2]])
    share, interval = _share(each.reshape(len(each), -1), weight.reshape(-1))
    return Members(float(log_mean(logs)), probabilities, share, interval, size)


def _normal(values: Floats, along: Floats, tried: Floats) -> Floats:
    """Return the log of the likelihood ratio (n, t) of normal coefficients of each size against none."""
    return log_evidence_of_modes(values[:, None], along[:, None], tried)


def _of_one_size(values: Floats, along: Floats, tried: Floats) -> Floats:
    """Return the same for coefficients of one size in units of the noise, averaged over their directions."""
    seen = values > _SEEN * values.max(axis=1, keepdims=True)
    squares = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
    dofs, out = seen.sum(axis=1), np.zeros((len(values), len(tried)))
    for dof in np.unique(dofs[dofs > 0]).tolist():
        alike = dofs == dof
        for k, size in enumerate(tried * np.sqrt(dof)):
            out[alike, k] = bayes_factor.log_odds(dof, squares[alike], float(size))
    return out


def _share(each: Floats, weight: Floats) -> tuple[float, tuple[float, float]]:
    """Return the mean share of the units that have it, and its 95 % interval, by draws of who has it.

    each (n, h): probability of each unit under each hypothesis. weight (h,): of the hypotheses.
    """
    rng = np.random.default_rng(0)
    kept = np.flatnonzero(weight > _LIKELY * weight.max())
    chosen = rng.choice(kept, _DRAWS, p=weight[kept] / weight[kept].sum())
    shares = np.mean(rng.random((len(each), _DRAWS)) < each[:, chosen], axis=0)
    low, high = np.quantile(shares, [0.025, 0.975]).tolist()
    return float(shares.mean()), (low, high)
