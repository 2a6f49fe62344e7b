"""The noise model: how the readings of a platform at rest scatter, within a dwell and from dwell to dwell.

sigma_w is the noise of a reading within a dwell; its autocorrelation is described by the inflation kappa, the spectral
density at frequency zero divided by that of white noise of the same variance, so that the mean of n readings has the
variance kappa sigma_w^2 / n. All else is a list of terms (``terms``): the setting error, the scatter from dwell to
dwell, slow waves of 1/f noise, what is not known of axes and temperatures, and a random walk of the biases. What is
computed in a noise goes over this list, and noises differ by which terms are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from kf_calib.bench.arrays import EXACT, Floats
from kf_calib.dwells.limits import FEWEST_COMPARED
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.noise import random_walk
from kf_calib.noise.means import Means
from kf_calib.noise.terms import (
    FLOOR_MPS2,
    NoiseTerm,
    RandomWalk,
    Scatter,
    Scope,
    SettingError,
    SlowWaves,
    WavesOverRun,
    setting_covariances,
)

_T = TypeVar("_T", bound=NoiseTerm)


@dataclass(frozen=True)
class Noise:
    """The parameters of the noise model.

    - sigma_mps2 (3,): sigma_w of each accelerometer.
    - inflation (3,): kappa of each accelerometer.
    - terms: at most one of each class.
    - slew_sigma_mps2 (3,): the effective sigma in slews; None if no slews are used.
    - within_seen: whether readings within dwells showed their noise; in a table of means alone they do not.
    """

    sigma_mps2: Floats
    inflation: Floats
    terms: tuple[NoiseTerm, ...] = ()
    slew_sigma_mps2: Floats | None = None
    within_seen: bool = True

    @property
    def effective_sigma_mps2(self) -> Floats:
        """Sigma (3,) of white readings whose mean has the same variance as the mean of the correlated readings."""
        return np.maximum(self.sigma_mps2, FLOOR_MPS2) * np.sqrt(self.inflation)

    @property
    def correlation_length(self) -> Floats:
        """The readings (3,) that count as one where variances are estimated: kappa, but at least one."""
        return np.maximum(self.inflation, 1.0)

    def of_means(self, counts: Floats, correlations: Floats) -> Floats:
        """Covariances (D, 3, 3) of the means of so many readings (D, 3) by the noise within dwells, with these
        correlations (D, 3, 3)."""
        sigmas = self.effective_sigma_mps2 / np.sqrt(counts)
        return sigmas[:, :, None] * correlations * sigmas[:, None, :]

    # What is in the list

    def term(self, kind: type[_T]) -> _T | None:
        """The term of a class; None where there is none."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    @cached_property
    def setting(self) -> SettingError:
        """The setting error, of size zero where there is none."""
        return self.term(SettingError) or SettingError()

    @cached_property
    def scatter(self) -> Scatter:
        """The scatter from dwell to dwell, of size zero where there is none."""
        return self.term(Scatter) or Scatter()

    @cached_property
    def walk(self) -> RandomWalk:
        """The random walk of the biases, of size zero where there is none."""
        return self.term(RandomWalk) or RandomWalk()

    @property
    def setting_rad(self) -> float:
        """sigma_alpha, one small rotation a dwell; infinite where attitudes are not known at all."""
        return self.setting.size_rad

    @property
    def scatter_mps2(self) -> Floats:
        """sigma_s (3,) of each accelerometer from dwell to dwell."""
        return self.scatter.sizes_mps2

    @property
    def walk_mps2_per_sqrt_s(self) -> Floats:
        """The intensities q (3,) of the random walks of the biases."""
        return self.walk.intensities_mps2_per_sqrt_s

    @property
    def attitude_unknown(self) -> bool:
        """Whether nothing is known of the attitude of a dwell, so that only the size of the force is."""
        return self.setting.is_unknown

    # Lists that differ in some terms

    def with_terms(self, *terms: NoiseTerm) -> Noise:
        """The noise with these terms, in place of those of the same classes where there are any."""
        by_kind = {type(term): term for term in self.terms} | {type(term): term for term in terms}
        return replace(self, terms=tuple(by_kind.values()))

    def without(self, *kinds: type[NoiseTerm]) -> Noise:
        """The noise without the terms of some classes."""
        return replace(self, terms=tuple(term for term in self.terms if not isinstance(term, kinds)))

    @property
    def weights(self) -> Noise:
        """The noise by which dwells are weighted in the fit."""
        return self.without(SettingError) if self.setting.considered else self

    @property
    def for_goodness_of_fit(self) -> Noise:
        """The noise by which the misfit is judged: without scatter, and an unclear setting error, that were estimated
        from this misfit itself, unless no other noise is known."""
        if not self.within_seen:
            return self
        return self.without_estimates(but=(SettingError,) if self.setting.judged else ())

    def without_estimates(self, but: tuple[type[NoiseTerm], ...] = ()) -> Noise:
        """The noise without scatter and a setting error that were estimated from the misfit, which they explain, but
        for some classes."""
        return replace(self, terms=tuple(term for term in self.terms if term.stated or isinstance(term, but)))

    def of(self, moving: bool) -> Noise:
        """The noise that applies in slews if ``moving``, else the noise in dwells."""
        if not moving:
            return self
        passing = self.without(SlowWaves)
        if self.slew_sigma_mps2 is None:
            return passing
        return replace(passing.without(RandomWalk), sigma_mps2=self.slew_sigma_mps2, inflation=np.ones(3))

    @property
    def of_readings(self) -> Noise:
        """The noise without an unknown attitude, which the readings themselves show; with angles, all of it."""
        return self.without(SettingError) if self.attitude_unknown else self

    def with_scatter_as_flicker(self, dwells: int) -> Noise:
        """The noise by which a misfit over so many dwells is judged: scatter that is stated for a bench may be 1/f
        noise, which goes on within dwells and looks like a drift of the run."""
        flicker_mps2, without = self.scatter.flicker_mps2(dwells), self.without(SlowWaves)
        if dwells < FEWEST_COMPARED or not flicker_mps2.any():
            return without
        return without.with_terms(SlowWaves(flicker_mps2), WavesOverRun(flicker_mps2))

    # What the list gives

    def columns(self, scope: Scope, dwells: Sequence[Dwell], state: Floats) -> Floats:
        """Changes (pieces, nodes, 3, q) of the readings by 1 sigma of each error of one scope."""
        table = DwellTable.of(dwells)
        columns = [term.columns(table, state) for term in self.terms if term.scope == scope]
        if not columns:
            return np.zeros((table.folded.ends[-1], table.folded.width, 3, 0))
        return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=3)


