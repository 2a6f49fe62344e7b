"""Scatter from dwell to dwell as the rival of every name: what raises a misfit may be no effect at all.

Scatter that was stated too small, or an orientation that was set worse than stated, looks like whatever effect comes
nearest, and of many effects one comes near. Likelihoods say which of the two it is: that of scatter of any size against
that of the effect, averaged over the directions and constants that it could have (``bayes_factor``).
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
from kf_calib.estimation.calibration import refitted
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.reml import FEWEST
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import sidak


def explains_more_than_scatter(
    before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration
) -> bool:
    """Whether effects, with which the run was refitted, explain more than scatter from dwell to dwell would.

    Where not all of it was stated, it is there in any case: effects have to stand out of it. Of a walk of the biases
    and scatter that explain as much the scatter is likelier where none was stated.
    """
    noise, walks = before.noise, test.walking in names
    if not dwell_noise_is_stated(before) and not passes_f_test(before, test, names):
        return False
    if not noise.scatter_stated:
        least = threshold(1, test.effective_tests)
        return not walks or fall_beyond_scatter(before, test, names, refit) > least
    return fall_beyond_scatter(before, test, names, refit) > 0.0


def could_be_scatter(before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration) -> bool:
    """Whether the odds of effects, with which the run was refitted, against scatter from dwell to dwell of more than is
    stated are less than 99 to 1, where one of the effects is as likely to be missing as that.

    Of n effects each is then the one in 1 of n runs; a walk of the biases, of which there is one, takes no such share.
    """
    columns = sum(name in test.best for name in names)
    least = columns * math.log(len(test.scores)) - math.log(LEVEL)
    return fall_beyond_scatter(before, test, names, refit) < 2.0 * least


def fall_beyond_scatter(before: Calibration, test: CandidateTests, names: Sequence[str], refit: Calibration) -> float:
    """By how much -2 log-likelihood is lower with effects than with scatter from dwell to dwell, or with setting error,
    of more than is stated; infinite for what shows within dwells.

    A walk of the biases beside other effects has to be likelier than scatter beside them, too.
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
    own = [test.best[name] for name in columns]
    if len(own) > 1:
        return joint_evidence_as_fall(test.scan, own)
    values = values_of(test.scan, columns[0])
    return evidence_as_fall(test.scan, values, test.scan.statistics[values])


def _beyond_linear(before: Calibration, test: CandidateTests, columns: Sequence[str], refit: Calibration) -> float:
    """What a refit lowers chi-squared of the dwells' means by, beyond what the scan says: what is large is not linear,
    and its chi-squared is not that of the means to a part in a hundred."""
    if not dwell_noise_is_stated(before):
        return 0.0  # a noise of its own
    bases = [test.candidate(name).basis for name in columns]
    linear, _ = test.scan.explained(np.concatenate(bases, axis=1))
    return max(before.fit.misfit - refit.fit.misfit - linear, 0.0)


def passes_f_test(before: Calibration, test: CandidateTests, names: Sequence[str]) -> bool:
    """Whether effects explain more than they would of whatever goes on from dwell to dwell, by however much: scatter, a
    walk of the biases; few dwells cannot show it.

    F = (fall / q) / (rest / (dof - q)), q coefficients: a scatter as large as it needs to be is in fall and rest alike.
    What shows within dwells is no matter of scatter between them.
    """
    from scipy.special import fdtrc

    misfit = before.consistency
    if any(name not in test.best for name in names):
        return True
    own = [test.candidate(name) for name in names]
    fall, dof = test.scan.explained(np.concatenate([each.basis for each in own], axis=1))
    dof += sum(each.effect.unknown is not None for each in own)  # a constant that was looked for
    freedom = misfit.dof - dof
    if freedom <= 0:
        return False
    rest = max(misfit.statistic - fall, 1e-9 * misfit.statistic)
    return sidak(float(fdtrc(dof, freedom, fall / dof / (rest / freedom))), test.effective_tests) < LEVEL


def dwell_noise_is_stated(before: Calibration) -> bool:
    """Whether all noise from dwell to dwell was stated."""
    return before.noise.scatter_stated and before.noise.setting_stated


def with_noise_as_stated(before: Calibration, refit: Calibration) -> Calibration:
    """The run without the effects that a refit has, as if the bench had stated the noise from dwell to dwell that was
    estimated with them: without them it would be estimated from what they explain."""
    noise, bench = refit.noise, before.bench
    if not noise.setting_stated:
        bench = replace(bench, angle_sigma_deg=float(np.degrees(noise.setting_rad)))
    if not noise.scatter_stated:
        bench = replace(bench, scatter_sigma_mps2=float(np.sqrt(np.mean(noise.scatter_mps2**2))))
    return refitted(replace(before, bench=bench), before.settings.effects)


def least_noisy(refits: Iterable[Calibration]) -> Calibration | None:
    """Of fits of a run that with the least noise, by the determinants of its dwells' covariances."""

    def size(refit: Calibration) -> float:
        covariances = mean_covariances(refit.noise, refit.carried.means, refit.carried.state)
        return float(np.linalg.slogdet(covariances)[1].sum())

    return min(refits, key=size, default=None)


def scatter_is_possible(before: Calibration) -> bool:
    """Whether dwells may scatter by more than was stated: it was found that they do, or so few cannot show it."""
    noise, few = before.noise, before.consistency.dof < FEWEST
    return (not noise.scatter_stated and (few or bool(noise.scatter_mps2.any()))) or (not noise.setting_stated and few)
