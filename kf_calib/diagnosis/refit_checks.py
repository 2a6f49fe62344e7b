"""Checks of a refit: whether the model with an added effect leaves no more than noise would."""

from __future__ import annotations

import math

import numpy as np

from kf_calib.diagnosis.candidate_tests import EQUAL, LEVEL, SHARE, CandidateTests
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.fit import loss_within_range
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import sidak

_REFUSED = 0.002  # probability that the effect that is missing is rejected because of noise in the rest of the misfit
_NEARLY = 2.71  # rise of chi-squared that is not significant for one constant (10 %)


def fits_the_run(refits: Refits, refit: Calibration, before: CandidateTests, added: int = 1) -> bool:
    """Whether the refit leaves only noise, judged by its misfit, all remaining candidates, and trends within dwells.

    A random walk has to move like one, and a constant must not end at a limit of its range. A random walk, or several
    effects added at once, can absorb much of a misfit that they do not cause, so that stricter levels are used for
    them.

    refits: those of the run. refit: the run with the effect. before: the tests without it. added: number of effects
    that were added at once.
    """
    misfit, walks = refit.consistency.p_value, bool(refit.noise.walk_mps2_per_sqrt_s)
    least = LEVEL if walks else _REFUSED
    if (misfit is not None and misfit < SHARE * least) or (walks and _no_walk(refit)) or _at_an_end(refit):
        return False
    left = refits.assess(refit, before.effective_tests)
    if left.trend and misfit is not None:
        free = walks or added > 1
        if _together(misfit, left.trend.p_value) < SHARE * (LEVEL if free else _REFUSED):
            return False
    return left.p_value is None or left.p_value >= least


def _together(*p_values: float) -> float:
    """Return the p-value of independent tests combined by Fisher's method (1932)."""
    from scipy.special import chdtrc

    return float(chdtrc(2 * len(p_values), -2.0 * sum(math.log(max(p, 1e-300)) for p in p_values)))


def _at_an_end(refit: Calibration) -> bool:
    """Tell whether a constant was estimated at a limit of its range, with no value well inside nearly as good.

    Another, simpler effect is then the likely cause.
    """
    for effect in refit.model.effects:
        known = effect.unknown is None or effect.unknown.low * 1.01 < effect.value < effect.unknown.high * 0.99
        if not known and loss_within_range(refit.fit, effect) > _NEARLY:
            return True
    return False


def _no_walk(refit: Calibration) -> bool:
    """Tell whether the biases move unlike a random walk: by a significant jump, or with a significant return."""
    from scipy.special import ndtr

    steps = np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in refit.visits])
    steps = np.abs(steps[np.isfinite(steps)])
    leaps = bool(steps.size and sidak(2.0 * float(ndtr(-steps.max())), steps.size) < LEVEL)
    return leaps or 2.0 * refit.fit.back_gain[0] > EQUAL


def restoring_time_s(found: Diagnosis) -> float | None:
    """The time constant of a drift that returns, in s, where that explains the run better than the random walk named.

    None where no walk was named, or where the gain in likelihood is below what 1 of 20 true random walks exceeds.
    """
    if found.after is None or not found.after.noise.walk_mps2_per_sqrt_s or found.test.walking not in found.missing:
        return None
    gain, back_s = found.after.fit.back_gain
    return back_s if 2.0 * gain > _NEARLY else None
