"""An effect that some units have and others do not: which, and what share of them.

A unit has the effect with a probability p, the share, of which nothing is known before. To have it means a size that is
clearly not zero. Either all units that have it have one size in units of their noise, with any direction; or the
coefficients c have a density in proportion to |c|^4 times a normal one, which vanishes at zero (a moment prior, V. E.
Johnson and D. Rossell, 2010). Both are as likely before, and the evidence is averaged over the size.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis import bayes_factor
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.evidence import log_evidence_of_modes, modes, sizes, weights
from kf_calib.fleet.population import Own

_SHARES = (np.arange(50) + 0.5) / 50.0
_SAME = sizes(1.0, 64.0, 1.2)  # sigma of one run: of units that have it alike, closely, as all of them tell it
_LEAST, _STEP = 0.5, np.sqrt(2.0)  # sigma of one run: the smallest normal size; ratio of a size to the one before
_SEEN = 1e-6  # of the largest information of a unit: what is less counts as not seen
_DRAWS = 4000
_TOGETHER = 64  # units at a time, to save memory
_LIKELY = 1e-4  # weights below this are left out of the draws


class SomeUnits:
    """The likelihood of who has an effect, from what each unit tells of its coefficients beside all else."""

    def __init__(self, group: Group, own: Own) -> None:
        apart = sizes(_LEAST, group.largest, _STEP)
        values, along, _ = modes(own.info, own.score)
        parts = [_of_one_size(values, along), _apart_from_zero(values, along, apart)]
        self._sizes, self._ratios = np.concatenate([_SAME, apart]), np.hstack(parts)  # (units, sizes), logs
        priors = np.concatenate([np.full(part.shape[1], 0.5 / part.shape[1]) for part in parts])
        self._shapes = np.log(priors)
        self._priors = np.log(priors / len(_SHARES))

    def _odds(self) -> Iterator[tuple[Floats, Floats]]:
        """Yield the log of the likelihood (units, shares, sizes) of a few units at a time, whether or not they have it,
        and of that part of it in which they have it."""
        for first in range(0, len(self._ratios), _TOGETHER):
            has = np.log(_SHARES)[:, None] + self._ratios[first : first + _TOGETHER, None, :]
            yield np.logaddexp(has, np.log1p(-_SHARES)[:, None]), has

    @cached_property
    def _logs(self) -> Floats:
        """The log of likelihood times prior (shares, sizes)."""
        return self._priors + sum(whole.sum(axis=0) for whole, _ in self._odds())

    @property
    def log_odds(self) -> float:
        """Log evidence that some units have it, each its own, against that none has it."""
        return float(np.logaddexp.reduce(self._logs, axis=None))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it."""
        return float(np.logaddexp.reduce(self._shapes + self._ratios.sum(axis=0)))

    @property
    def size(self) -> float:
        """The likeliest spread of the coefficients of a unit that has it, in ``Group.sigma``."""
        return float(self._sizes[np.unravel_index(np.argmax(self._logs), self._logs.shape)[1]])

    @cached_property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it, if some have it and others do not."""
        weight = weights(self._logs)
        return np.concatenate([np.sum(np.exp(has - whole) * weight, axis=(1, 2)) for whole, has in self._odds()])

    def share(self, all_have_it: float) -> tuple[float, tuple[float, float]]:
        """The share of these units that have it, with its 95 % interval, by draws of who has it.

        all_have_it: probability that all have it, rather than some.
        """
        rng, weight = np.random.default_rng(0), weights(self._logs).reshape(-1)
        kept = np.flatnonzero(weight > _LIKELY * weight.max())
        chosen = rng.choice(kept, _DRAWS, p=weight[kept] / weight[kept].sum())
        counts = np.zeros(_DRAWS)
        for whole, has in self._odds():
            chances = np.exp(has - whole).reshape(len(whole), -1)[:, chosen]
            counts += np.sum(rng.random(chances.shape) < chances, axis=0)
        counts[: round(all_have_it * _DRAWS)] = len(self._ratios)
        low, high = np.quantile(counts / len(self._ratios), [0.025, 0.975]).tolist()
        return float(counts.mean()) / len(self._ratios), (low, high)


def _apart_from_zero(values: Floats, along: Floats, tried: Floats) -> Floats:
    """Return the log of the likelihood ratio (n, t) of coefficients of a density |c|^4 N(c; 0, t^2) against none.

    It is that of normal ones times the mean of |c|^4 after the readings over that before them.
    """
    count = values.shape[1]
    spread = 1.0 / (tried[:, None] ** -2 + values[:, None])  # variances (n, t, q) after the readings
    mean = spread * along[:, None]
    squares = np.sum(mean**2 + spread, axis=2)
    fourth = squares**2 + np.sum(2.0 * spread**2 + 4.0 * spread * mean**2, axis=2)
    normal = log_evidence_of_modes(values[:, None], along[:, None], tried)
    return normal + np.log(fourth / (count * (count + 2) * tried**4))


def _of_one_size(values: Floats, along: Floats) -> Floats:
    """Return the log of the likelihood ratio (n, sizes) of coefficients of one size in units of the noise against none,
    averaged over their directions."""
    seen = values > _SEEN * values.max(axis=1, keepdims=True)
    squares = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
    dofs, out = seen.sum(axis=1), np.zeros((len(values), len(_SAME)))
    for dof in np.unique(dofs[dofs > 0]).tolist():
        alike = dofs == dof
        for k, size in enumerate(_SAME * np.sqrt(dof)):
            out[alike, k] = bayes_factor.log_odds(dof, squares[alike], float(size))
    return out
