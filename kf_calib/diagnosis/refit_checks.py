"""Whether a model with an effect leaves no more than noise would, by means that an effect of its kind has."""

from __future__ import annotations

import math

import numpy as np

from kf_calib.diagnosis.candidate_tests import EQUAL, LEVEL, SHARE, CandidateTests, assess_candidates
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.fit import loss_within_range
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import sidak

_REFUSED = 0.002  # chance that what is really missing is turned down because noise beside it looks like something more
_NEARLY = 2.71  # of chi-squared, of one constant: 10 %


def fits_the_run(refit: Calibration, before: CandidateTests, added: int = 1) -> bool:
    """Whether nothing is left that noise would not leave, by means an effect of that kind has.

    A walk, or two effects ``added`` at once, can take up most of what is neither: what is left is judged more strictly.
    """
    misfit, walks = refit.consistency.p_value, bool(refit.noise.walk_mps2_per_sqrt_s)
    least = LEVEL if walks else _REFUSED
    if (misfit is not None and misfit < SHARE * least) or (walks and _no_walk(refit)) or _at_an_end(refit):
        return False
    left = assess_candidates(refit.fit, before.effective_tests, frames=refit.frames)
    if left.trend and misfit is not None:
        free = walks or added > 1
        if _together(misfit, left.trend.p_value) < SHARE * (LEVEL if free else _REFUSED):
            return False
    return left.p_value is None or left.p_value >= least


def _together(*p_values: float) -> float:
    """The p-value of independent tests, none of which need be beyond chance alone (Fisher, 1932)."""
    from scipy.special import chdtrc

    return float(chdtrc(2 * len(p_values), -2.0 * sum(math.log(max(p, 1e-300)) for p in p_values)))


def _at_an_end(refit: Calibration) -> bool:
    """Whether a constant was looked for and ran to an end of its range, and none well within does nearly as well:
    another, simpler effect is meant then."""
    for effect in refit.model.effects:
        known = effect.unknown is None or effect.unknown.low * 1.01 < effect.value < effect.unknown.high * 0.99
        if not known and loss_within_range(refit.fit, effect) > _NEARLY:
            return True
    return False


def _no_walk(refit: Calibration) -> bool:
    """Whether walking biases take a step no walk would, as in one jump, or come back as none does: what goes to and fro
    between bounds is none."""
    from scipy.special import ndtr

    steps = np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in refit.visits])
    steps = np.abs(steps[np.isfinite(steps)])
    leaps = bool(steps.size and sidak(2.0 * float(ndtr(-steps.max())), steps.size) < LEVEL)
    return leaps or 2.0 * refit.fit.back_gain[0] > EQUAL


def restoring_time_s(found: Diagnosis) -> float | None:
    """The time constant with which what is taken for a walk more likely comes back, s, where that is not too likely for
    a walk: of walks one in twenty looks so."""
    if found.after is None or not found.after.noise.walk_mps2_per_sqrt_s or found.test.walking not in found.missing:
        return None
    gain, back_s = found.after.fit.back_gain
    return back_s if 2.0 * gain > _NEARLY else None
