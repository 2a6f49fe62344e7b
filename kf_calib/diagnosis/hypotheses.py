"""The rows of the table of hypotheses: every explanation of a misfit, refitted and weighed.

Rows are: nothing; noise from dwell to dwell that was not stated; each effect; pairs of effects, which may mask each
other; an effect beside a random walk of the biases; formulas that are no known effect, by what they depend on;
irregular changes of an unknown cause; and unknown causes that look like a known effect, so that no name is certain. The
likeliest of each kind by the linear tests are refitted, because large effects are not linear, and weighed by their
``Evidence``. The prior of a kind is shared among its members, so that a hundred formulas do not outvote one effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import CandidateTests, assess_candidates, values_of
from kf_calib.diagnosis.dwell_noise import dwell_noise_is_stated
from kf_calib.diagnosis.evidence import Evidence, Weighed, size_evidence
from kf_calib.diagnosis.hypothesis_table import IRREGULAR, KINDS, NOISE, NONE, NOTHING, Hypothesis, Table, table_of
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.unknown_effect import Family as Formulas
from kf_calib.diagnosis.unknown_effect import one_digit_seconds
from kf_calib.diagnosis.within_dwell_trend import Trend, trend
from kf_calib.effects import FrameEffect, effect_named, walk_named
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import unweighted_left

_NO_NOISE = {True: 0.4, False: 0.1}  # share of an unknown cause in more scatter, by whether noise was stated
_SHORT = 0.01  # prior probability of irregular changes that show within dwells only
SCREEN_LOG_BF, NONLINEARITY_MARGIN = (
    8.0,
    0.02,
)  # rows further behind, in ln and as a share of the evidence, are not refitted
_MOST = {"effect": 8, "turn": 3, "pair": 4, "walk": 3, "formula": 3}


def log_odds_of(p_value: float) -> float:
    """The largest log odds that a p-value gives against what it tests: -ln(-e p ln p), 0 above 1/e (T. Sellke, M.
    Bayarri, J. Berger, 2001)."""
    p_value = max(p_value, 1e-300)
    return -math.log(-math.e * p_value * math.log(p_value)) if p_value < 1.0 / math.e else 0.0


def _log_odds(found: Trend | None) -> float:
    """Return the log odds that trends within dwells give against a model that has none."""
    return log_odds_of(found.p_value) if found else 0.0


def _sum(logs: Sequence[float]) -> float:
    """Return the log of a sum from the logs of its terms."""
    return float(np.logaddexp.reduce([-math.inf, *logs]))


def _least(logs: Iterable[float]) -> float:
    """Return the least evidence by the linear tests with which a row is refitted; large effects are not linear."""
    best = max(logs, default=0.0)
    return best - SCREEN_LOG_BF - NONLINEARITY_MARGIN * max(best, 0.0)


class Hypotheses:
    """Makes the rows of one run.

    refits: those of the run. before: the run without what is missing. test: its linear tests.
    """

    def __init__(self, refits: Refits, before: Calibration, test: CandidateTests) -> None:
        self.refits, self.before, self.test = refits, before, test
        self.evidence, self.inflation = Evidence(before.fit), 1.0
        self.walk = "" if before.model.walks else walk_named(before.bench)
        self.stated = dwell_noise_is_stated(before)

    def table(self) -> Table:
        """The table with the likeliest rows refitted."""
        best = next((name for name in self._screened() if name in self.test.best), None)
        if best is not None:  # what even the best effect leaves makes every fall less significant
            judged = self._refit((best,)).consistency
            self.inflation = max(1.0, judged.statistic / judged.dof) if judged.dof > 0 else 1.0
        effects = self._screened()
        pairs = self._pairs(effects)
        tried = [*self._without(), *self._effects(effects), *self._formulas(effects)]
        tried += [self._row(names, self._prior("pair", math.comb(len(effects), 2), *names)) for names in pairs]
        likeliest, known = max(tried, key=lambda row: row.log_evidence), {row.effects for row in tried}
        tried += [self._single(name, effects) for name in likeliest.effects if (name,) not in known]
        tried = [row for row in tried if math.isfinite(row.log_evidence)]
        least = max(row.log_evidence for row in tried) - SCREEN_LOG_BF
        walks = [row for row in tried if row.effects == (self.walk,) and row.log_evidence > least]
        return table_of([*tried, *(back for walk in walks if self.stated for back in self._returning(walk))])

    def _returning(self, walk: Hypothesis) -> Iterator[Hypothesis]:
        """Yield the row of biases that move irregularly and return to their mean after any time, from that of a random
        walk; none where no walk is likelier than none."""
        assert walk.refit is not None
        gains, times_s = walk.refit.fit.gauss_markov_gains
        driver = f"time (irregular, back within about {one_digit_seconds(float(times_s[np.argmax(gains)]))})"
        prior = self._prior("effect", len(self.test.scores), self.walk) + math.log(KINDS["formula"] / KINDS["effect"])
        for own in self.evidence.of(walk.refit.fit, walk=True):
            if not own.parts:  # the gains are over a walk that nothing else explains
                log = own.log + float(np.logaddexp.reduce(gains)) - math.log(len(gains)) + prior
                log += self._within(walk.effects, walk.refit)
                yield Hypothesis(driver=driver, families=walk.families, log_evidence=log)

    def quick_table(self) -> Table:
        """The table of nothing, noise and single effects by the linear tests alone, for a run with no misfit."""
        rows, prior = list(self._without()), partial(self._prior, "effect", len(self.test.scores))
        least = rows[0].log_evidence - math.log(KINDS["nothing"])
        rows += [
            Hypothesis((name,), families=self._families((name,)), log_evidence=least + own + prior(name),
                       statistic=self._fall(name), dof=self._dof(name))
            for name, own in self._screened().items()
        ]  # fmt: skip
        return table_of(rows)

    def _without(self) -> Iterator[Hypothesis]:
        """Yield the rows without an effect: nothing, noise that was not stated, and irregular changes."""
        found, prior = self.evidence.of(), math.log(KINDS["nothing"])
        still = float(next(own.log for own in found if not own.parts)) + prior
        turned = _sum([own.log for own in found if own.parts == ("setting",)]) + prior
        spread = _sum([own.log for own in found if "common" in own.parts]) + prior
        share = _NO_NOISE[self.stated]
        either = _sum([spread + math.log(share), still + math.log(_SHORT)]) + _log_odds(self.test.trend)
        yield Hypothesis(families=(NOTHING,), log_evidence=still)
        yield Hypothesis(families=(NOISE,), log_evidence=_sum([turned, spread + math.log(1.0 - share)]))
        yield Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=either)

    def _screened(self) -> dict[str, float]:
        """Return the log Bayes factor of each effect by the linear tests, the likeliest first."""
        found = {name: self._screen(name, self._fall(name)) for name in self.test.scores}
        return dict(sorted(found.items(), key=lambda each: -each[1]))

    def _screen(self, name: str, delta_chi2: float) -> float:
        """Return the log Bayes factor of an effect from its fall of chi-squared in the linear tests."""
        if name not in self.test.best:
            return 0.5 * delta_chi2 / self.inflation
        delta_chi2 = delta_chi2 / self.inflation
        return float(size_evidence(self._dof(name), delta_chi2)) + self._log_share((name,), delta_chi2)

    def _fall(self, name: str) -> float:
        """Return the fall of chi-squared of an effect; of a random walk, twice its gain in likelihood."""
        test = self.test
        if name in test.best:
            return float(test.scan.statistics[test.best[name]])
        return 2.0 * self.before.fit.walk_gain if name == self.walk else test.scores[name]

    def _dof(self, name: str) -> int:
        return self.test.candidate(name).dof if name in self.test.best else 1

    def _log_share(self, names: Sequence[str], delta_chi2: float) -> float:
        """Return the log of the mean of likelihood over the values of constants, relative to the best value."""
        return sum(self._log_share_of(name, delta_chi2) for name in names if name in self.test.best)

    def _log_share_of(self, name: str, delta_chi2: float) -> float:
        test = self.test
        own = self._values[name]
        tried = max(len(own), *(test.scan.candidates[k].tried for k in own))
        deltas = test.scan.statistics[own]
        relative = min(1.0, delta_chi2 / max(float(deltas.max()), 1e-9))
        return float(np.logaddexp.reduce(0.5 * relative * (deltas - deltas.max()))) - math.log(tried)

    def _effects(self, screened: Mapping[str, float]) -> Iterator[Hypothesis]:
        """Yield the rows of single effects."""
        columns = {name: log for name, log in screened.items() if name != self.walk}
        least = _least(columns.values())
        chosen = [name for name, log in columns.items() if log > least][: _MOST["effect"]]
        chosen += [*self._effects_that_turn(), *([self.walk] if self.walk else [])]
        yield from (self._single(name, screened) for name in dict.fromkeys(chosen))

    def _single(self, name: str, screened: Mapping[str, float]) -> Hypothesis:
        return self._row((name,), self._prior("effect", len(screened), name))

    def _effects_that_turn(self) -> list[str]:
        """Names of the effects that turn the platform and explain most of the misfit of the dwells' means, whatever
        its direction.

        Where the setting error was not stated, it is estimated from these turns, too, so that the linear tests give
        them little weight; and a turn that is not small is not linear along the specific force, where readings are
        most exact.
        """
        effects = {name: self.test.candidate(name).effect for name in self.test.best}
        effects = {name: effect for name, effect in effects.items() if isinstance(effect, FrameEffect)}
        linearised = self.before.fit.linearised
        left = unweighted_left(linearised, list(effects.values()))
        gains = -0.5 * (3 * len(linearised.dwells) - linearised.model.count) * np.log(np.maximum(left, 1e-12))
        likely = sorted(zip(gains.tolist(), effects, strict=True), reverse=True)[: _MOST["turn"]]
        return [name for gain, name in likely if gain > max(SCREEN_LOG_BF, likely[0][0] - SCREEN_LOG_BF)]

    def _pairs(self, screened: Mapping[str, float]) -> list[tuple[str, str]]:
        """Return the likeliest pairs, and the likeliest effects beside a random walk."""
        if len(screened) < 2:
            return []
        found = self._joint(screened)
        likely = sorted(found, key=lambda names: -found[names])[: _MOST["pair"]]
        least = _least(found.values())
        chosen = [names for names in likely if found[names] > least]
        walk = self.walk
        if walk and self.before.fit.walk_gain > 0.0:
            walked = self._refit((walk,))
            frames = self.refits.frames_beside_walk
            test = assess_candidates(walked.fit, self.test.effective_tests, frames=frames)
            beside = Hypotheses(self.refits, walked, test)
            own = [name for name in beside._screened() if name in beside.test.best]
            chosen += [(name, walk) for name in own[: _MOST["walk"]]]
        return chosen

    def _joint(self, screened: Mapping[str, float]) -> dict[tuple[str, str], float]:
        """Return the log Bayes factors of pairs by the linear tests: each effect at the value of its constant that is
        best alone, and the other at any value."""
        test, out = self.test, dict[tuple[str, str], float]()
        for name in filter(test.best.__contains__, screened):
            deltas, alone = test.scan.beside(test.best[name]) / self.inflation, self._screen(name, self._fall(name))
            logs = self._evidence(deltas)
            for other, own in self._values.items():
                k = own[int(np.argmax(logs[own]))]
                if other == name or not deltas[k] > 0.0:
                    continue
                both = (name, other) if screened[name] >= screened[other] else (other, name)
                log = alone + float(logs[k]) + self._log_share_of(other, float(deltas[k]))
                out[both] = max(out.get(both, -math.inf), log)
        return out

    def _evidence(self, deltas: Floats) -> Floats:
        """Return the log Bayes factors (n,) of all candidates of the linear tests from their falls of chi-squared."""
        dofs, out = np.array([each.dof for each in self.test.scan.candidates]), np.full(len(deltas), -math.inf)
        for dof in set(dofs[dofs > 0].tolist()):
            out[dofs == dof] = size_evidence(dof, deltas[dofs == dof])
        return out

    @cached_property
    def _values(self) -> dict[str, list[int]]:
        """Numbers of the candidates of each visible effect: one for each value of its constant."""
        return {name: own for name in self.test.best if (own := values_of(self.test.scan, name))}

    def _formulas(self, screened: Mapping[str, float]) -> Iterator[Hypothesis]:
        """Yield the rows of formulas that are no known effect, the likeliest of each driver."""
        known = [self.test.candidate(name).effect for name in self.test.best]
        taken = [effect.name for effect in self.before.model.effects]
        drivers = dict[str, list[Formulas]]()
        for each in self.refits.families(self.before.fit, known):
            if each.rank and not each.known:
                drivers.setdefault(each.driver, []).append(each)
        logs = {driver: self._over_members(own) for driver, own in drivers.items()}
        least = _least(log for name, log in screened.items() if name != self.walk)
        likely = sorted(drivers, key=lambda driver: -np.logaddexp.reduce(logs[driver]))[: _MOST["formula"]]
        for driver in likely:
            if logs[driver].max() < least:
                continue
            first = int(np.argmax(logs[driver]))
            share = float(np.logaddexp.reduce(logs[driver]) - logs[driver][first]) - math.log(len(logs[driver]))
            formulas = drivers[driver][first].formulas_beside(taken)
            row = self._row((), self._prior("formula", len(drivers)) + share, formulas)
            yield replace(row, driver=driver, families=(drivers[driver][first].family or NONE,))

    def _over_members(self, own: Sequence[Formulas]) -> Floats:
        """Return the log Bayes factors of the formulas of one driver by the linear tests."""
        return np.array([float(size_evidence(each.rank, each.delta_chi2 / self.inflation)) for each in own])

    def _row(self, effects: tuple[str, ...], log_prior: float, formulas: tuple[str, ...] = ()) -> Hypothesis:
        """Return the row of effects or formulas, refitted and weighed."""
        refit = self._refit((*effects, *formulas))
        found = self.evidence.of(refit.fit, walk=self.walk in effects)
        if not found:
            return Hypothesis(effects, formulas, log_evidence=-math.inf)
        logs = [own.log + self._log_share(effects, own.delta_chi2) for own in found]
        best: Weighed = found[int(np.argmax(logs))]
        walks, log = self.walk in effects, float(np.logaddexp.reduce(logs)) + log_prior
        log += self._within(effects, refit) if walks else 0.0
        delta_chi2 = best.delta_chi2 if best.dof else 2.0 * self.before.fit.walk_gain
        return Hypothesis(effects, formulas, "", self._families(effects), log, delta_chi2, best.dof + walks, refit)

    def _within(self, effects: Sequence[str], refit: Calibration) -> float:
        """Return the log odds of what a walk explains within dwells, where it goes on but has no column: trends that
        the other effects leave, less those that are left beside it."""
        if not self.test.trend:
            return 0.0
        others = tuple(name for name in effects if name != self.walk)
        before = trend(self._refit(others).fit) if others else self.test.trend
        return _log_odds(before) - _log_odds(trend(refit.fit))

    def _families(self, effects: Sequence[str]) -> tuple[str, ...]:
        """Return the families of effects, each once."""
        return tuple(dict.fromkeys(effect_named(name, self.before.bench).family for name in effects))

    def _refit(self, added: Sequence[str]) -> Calibration:
        return self.refits.with_effects(self.before, added)

    def _prior(self, kind: str, members: int, *effects: str) -> float:
        """Return the log of the prior probability of these effects, or formulas, among so many of their kind."""
        own = math.prod(effect_named(name, self.before.bench).prior for name in effects)
        return math.log(own * KINDS[kind] / max(members, 1))
