"""Functions of two quantities at once, as temperature times force: a sparse basis for each pair of drivers.

The evidence of a pair of drivers is the mean over all its subsets of one or two terms, as of a prior by which few terms
of the basis are there (spike and slab). So its price is that of what it needs, and not that of the whole basis.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from kf_calib.estimation.score_test import Scan

_FORCES = ("a", "p", "o", "a*a", "p*p", "a*p", "a*o", "p*o")
_LINEAR = _FORCES[:3]


def bases(gimbals: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the pairs of drivers in words, each with the terms of its basis.

    gimbals: number of gimbal axes.
    """
    for words, symbol in (("temperature", "T"), ("time", "t")):
        terms = [f"{symbol}*{force}" for force in _FORCES]
        yield f"{words} and specific force", [*terms, *(f"{symbol}*{symbol}*{force}" for force in _LINEAR)]
    for k in range(1, gimbals + 1):
        waves = [f"{wave}({times}q{k})" for times in ("", "2*") for wave in ("sin", "cos")]
        yield f"angle of gimbal {k} and specific force", [f"{wave}*{force}" for wave in waves for force in _LINEAR]
        yield f"angle of gimbal {k} and temperature", [f"{wave}*T" for wave in waves[:2]]
    steps = [f"{step}*{force}" for step in ("da", "abs(da)") for force in _LINEAR]
    yield "previous orientation and specific force", steps


def subsets(scan: Scan) -> Iterator[tuple[tuple[int, ...], float, int]]:
    """Yield all subsets of one or two candidates of a scan, with their falls of chi-squared and ranks."""
    alone = scan.statistics
    for k, candidate in enumerate(scan.candidates):
        yield (k,), float(alone[k]), candidate.dof
    for k, other in itertools.combinations(range(len(scan.candidates)), 2):
        if scan.candidates[k].dof and scan.candidates[other].dof:
            basis = np.concatenate([scan.candidates[k].basis, scan.candidates[other].basis], axis=1)
            yield (k, other), *scan.explained(basis)
