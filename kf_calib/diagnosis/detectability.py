"""The smallest size at which each effect would be found, computed from the columns alone."""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.diagnosis.candidate_tests import LEVEL, SHARE, CandidateTests
from kf_calib.effects import Coefficient
from kf_calib.estimation.observability import smallest_size


@dataclass(frozen=True)
class Detectable:
    """The size of a coefficient at which an effect is found in 90 of 100 runs; of several, that of the least visible.

    name: of the effect. minimum: the size in SI. coefficient: which of them it is the size of.
    """

    name: str
    minimum: float
    coefficient: Coefficient

    @property
    def unit(self) -> str:
        """The SI unit of the coefficient."""
        return self.coefficient.unit


def detectable(test: CandidateTests) -> list[Detectable]:
    """The smallest detectable size of every visible effect, from its columns and not from the readings."""
    out = list[Detectable]()
    for name, k in test.best.items():
        candidate = test.scan.candidates[k]
        found = None if name in test.invisible else smallest_size(candidate, SHARE * LEVEL / test.effective_tests)
        if found is not None:
            coefficient, minimum = found
            out.append(Detectable(name, minimum, coefficient))
    return out
