"""An effect that some units have and others do not: which, and what share of them.

A unit has the effect with a probability p, the share, of which nothing is known before. The size of the effect in a
unit that has it is either normal about zero, or the same in all of these in units of their noise with any direction;
both are as likely before, and the evidence is averaged over the size.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis import bayes_factor
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.evidence import log_evidence_of_modes, log_mean, modes, sizes, weights
from kf_calib.fleet.population import Own

_SHARES = (np.arange(50) + 0.5) / 50.0
_LEAST = 1.0  # sigma of one run: the smallest size that is expected
_ONE_SIZE = sizes(_LEAST, 20.0, 1.2)  # of all units alike, closely since the units together tell it well
_SEEN = 1e-6  # of the largest information of a unit: what is less counts as not seen
_DRAWS = 4000
_LIKELY = 1e-4  # weights below this are left out of the draws


class SomeUnits:
    """The likelihood of who has an effect, from what each unit tells of its coefficients beside all else."""

    def __init__(self, group: Group, own: Own) -> None:
        normal = sizes(_LEAST, group.largest)
        values, along, _ = modes(own.info, own.score)
        self._sizes = np.concatenate([normal, _ONE_SIZE])
        self._alike = len(normal)
        self._ratios = np.hstack([_normal(values, along, normal), _of_one_size(values, along)])  # (units, sizes), logs
        priors = np.repeat([0.5 / len(normal), 0.5 / len(_ONE_SIZE)], [len(normal), len(_ONE_SIZE)])
        self._priors = np.log(priors / len(_SHARES))
        self._odds = np.logaddexp(
            np.log(_SHARES)[:, None] + self._ratios[:, None, :], np.log1p(-_SHARES)[:, None]
        )  # (units, shares, sizes)

    @cached_property
    def _logs(self) -> Floats:
        """The log of likelihood times prior (shares, sizes)."""
        return self._odds.sum(axis=0) + self._priors

    @property
    def log_odds(self) -> float:
        """Log evidence that some units have it, each its own, against that none has it."""
        return float(np.logaddexp.reduce(self._logs, axis=None))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it, of one size and each with a direction of its own."""
        return float(log_mean(self._ratios[:, self._alike :].sum(axis=0)))

    @property
    def size(self) -> float:
        """The likeliest spread of the coefficients of a unit that has it, in ``Group.sigma``."""
        return float(self._sizes[np.unravel_index(np.argmax(self._logs), self._logs.shape)[1]])

    @cached_property
    def _each(self) -> Floats:
        """The probability that a unit has it under each hypothesis (units, hypotheses)."""
        found = np.exp(np.log(_SHARES)[:, None] + self._ratios[:, None, :] - self._odds)
        return found.reshape(len(found), -1)

    @cached_property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it, if some have it and others do not."""
        return self._each @ weights(self._logs).reshape(-1)

    def share(self, all_have_it: float) -> tuple[float, tuple[float, float]]:
        """The share of these units that have it, with its 95 % interval, by draws of who has it.

        all_have_it: probability that all have it, rather than some.
        """
        rng, weight = np.random.default_rng(0), weights(self._logs).reshape(-1)
        kept = np.flatnonzero(weight > _LIKELY * weight.max())
        chosen = rng.choice(kept, _DRAWS, p=weight[kept] / weight[kept].sum())
        shares = np.mean(rng.random((len(self._each), _DRAWS)) < self._each[:, chosen], axis=0)
        shares[: round(all_have_it * _DRAWS)] = 1.0
        low, high = np.quantile(shares, [0.025, 0.975]).tolist()
        return float(shares.mean()), (low, high)


def _normal(values: Floats, along: Floats, tried: Floats) -> Floats:
    """Return the log of the likelihood ratio (n, t) of normal coefficients of each size against none."""
    return log_evidence_of_modes(values[:, None], along[:, None], tried)


def _of_one_size(values: Floats, along: Floats) -> Floats:
    """Return the same for coefficients of one size in units of the noise, averaged over their directions."""
    seen = values > _SEEN * values.max(axis=1, keepdims=True)
    squares = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
    dofs, out = seen.sum(axis=1), np.zeros((len(values), len(_ONE_SIZE)))
    for dof in np.unique(dofs[dofs > 0]).tolist():
        alike = dofs == dof
        for k, size in enumerate(_ONE_SIZE * np.sqrt(dof)):
            out[alike, k] = bayes_factor.log_odds(dof, squares[alike], float(size))
    return out
