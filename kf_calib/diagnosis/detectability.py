"""How small an effect would be found, from the columns alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.diagnosis.candidate_tests import LEVEL, SHARE, CandidateTests

_POWER = 0.9


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
