"""Columns of known effects in a recording, beside what the twelve parameters absorb."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.linalg import subspace_angles

from kf_calib.bench.arrays import Floats
from kf_calib.bench.keys import BenchKeys
from kf_calib.diagnosis.candidate_tests import GRID, slow_hz
from kf_calib.effects import Effect, effect_named, names
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.candidate_scan import Candidate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan
from kf_calib.sources.files.recording import Recording

_SAME_RAD = 1.4e-3  # two directions closer than this count as equal


def scan_columns(
    path: Path,
    wanted: Sequence[str] | None = None,
    white_mps2: float | None = None,
    slow_lines: bool = False,
    exact_poses: bool = False,
) -> tuple[dict[str, list[Candidate]], Floats]:
    """Return the candidates by name, and the residual in the same orthonormal frame.

    path: of the recording. wanted: names of effects (None: all that have columns, oscillations excepted). white_mps2:
    sigma of the white noise to assume in place of the estimated one. slow_lines: take an oscillation at the frequencies
    at which the program looks for slow ones, not at those of a grid. exact_poses: take the poses as they are stated, as
    what is equal in these differs by the setting errors of a run otherwise.
    """
    keys: BenchKeys = {"angle_sigma_deg": 0.0} if exact_poses else {}
    result = calibrate(Recording(path, keys))
    noise = result.noise.for_goodness_of_fit
    if white_mps2 is not None:
        noise = dataclasses.replace(noise, sigma_mps2=np.full(3, white_mps2), inflation=np.ones(3))
    found = scan(result.fit.linearised, noise, column_effects(result, wanted, slow_lines))
    return group_by_name(found.candidates), found.residual


def candidates(path: Path, wanted: Sequence[str] | None = None) -> dict[str, list[Candidate]]:
    """Return the columns of effects in a recording, by name, without what the twelve parameters absorb."""
    return scan_columns(path, wanted, exact_poses=True)[0]


def column_effects(result: Calibration, wanted: Sequence[str] | None = None, slow_lines: bool = False) -> list[Effect]:
    """Return the known effects that are linear columns; one with an unknown constant at each value of a grid."""
    bench, out = result.model.bench, list[Effect]()
    for name in names(bench):
        effect = effect_named(name, bench)
        if wanted is None and effect.oscillates:  # found by its line in the spectrum; a slow one mimics any drift
            continue
        if (wanted is None or name in wanted) and not effect.dynamic and not effect.walks:
            if effect.unknown is None:
                out.append(effect)
            else:
                slow = effect.oscillates and slow_lines
                values = slow_hz(result.fit, effect) if slow else effect.unknown.grid(GRID)
                out += [effect.at(value) for value in values]
    return out


def group_by_name(found: Iterable[Candidate]) -> dict[str, list[Candidate]]:
    """Return the candidates of each effect."""
    spaces = dict[str, list[Candidate]]()
    for candidate in found:
        spaces.setdefault(str(candidate.effect), []).append(candidate)
    return spaces


def span_the_same(one: Candidate, other: Candidate) -> bool:
    """Tell whether two candidates can produce exactly the same readings."""
    return one.dof == other.dof > 0 and subspace_angles(one.basis, other.basis)[0] < _SAME_RAD
