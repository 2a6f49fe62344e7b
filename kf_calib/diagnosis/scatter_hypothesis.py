"""Scatter from dwell to dwell as the alternative hypothesis to every effect.

If scatter or setting error is larger than stated, the misfit resembles the nearest effect, and in a large catalogue
some effect is always near. The two hypotheses are therefore compared by their likelihoods: that of scatter of any size,
and that of the effect averaged over the directions and constants that it may have (``bayes_factor``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from kf_calib.diagnosis.candidate_tests import (
    LEVEL,
    CandidateTests,
    evidence_as_fall,
    joint_evidence_as_fall,
    threshold,
    values_of,
)
from kf_calib.diagnosis.refits import Refits
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.reml import FEWEST
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import sidak


def explains_more_than_scatter(
    before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration
) -> bool:
    """Whether effects explain the misfit better than scatter from dwell to dwell would.

    Where scatter was stated, the effects must be likelier than scatter larger than stated. Where scatter or setting
    error was not stated, they must be significant in an F-test against the noise from dwell to dwell. Where scatter was
    not stated, that test suffices; only a random walk must be significantly likelier than scatter, too.

    before: the run without the effects. test: its tests. names: of the effects. refit: the run with them.
    """
    noise, walks = before.noise, test.walking in names
    if not dwell_noise_is_stated(before) and not passes_f_test(before, test, names):
        return False
    if not noise.scatter_stated:
        least = threshold(1, test.effective_tests)
        return not walks or fall_beyond_scatter(before, test, names, refit) > least
    return fall_beyond_scatter(before, test, names, refit) > 0.0


def could_be_scatter(before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration) -> bool:
    """Whether scatter larger than stated remains a plausible explanation beside the effects: odds below 99 to 1.

    Each of n effects is given a prior probability of 1/n against scatter. A random walk, of which there is only one, is
    given an equal prior.

    before: the run without the effects. test: its tests. names: of the effects. refit: the run with them.
    """
    columns = sum(name in test.best for name in names)
    least = columns * math.log(len(test.scores)) - math.log(LEVEL)
    return fall_beyond_scatter(before, test, names, refit) < 2.0 * least


def fall_beyond_scatter(before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration) -> float:
    """By how much -2 log-likelihood is lower with the effects than with scatter or setting error larger than stated.

    A random walk beside other effects must also be likelier than scatter beside them. Infinite for an oscillation that
    shows within dwells, which scatter cannot imitate.

    before: the run without the effects. test: its tests. names: of the effects. refit: the run with them.
    """
    columns, walks = [name for name in names if name in test.best], test.walking in names
    scatter = 2.0 * before.fit.scatter_gain
    if not columns:
        return 2.0 * before.fit.walk_gain - scatter if walks else math.inf
    own = _worth(test, columns) - scatter
    if not walks:
        return own + _beyond_linear(before, test, columns, refit)
    walk = 2.0 * refit.fit.walk_gain
    return min(own + walk, walk - 2.0 * refit.fit.scatter_gain)


def _worth(test: CandidateTests, columns: Sequence[str]) -> float:
    """Return the Bayes factor of effects with columns, as a fall of chi-squared."""
    own = [test.best[name] for name in columns]
    if len(own) > 1:
        return joint_evidence_as_fall(test.scan, own)
    values = values_of(test.scan, columns[0])
    return evidence_as_fall(test.scan, values, test.scan.statistics[values])


def _beyond_linear(before: Calibration, test: CandidateTests, columns: Sequence[str], refit: Calibration) -> float:
    """Return by how much a refit lowers the chi-squared of the dwell means more than the linear scan predicts.

    A large effect is not linear in its coefficients, and where the misfit is huge, the chi-squared of the scan differs
    from that of the means by up to one per cent.
    """
    if not dwell_noise_is_stated(before):
        return 0.0  # the refit has estimated a noise of its own, so that its chi-squared does not compare
    bases = [test.candidate(name).basis for name in columns]
    linear, _ = test.scan.explained(np.concatenate(bases, axis=1))
    return max(before.fit.misfit - refit.fit.misfit - linear, 0.0)


def passes_f_test(before: Calibration, test: CandidateTests, names: Sequence[str]) -> bool:
    """Whether effects are significant in an F-test against irregular changes from dwell to dwell of unknown size.

    F = (fall / q) / (rest / (dof - q)) with q coefficients. A common factor in the variance from dwell to dwell enters
    the fall and the rest of chi-squared alike and cancels. With few dwells the test has little power. Effects that show
    within dwells pass without a test, since changes from dwell to dwell cannot imitate them.

    before: the run without the effects. test: its tests. names: of the effects.
    """
    from scipy.special import fdtrc

    misfit = before.consistency
    if any(name not in test.best for name in names):
        return True
    own = [test.candidate(name) for name in names]
    fall, dof = test.scan.explained(np.concatenate([each.basis for each in own], axis=1))
    dof += sum(each.effect.unknown is not None for each in own)  # a constant that was searched counts as one more
    freedom = misfit.dof - dof
    if freedom <= 0:
        return False
    rest = max(misfit.statistic - fall, 1e-9 * misfit.statistic)
    return sidak(float(fdtrc(dof, freedom, fall / dof / (rest / freedom))), test.effective_tests) < LEVEL


def dwell_noise_is_stated(before: Calibration) -> bool:
    """Whether both scatter and setting error were stated rather than estimated."""
    return before.noise.scatter_stated and before.noise.setting_stated


def with_noise_as_stated(refits: Refits, before: Calibration, refit: Calibration) -> Calibration:
    """The run without the added effects, with the noise from dwell to dwell as it was estimated in their refit.

    Estimated without the effects, the noise would be too large, as it would contain what they explain.
    """
    noise, bench = refit.noise, before.bench
    if not noise.setting_stated:
        bench = replace(bench, angle_sigma_deg=float(np.degrees(noise.setting_rad)))
    if not noise.scatter_stated:
        bench = replace(bench, scatter_sigma_mps2=float(np.sqrt(np.mean(noise.scatter_mps2**2))))
    return refits.of(replace(before, bench=bench), before.settings.effects)


def least_noisy(refits: Iterable[Calibration]) -> Calibration | None:
    """The fit with the least noise, by the determinants of the covariances of its dwell means, or None."""

    def size(refit: Calibration) -> float:
        """Return the log determinant of the covariances of all dwell means."""
        covariances = mean_covariances(refit.noise, refit.carried.means, refit.carried.state)
        return float(np.linalg.slogdet(covariances)[1].sum())

    return min(refits, key=size, default=None)


def scatter_is_possible(before: Calibration) -> bool:
    """Whether dwells may scatter by more than was stated: the data show it, or are too few to exclude it."""
    noise, few = before.noise, before.consistency.dof < FEWEST
    return (not noise.scatter_stated and (few or bool(noise.scatter_mps2.any()))) or (not noise.setting_stated and few)
