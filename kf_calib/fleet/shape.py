"""What may be supposed of the coefficients of units that have an effect, where others do not have it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.support.logarithms import weights

SHARES = (np.arange(50) + 0.5) / 50.0
"""Probabilities that a unit has the effect: before the runs, each is as likely as any other."""

_TOGETHER = 64  # units at a time, to save memory
_DRAWS = 4000


@dataclass(frozen=True)
class Shape:
    """One supposition, for each share of a grid and each size of another.

    - units: their number. ratios: of a few of them, the log of the likelihood of each with the effect against that
      without, (units, shares or 1, sizes), to be computed when it is needed, to save memory.
    - log_prior (shares, sizes): of the suppositions before the runs; they sum to 1.
    - sizes (shares or 1, sizes): of a coefficient of a unit that has it, in ``Group.sigma``.
    """

    units: int
    ratios: Callable[[slice], Floats]
    log_prior: Floats
    sizes: Floats

    def _parts(self) -> Iterator[Floats]:
        """Yield the ratios of a few units at a time."""
        return (self.ratios(slice(first, first + _TOGETHER)) for first in range(0, self.units, _TOGETHER))

    def _odds(self) -> Iterator[tuple[Floats, Floats]]:
        """Yield the log of the likelihood (units, shares, sizes) of a few units at a time, whether or not they have it,
        and of that part of it in which they have it."""
        for part in self._parts():
            has = np.log(SHARES)[:, None] + part
            yield np.logaddexp(has, np.log1p(-SHARES)[:, None]), has

    @cached_property
    def _logs(self) -> Floats:
        """The log of likelihood times prior (shares, sizes)."""
        return self.log_prior + sum(whole.sum(axis=0) for whole, _ in self._odds())

    @cached_property
    def log_odds(self) -> float:
        """Log evidence that some units have the effect in this way, against that none has it."""
        return float(np.logaddexp.reduce(self._logs, axis=None))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it."""
        logs = self.log_prior + sum(part.sum(axis=0) for part in self._parts())
        return float(np.logaddexp.reduce(logs, axis=None))

    @property
    def size(self) -> float:
        """The likeliest size of a coefficient of a unit that has it."""
        return float(np.broadcast_to(self.sizes, self._logs.shape).flat[np.argmax(self._logs)])

    @cached_property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it."""
        weight = weights(self._logs)
        return np.concatenate([np.sum(np.exp(has - whole) * weight, axis=(1, 2)) for whole, has in self._odds()])

    def interval(self) -> tuple[float, float]:
        """The share of these units that have it with 95 % probability, by draws of who has it."""
        rng, counts = np.random.default_rng(0), np.zeros(_DRAWS)
        chosen = rng.choice(self._logs.size, _DRAWS, p=weights(self._logs).reshape(-1))
        for whole, has in self._odds():
            chances = np.exp(has - whole).reshape(len(whole), -1)[:, chosen]
            counts += np.sum(rng.random(chances.shape) < chances, axis=0)
        low, high = np.quantile(counts / self.units, [0.025, 0.975], method="inverted_cdf").tolist()
        return low, high