def steps(dwells: Sequence[Dwell], noise: Noise) -> Floats:
    """Variances (D, 2, 3) of the steps of the biases in the pause before each dwell and over the dwell."""
    ends = DwellTable.of(dwells).folded.ends_s
    return random_walk.variances(ends[:, 0], ends[:, 1], noise.walk_mps2_per_sqrt_s)


def mean_covariances(noise: Noise, means: Means, state: Floats, misfit_mps2: float = 0.0) -> Floats:
    """Covariances (D, 3, 3) of the dwells' mean readings about the model: those by the noise within dwells,
    kappa sigma_w^2 / n and what accelerometers share of it, and those of all terms that are drawn for each dwell.

    An attitude that is not known counts as a setting error so large that it leaves the size of f alone, also where the
    noise is not known yet and is to be estimated from a misfit of this rms size.
    """
    covariances = noise.of_means(means.counts, means.correlations)
    for term in noise.without(SettingError).terms:
        covariances = covariances + term.covariances(means, state)
    largest_mps2 = max(float(np.sqrt(np.einsum("dii->di", covariances).max())), misfit_mps2)
    return covariances + noise.setting.covariances(means, state, largest_mps2)


def lift_rounding(covariances: Floats) -> Floats:
    """Covariances (D, 3, 3) with a small multiple of the identity added, so that a Cholesky factor exists.

    The covariance of a setting error is singular along the specific force. If the other noise is far below the setting
    error, rounding would decide whether the matrix is positive definite.
    """
    least = EXACT * np.einsum("dii->d", covariances)
    return np.asarray(covariances + least[:, None, None] * np.eye(covariances.shape[-1]), float)


def considered_information(noise: Noise, means: Means, state: Floats) -> Floats:
    """Contribution B (D, p, p) of each dwell's setting error to the covariance P + P (sum of B) P; zeros if it is
    weighted.

      B = A^T W V W A

    A is the design, W the weights and V the setting error's covariance of the mean readings. This is the covariance of
    the Schmidt-Kalman filter (G. J. Bierman, Factorization Methods, 1977, ch. VIII); in regression it is known as a
    sandwich.
    """
    count = means.design.shape[2]
    if not (noise.setting.considered and noise.setting_rad):
        return np.broadcast_to(np.zeros((count, count)), (len(means.counts), count, count))
    weighted = np.linalg.solve(mean_covariances(noise.weights, means, state), means.design)
    return noise.setting_rad**2 * np.swapaxes(weighted, 1, 2) @ setting_covariances(means, state) @ weighted
