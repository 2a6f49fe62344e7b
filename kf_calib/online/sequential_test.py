"""A run judged while it goes on: after every dwell, whether the model still agrees and which effects look missing.

Whoever looks after every dwell looks often, and noise alone would cross a level for one look in one run of twenty. The
chance of a false alarm is therefore spent: the k-th look has 1/(k (k + 1)) of it, and all looks together have no more
than that of one run. A look is one update of a factor and one projection; noise, linearisation and threshold are found
anew whenever the run has grown by a quarter. What an alarm means is for ``diagnose`` to say, from the same dwells.

    watch = Watch.over(dwells, bench)
    watch = watch.after(dwell)        # as each dwell closes
    watch.alarm, watch.p_value, watch.suspects
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from kf_calib.bench.bench import Bench
from kf_calib.diagnosis.candidate_tests import LEVEL, REST, SHARE, candidates, chance_fall, independent_tests
from kf_calib.diagnosis.within_dwell_trend import Trend, trend_beside
from kf_calib.dwells.sufficient_statistics import DwellFactor, lines_of
from kf_calib.effects import Effect
from kf_calib.estimation.fit import Fit, fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.running_filter import Running
from kf_calib.support.tail_probabilities import sidak
from kf_calib.support.threads import one_blas_thread

_GROWN = 1.25
_FEWEST = 4
"""Dwells with which a watch can begin: fewer determine no orientation-dependent parameter."""


@dataclass(frozen=True)
class Watch:
    """running: the filter with the candidates' columns; looks: how often it was judged; alarmed: after how many dwells
    the level was crossed first (None: never); fitted_at: with how many dwells the noise was found; tests: as how many
    independent ones the candidates count."""

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
        """A watch over the dwells so far, at least four; they count as one look, after ``looks`` with another model.

        fitted: the model fitted to these dwells, where that is known.
        """
        settings = settings or Settings()
        if len(dwells) < _FEWEST:
            raise ValueError(f"a watch begins with {_FEWEST} dwells, not {len(dwells)}")
        with one_blas_thread():
            return cls(bench, settings, *_begun(dwells, bench, settings, fitted), looks)._looked()

    def after(self, dwell: DwellFactor, fitted: Fit | None = None) -> Watch:
        """The watch after one more dwell. fitted: the model fitted to the dwells with it, where that is known."""
        with one_blas_thread():
            running = self.running.after(dwell, exact=False)  # made anew when it has grown by a quarter
            if len(running.dwells) < _GROWN * self.fitted_at:
                return replace(self, running=running)._looked()
            running, fitted_at, tests = _begun(running.dwells, self.bench, self.settings, fitted)
            return replace(self, running=running, fitted_at=fitted_at, tests=tests)._looked()

    @property
    def dwells(self) -> list[DwellFactor]:
        return self.running.dwells

    @cached_property
    def p_value(self) -> float | None:
        """Of this look alone, as ``diagnose`` has it: the misfit's, the best candidate's or the trends' within dwells;
        None: nothing to judge."""
        from scipy.special import chdtrc

        statistic, dof = self.running.misfit
        if dof <= 0:
            return None
        scan = self.running.scan
        own = [float(chdtrc(c.dof, x)) for c, x in zip(scan.candidates, scan.statistics, strict=True) if c.dof]
        found = [float(chdtrc(dof, statistic)), *([sidak(min(own), self.tests)] if own else [])]
        going = self.trend
        found += [going.p_value * SHARE / REST] if going else []
        return min(1.0, min(found) / SHARE)

    @cached_property
    def trend(self) -> Trend | None:
        """What goes on within dwells; None where lines would, too."""
        found = trend_beside(self.running.carried, self.running.noise, self.running.state)
        shown = found is not None and found.p_value < LEVEL
        return None if shown and lines_of(self.dwells, LEVEL * REST) else found

    @property
    def suspects(self) -> list[str]:
        """Names of what is beyond chance at this look, the likeliest first."""
        scan = self.running.scan
        scores = {
            str(each.effect): float(fall) - chance_fall(each, self.tests)
            for each, fall in zip(scan.candidates, scan.statistics, strict=True)
            if each.dof
        }
        return sorted((name for name, score in scores.items() if score > 0), key=lambda name: -scores[name])

    def _looked(self) -> Watch:
        if self.p_value is None:
            return self
        looks = self.looks + 1
        crossed = self.p_value < LEVEL / (looks * (looks + 1))
        alarmed = len(self.dwells) if crossed and self.alarmed is None else self.alarmed
        return replace(self, looks=looks, alarmed=alarmed)


def _begun(
    dwells: Sequence[DwellFactor], bench: Bench, settings: Settings, fitted: Fit | None
) -> tuple[Running, int, float]:
    """Noise, linearisation and threshold found from the dwells so far."""
    if fitted is None or fitted.carried.slews or len(fitted.dwells) != len(dwells):
        fitted = fit(list(dwells), Model.of(bench, settings.effects), settings.walk_mps2_per_sqrt_s)
    noise = replace(fitted.noise.judging, checked=True)  # a setting error counts in full where a misfit is judged
    running = Running.over(dwells, fitted.carried.model, noise, fitted.carried.state, _watched(fitted))
    return running, len(dwells), independent_tests(running.scan)


def _watched(fitted: Fit) -> list[Effect]:
    """One of each kind of candidates: an unknown constant stands at the middle of its range."""
    first = dict[str, list[Effect]]()
    for effect in candidates(fitted.carried.model):
        first.setdefault(str(effect), []).append(effect)
    return [own[len(own) // 2] for own in first.values()]
