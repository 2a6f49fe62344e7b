"""The smallest size at which each effect would be found, computed from the columns alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.diagnosis.candidate_tests import LEVEL, SHARE, CandidateTests

_POWER = 0.9


@dataclass(frozen=True)
class Detectable:
    """The size of a coefficient at which an effect is found in 90 of 100 runs; of several, that of the least visible.

    name: of the effect. minimum, unit: the size in SI. shown_minimum, shown_unit: the same in the unit of the field.
    """

    name: str
    minimum: float
    unit: str
    shown_minimum: float
    shown_unit: str


def detectable(test: CandidateTests) -> list[Detectable]:
    """The smallest detectable size of every visible effect, from its columns and not from the readings.

    The size is that at which a noncentral chi-squared exceeds the threshold of the scan with a probability of 0.9.
    """
    from scipy.special import chdtri, chndtrinc

    out = list[Detectable]()
    for name, k in test.best.items():
        candidate = test.scan.candidates[k]
        if not candidate.dof or name in test.invisible:
            continue
        least = float(chdtri(candidate.dof, SHARE * LEVEL / test.effective_tests))
        needed = float(np.sqrt(chndtrinc(least, candidate.dof, 1.0 - _POWER)))
        sizes = np.linalg.norm(candidate.columns, axis=0)
        seen = ~candidate.hidden & (sizes > 0)
        if not seen.any():
            continue
        worst = int(np.argmax(np.where(seen, needed / np.where(seen, sizes, 1.0), 0.0)))
        minimum, own = needed / float(sizes[worst]), candidate.effect.coefficients[worst]
        out.append(Detectable(name, minimum, own.unit, minimum * own.per_si, own.shown_unit))
    return out
