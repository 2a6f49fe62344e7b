"""How small an effect would be found, from the columns alone."""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.diagnosis.candidate_tests import LEVEL, SHARE, CandidateTests
from kf_calib.estimation.observability import smallest_size


@dataclass(frozen=True)
class Detectable:
    """The size of one coefficient at which an effect is found in 90 of 100 runs, the largest over its coefficients."""

    name: str
    minimum: float
    unit: str
    shown_minimum: float
    shown_unit: str


def detectable(test: CandidateTests) -> list[Detectable]:
    """Of every visible effect, from the columns alone."""
    out = list[Detectable]()
    for name, k in test.best.items():
        candidate = test.scan.candidates[k]
        found = None if name in test.invisible else smallest_size(candidate, SHARE * LEVEL / test.effective_tests)
        if found is not None:
            own, minimum = found
            out.append(Detectable(name, minimum, own.unit, minimum * own.per_si, own.shown_unit))
    return out
