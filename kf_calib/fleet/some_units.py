"""An effect that some units have and others do not: which, and what share of them.

A unit has the effect with a probability p, the share, of which nothing is known before. What the share is depends on
what is supposed of the coefficients of units that have it: many with a small effect look like few with a large one. So
there are several shapes of their distribution, each as likely as any other before the runs.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.evidence import log_mean
from kf_calib.fleet.own_coefficients import UnitInformation
from kf_calib.fleet.shape import POWERS, about_mean, about_zero
from kf_calib.support.logarithms import weights

_RULED_OUT = 0.025  # probability below which a shape is not asked for the share


class SomeUnits:
    """The likelihood of who has an effect, from what each unit tells of its coefficients beside all else."""

    def __init__(self, group: Group, information: UnitInformation, *, with_mean: bool = True) -> None:
        """with_mean: whether they may have a mean of their own; if not, that shape counts as impossible."""
        zero = {power: about_zero(group, information, power) for power in POWERS}
        self._clear = [shape for power, shape in zero.items() if power]
        self._shapes = [*zero.values(), *([about_mean(information)] if with_mean else [])]
        self._logs = np.array([shape.log_odds for shape in self._shapes]) - np.log(len(POWERS) + 1)

    @property
    def log_odds(self) -> float:
        """Log evidence that some units have it, each its own, against that none has it."""
        return float(np.logaddexp.reduce(self._logs))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it, in any direction and clearly not zero."""
        return float(log_mean(np.array([shape.log_odds_of_all for shape in self._clear])))

    @property
    def size(self) -> float:
        """The likeliest size of a coefficient of a unit that has it, in ``Group.sigma``."""
        return self._shapes[int(np.argmax(self._logs))].size

    @property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it, if some have it and others do not."""
        return weights(self._logs) @ np.array([shape.probabilities for shape in self._shapes])

    def share(self, all_have_it: float) -> tuple[float, tuple[float, float]]:
        """The share of these units that have it, with its 95 % interval.

        all_have_it: probability that all have it, rather than some.

        The interval reaches over those of all shapes that are not ruled out, and up to all units unless that is: how
        likely each was before the runs often decides which is the likelier, and so must not decide what the share is.
        """
        chances = (1.0 - all_have_it) * weights(self._logs)
        held = zip(self._shapes, chances.tolist(), strict=True)
        intervals = [shape.interval() for shape, chance in held if chance > _RULED_OUT]
        intervals += [(1.0, 1.0)] if all_have_it > _RULED_OUT else []
        low, high = min(low for low, _ in intervals), max(high for _, high in intervals)
        return all_have_it + (1.0 - all_have_it) * float(self.probabilities.mean()), (low, high)
