"""Sequential test of a run: after every dwell, whether the model still agrees and which effects seem to be missing.

A test after every dwell is repeated many times, and would cross a fixed level by chance far more often than a single
test. The false-alarm probability is therefore spent: the k-th test has 1/(k (k + 1)) of it, so that all tests together
have no more than a single run. A test is one update of a factor and one projection. Noise, linearisation and threshold
are computed again whenever the run has grown by a quarter. The cause of an alarm is found by ``diagnose``, from the
same dwells.

    watch = Watch.over(dwells, bench)
    watch = watch.after(dwell)        # as each dwell closes
    watch.alarmed, watch.p_value, watch.suspects
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from kf_calib.bench.bench import Bench
from kf_calib.diagnosis.candidate_tests import LEVEL, REST, SHARE, candidates, critical_delta_chi2, independent_tests
from kf_calib.diagnosis.within_dwell_trend import Trend, trend_beside
from kf_calib.dwells.sufficient_statistics import DwellFactor, lines_of
from kf_calib.effects import Effect
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.running_filter import Running
from kf_calib.support.tail_probabilities import sidak
from kf_calib.support.threads import one_blas_thread

_GROWN = 1.25
_FEWEST = 4
"""Number of dwells with which a watch can begin: fewer cannot determine scale factors and misalignments."""


@dataclass(frozen=True)
class Watch:
    """The sequential test of a run; every dwell gives a new one.

    running: filter that carries the columns of the candidates. fitted_at: number of dwells when noise and threshold
    were computed. tests: effective number of independent tests among the candidates. looks: number of tests so far.
    alarmed: number of dwells after which the level was first crossed (None: never).
    """

    bench: Bench
    settings: Settings
    running: Running
    fitted_at: int
    tests: float
    looks: int = 0
    alarmed: int | None = None

    @classmethod
    def over(
        cls,
        dwells: Sequence[DwellFactor],
        bench: Bench,
        settings: Settings | None = None,
        looks: int = 0,
        fitted: Fit | None = None,
    ) -> Watch:
        """The sequential test after the first dwells, at least four, which count as one test.

        settings: of the calibration. looks: number of tests made before with another model. fitted: the model fitted to
        these dwells, where it is known. Raises ValueError for fewer than four dwells.
        """
        settings = settings or Settings()
        if len(dwells) < _FEWEST:
            raise ValueError(f"a watch begins with {_FEWEST} dwells, not {len(dwells)}")
        with one_blas_thread():
            return cls(bench, settings, *_begun(dwells, bench, settings, fitted), looks)._look()

    def after(
        self, dwell: DwellFactor, fitted: Fit | None = None, dwells: Sequence[DwellFactor] | None = None
    ) -> Watch:
        """The sequential test after one more dwell.

        fitted: the model fitted to all dwells, this one included, where it is known. dwells: all of them, where pieces
        of earlier ones may have been merged since.
        """
        with one_blas_thread():
            running = self.running.after(dwell, exact=False).lean()  # it is built again when a quarter has been added
            if len(running.dwells) < _GROWN * self.fitted_at:
                return replace(self, running=running)._look()
            running, fitted_at, tests = _begun(dwells or running.dwells, self.bench, self.settings, fitted)
            return replace(self, running=running, fitted_at=fitted_at, tests=tests)._look()

    @property
    def dwells(self) -> Sequence[DwellFactor]:
        """The dwells so far."""
        return self.running.dwells

    @cached_property
    def p_value(self) -> float | None:
        """The p-value of the latest test alone: the smallest of misfit, candidates and trends, as in ``diagnose``.

        None where nothing is left to judge by.
        """
        from scipy.special import chdtrc

        statistic, dof = self.running.misfit
        if dof <= 0:
            return None
        scan = self.running.scan
        own = [float(chdtrc(c.dof, x)) for c, x in zip(scan.candidates, scan.statistics, strict=True) if c.dof]
        p_values = [float(chdtrc(dof, statistic)), *([sidak(min(own), self.tests)] if own else [])]
        going = self.trend
        p_values += [going.p_value * SHARE / REST] if going else []
        return min(1.0, min(p_values) / SHARE)

    @cached_property
    def trend(self) -> Trend | None:
        """The test of trends within dwells; None where spectral lines would give trends as well."""
        found = trend_beside(self.running.linearised, self.running.noise, self.running.state)
        shown = found is not None and found.p_value < LEVEL
        return None if shown and lines_of(self.dwells, LEVEL * REST) else found

    @property
    def suspects(self) -> list[str]:
        """Names of the effects that are significant in the latest test, the one with the highest score first."""
        scan = self.running.scan
        scores = {
            str(each.effect): float(delta_chi2) - critical_delta_chi2(each, self.tests)
            for each, delta_chi2 in zip(scan.candidates, scan.statistics, strict=True)
            if each.dof
        }
        return sorted((name for name, score in scores.items() if score > 0), key=lambda name: -scores[name])

    def _look(self) -> Watch:
        """Return the watch after a test, at the level that is spent on it."""
        if self.p_value is None:
            return self
        looks = self.looks + 1
        crossed = self.p_value < LEVEL / (looks * (looks + 1))
        alarmed = len(self.dwells) if crossed and self.alarmed is None else self.alarmed
        looked = replace(self, looks=looks, alarmed=alarmed)
        looked.__dict__.update({name: vars(self)[name] for name in ("p_value", "trend") if name in vars(self)})
        return looked


def _begun(
    dwells: Sequence[DwellFactor], bench: Bench, settings: Settings, fitted: Fit | None
) -> tuple[Running, int, float]:
    """Return the filter with noise and linearisation from the dwells so far, their number, and the effective tests."""
    if fitted is None or fitted.linearised.slews or len(fitted.dwells) != len(dwells):
        fitted = fit(list(dwells), Model.of(bench, settings.effects), settings.walk_mps2_per_sqrt_s)
    noise = replace(
        fitted.noise.for_goodness_of_fit, checked=True
    )  # a test of the misfit has to allow for all of a setting error
    model, state = fitted.linearised.model, fitted.linearised.state
    running = Running.over(dwells, model, noise, state, _effects_to_watch(fitted)).lean()
    return running, len(dwells), independent_tests(running.scan)


def _effects_to_watch(fitted: Fit) -> list[Effect]:
    """Return one candidate of each effect; an unknown constant has the middle value of its grid."""
    first = dict[str, list[Effect]]()
    for effect in candidates(fitted.linearised.model):
        first.setdefault(str(effect), []).append(effect)
    return [own[len(own) // 2] for own in first.values()]
