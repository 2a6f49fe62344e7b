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
from kf_calib.diagnosis.candidate_tests import CandidateTests, values_of
from kf_calib.diagnosis.coefficient_sizes import AddedEffects, size_evidence
from kf_calib.diagnosis.evidence import Evidence, MarginalLikelihood, log_odds_of_repeating
from kf_calib.diagnosis.hypothesis_table import (
    IRREGULAR,
    KINDS,
    NOISE,
    NONE,
    NOTHING,
    Hypothesis,
    HypothesisTable,
    table_of,
)
from kf_calib.diagnosis.refits import Refits, dwell_noise_is_stated
from kf_calib.diagnosis.unknown_effect import FormulaFamily, one_digit_seconds
from kf_calib.diagnosis.within_dwell_trend import DisturbedDwell, Trend, disturbed_dwell, trend
from kf_calib.dwells.qr import orthonormal
from kf_calib.effects import Effect, FrameEffect, Stimulus, effect_named, walk_named
from kf_calib.errors import UnobservableError
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import unweighted_left
from kf_calib.noise.reml import OF_ONE

_NO_NOISE = 0.1  # share of an unknown cause in scatter that was not stated
_AGAINST_STATED = 0.5  # the same of noise that contradicts what was stated: none is likelier than the other
_OF_ORIENTATION = 0.8  # share of such causes that depend on the orientation alone, and come back with it
_SHORT = 0.01  # prior probability of irregular changes that show within dwells only
_END = 0.99  # of the range of a constant
_IMPOSSIBLE_MPS2 = 1.0  # added to a reading by what is no parameter: a tenth of gravity
_UNHEARD_OF = 1e6  # times the greatest coefficient that is usual
_APART = 1e-4  # p-value of an oscillation that does not go on alike in all dwells
_OF_EFFECT = 6.0  # columns that an effect has
SCREEN_LOG_BF = 8.0  # rows further behind in log evidence are not refitted
NONLINEARITY_MARGIN = 0.02  # share of the log evidence by which they may be further behind, as large effects bend
_MOST = {"effect": 8, "attitude": 3, "pair": 4, "walk": 3, "formula": 3}


def log_odds_of(p_value: float) -> float:
    """The largest log odds that a p-value gives against what it tests: -ln(-e p ln p), 0 above 1/e (T. Sellke, M.
    Bayarri, J. Berger, 2001)."""
    p_value = max(p_value, 1e-300)
    return -math.log(-math.e * p_value * math.log(p_value)) if p_value < 1.0 / math.e else 0.0


def _log_odds(trends: Trend | None) -> float:
    """Return the log odds that trends within dwells give against a model that has none."""
    return log_odds_of(trends.p_value) if trends else 0.0


def _log_sum(logs: Sequence[float]) -> float:
    """Return the log of a sum from the logs of its terms."""
    return float(np.logaddexp.reduce([-math.inf, *logs]))


def dispersed(rows: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the rows; where the likeliest is of an effect beside a formula or an oscillation, and does not fit, with
    the differences of their log evidence divided by the overdispersion that it leaves.

    Formulas, and an oscillation of any frequency, follow much of what they are not. What is left shows that they are
    not exact, and as noise of that size it may favour an effect that makes up for them (quasi-likelihood: Burnham and
    Anderson, Model Selection and Multimodel Inference, 2002, section 2.5). The divisor is at most the degrees of
    freedom over the columns of an effect: by as much fewer numbers the rows differ in what they leave.
    """
    best = max(rows, key=lambda row: row.log_evidence)
    if best.refit is None or len(best.effects) + bool(best.formulas) < 2:
        return [*rows]
    oscillating = any(effect.oscillates for effect in best.refit.model.effects if str(effect) in best.effects)
    if not (best.formulas or oscillating):
        return [*rows]
    log, left = best.log_evidence, best.refit.consistency
    divisor = max(min(left.overdispersion, left.dof / _OF_EFFECT), 1.0)
    return [replace(row, log_evidence=log + (row.log_evidence - log) / divisor) for row in rows]


def _screening_limit(logs: Iterable[float]) -> float:
    """Return the log evidence by the linear tests from which a row is refitted."""
    best = max(logs, default=0.0)
    return best - SCREEN_LOG_BF - NONLINEARITY_MARGIN * max(best, 0.0)


class Hypotheses:
    """Makes the rows of one run.

    refits: those of the run. before: the run without what is missing. test: its linear tests.
    """

    def __init__(self, refits: Refits, before: Calibration, test: CandidateTests) -> None:
        self.refits, self.before, self.test, self.effects = refits, before, test, test.effects
        self.evidence, self.inflation = Evidence(before.fit), 1.0
        self.walk = "" if before.model.walks else walk_named(before.bench)
        self.stated = dwell_noise_is_stated(before)
        self._disturbed = list[tuple[float, DisturbedDwell]]()  # with the log evidence of rows that are left out for it

    def table(self) -> HypothesisTable:
        """The table with the likeliest rows refitted."""
        best = next((name for name in self._log_bayes_of_effects() if name in self.effects.best), None)
        if best is not None:  # what even the best effect leaves makes every fall less significant
            consistency = self._refit((best,)).consistency
            self.inflation = max(1.0, consistency.statistic / consistency.dof) if consistency.dof > 0 else 1.0
        effects = self._log_bayes_of_effects()
        pairs = self._pairs(effects)
        rows = [*self._without_effects(), *self._effects(effects), *self._formulas(effects)]
        rows += [self._row(names, self._prior("pair", math.comb(len(effects), 2), *names)) for names in pairs]
        likeliest, refitted = max(rows, key=lambda row: row.log_evidence), {row.effects for row in rows}
        rows += [self._single(name, effects) for name in likeliest.effects if (name,) not in refitted]
        rows += self._beside_unknown(rows, effects)
        rows = [row for row in rows if math.isfinite(row.log_evidence)]
        least = max(row.log_evidence for row in rows) - SCREEN_LOG_BF
        walks = [row for row in rows if row.effects == (self.walk,) and row.log_evidence > least]
        rows += [row for walk in walks if self.stated for row in self._gauss_markov(walk)]
        best = max(row.log_evidence for row in rows)
        disturbed = max((each for each in self._disturbed if each[0] > best), key=lambda each: each[0], default=None)
        table = table_of(dispersed(rows))
        return replace(table, disturbed=disturbed[1] if disturbed else None, scattering=self._scattering())

    def _gauss_markov(self, walk: Hypothesis) -> Iterator[Hypothesis]:
        """Yield the row of biases that move irregularly and return to their mean after any time, from that of a random
        walk; none where no walk is likelier than none."""
        assert walk.refit is not None
        gains, times_s = walk.refit.fit.gauss_markov_gains
        driver = f"time (irregular, back within about {one_digit_seconds(float(times_s[np.argmax(gains)]))})"
        prior = self._prior("effect", len(self.effects.scores), self.walk)
        prior += math.log(KINDS["formula"] / KINDS["effect"])
        for marginal in self.evidence.of(walk.refit.fit, walk=True):
            if not marginal.parts:  # the gains are over a walk that nothing else explains
                log = marginal.log + float(np.logaddexp.reduce(gains)) - math.log(len(gains)) + prior
                log += self._log_odds_within_dwells(walk.refit)
                yield Hypothesis(driver=driver, families=walk.families, log_evidence=log)

    def quick_table(self) -> HypothesisTable:
        """The table of nothing, noise and single effects by the linear tests alone, for a run with no misfit."""
        rows, prior = list(self._without_effects()), partial(self._prior, "effect", len(self.effects.scores))
        log_nothing = rows[0].log_evidence - math.log(KINDS["nothing"])
        rows += [
            Hypothesis((name,), families=self._families((name,)), log_evidence=log_nothing + log_bayes + prior(name),
                       statistic=self._delta_chi2(name), dof=self._dof(name))
            for name, log_bayes in self._log_bayes_of_effects().items()
        ]  # fmt: skip
        return table_of(rows)

    def _without_effects(self) -> Iterator[Hypothesis]:
        """Yield the rows without an effect: nothing, noise that was not stated, and irregular changes."""
        marginals, prior = self._of_noise, math.log(KINDS["nothing"])
        log_nothing = float(next(marginal.log for marginal in marginals if not marginal.parts)) + prior
        logs_noise, logs_irregular = list[float](), [log_nothing + math.log(_SHORT)]
        for marginal in (each for each in marginals if each.parts):
            share = self._share_of_unknown(marginal)
            logs_noise.append(marginal.log + prior + math.log(1.0 - share))
            logs_irregular += [marginal.log + prior + math.log(share)] if share else []
        log_irregular = _log_sum(logs_irregular)
        log_irregular += _log_odds(self.test.trend)
        yield Hypothesis(families=(NOTHING,), log_evidence=log_nothing)
        yield Hypothesis(families=(NOISE,), log_evidence=_log_sum(logs_noise))
        yield Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=log_irregular)

    @cached_property
    def _of_noise(self) -> list[MarginalLikelihood]:
        """The evidence of the model without further effects, for each set of free parts of the noise."""
        return self.evidence.of()

    def _scattering(self) -> int:
        """Return the number of the accelerometer that alone scatters, where that is the likeliest noise; else 0."""
        likeliest = max(self._of_noise, key=lambda marginal: marginal.log if marginal.parts else -math.inf)
        part = likeliest.parts[0] if likeliest.parts else ""
        return OF_ONE.index(part) + 1 if part in OF_ONE else 0

    def _share_of_unknown(self, noise: MarginalLikelihood) -> float:
        """Return the share of an unknown cause in these parts of the noise from dwell to dwell.

        Where they contradict what was stated, a cause that differs from orientation to orientation explains as much,
        unless repeated orientations tell. Four of five such causes depend on the orientation alone.
        """
        stated = {"setting": self.before.noise.setting_stated}
        stated |= dict.fromkeys(("common", *OF_ONE), self.before.noise.scatter_stated)
        if not any(stated[part] for part in noise.parts if part in stated):
            return 0.0 if noise.parts == ("setting",) else _NO_NOISE
        repeats = math.exp(min(log_odds_of_repeating(self.before, noise), 100.0))
        unknown = _AGAINST_STATED * (1.0 - _OF_ORIENTATION + _OF_ORIENTATION * repeats)
        return unknown / (unknown + 1.0 - _AGAINST_STATED)

    def _log_bayes_of_effects(self) -> dict[str, float]:
        """Return the log Bayes factor of each effect by the linear tests, the likeliest first."""
        log_bayes = {name: self._log_bayes(name, self._delta_chi2(name)) for name in self.effects.scores}
        return dict(sorted(log_bayes.items(), key=lambda each: -each[1]))

    def _log_bayes(self, name: str, delta_chi2: float) -> float:
        """Return the log Bayes factor of an effect from its fall of chi-squared in the linear tests."""
        delta_chi2 = delta_chi2 / self.inflation
        if name not in self.effects.best:
            return 0.5 * delta_chi2
        candidate, scale = self.effects.candidate(name), self.inflation**-0.5
        if not candidate.dof:
            return float(size_evidence(0, delta_chi2))
        basis, root = orthonormal(candidate.columns * scale)
        sizes = AddedEffects([candidate.effect], self.evidence.grade, candidate.dof)
        log = sizes.log_bayes(delta_chi2, root, basis.T @ self.effects.scan.residual * scale)
        return log + self._log_share((name,), delta_chi2)

    def _delta_chi2(self, name: str) -> float:
        """Return the fall of chi-squared of an effect; of a random walk, twice its gain in likelihood."""
        if name in self.effects.best:
            return float(self.effects.scan.statistics[self.effects.best[name]])
        return 2.0 * self.before.fit.walk_gain if name == self.walk else self.effects.scores[name]

    def _dof(self, name: str) -> int:
        return self.effects.candidate(name).dof if name in self.effects.best else 1

    def _log_share(self, names: Sequence[str], delta_chi2: float) -> float:
        """Return the log of the mean of likelihood over the values of constants, relative to the best value."""
        return sum(self._log_share_of(name, delta_chi2) for name in names if name in self.effects.best)

    def _log_share_of(self, name: str, delta_chi2: float) -> float:
        deltas, log_priors, log_norm = self._constants[name]
        relative = min(1.0, delta_chi2 / max(float(deltas.max()), 1e-9))
        return float(np.logaddexp.reduce(0.5 * relative * (deltas - deltas.max()) + log_priors)) - log_norm

    @cached_property
    def _constants(self) -> dict[str, tuple[Floats, Floats, float]]:
        """Of each visible effect: falls of chi-squared (n,) at the values of its constant, the logs of their priors
        (n,), and the log of the sum of these over as many values as were tried."""
        scan, constants = self.effects.scan, dict[str, tuple[Floats, Floats, float]]()
        for name, numbers in self._numbers.items():
            tried = max(len(numbers), *(scan.candidates[k].tried for k in numbers))
            log_priors = np.array([self._log_prior_of_constant(scan.candidates[k].effect) for k in numbers])
            log_norm = float(np.logaddexp.reduce(log_priors)) + math.log(tried / len(numbers))
            constants[name] = scan.statistics[numbers], log_priors, log_norm
        return constants

    def _log_prior_of_constant(self, effect: Effect) -> float:
        """Return the log of the prior of an effect's constant, 0 but for time constants longer than the effect goes on
        in this run: the density falls by as much as they are longer."""
        return -math.log(max(effect.value / effect.acts_for_s(self._stimulus), 1.0))

    @cached_property
    def _stimulus(self) -> Stimulus:
        linearised = self.before.fit.linearised
        return stimulus_of(linearised.dwells, self.before.bench, linearised.state)

    def _effects(self, screened: Mapping[str, float]) -> Iterator[Hypothesis]:
        """Yield the rows of single effects."""
        columns = {name: log for name, log in screened.items() if name != self.walk}
        limit = _screening_limit(columns.values())
        names = [name for name, log in columns.items() if log > limit][: _MOST["effect"]]
        names += [*self._attitude_effects(), *([self.walk] if self.walk else [])]
        yield from (self._single(name, screened) for name in dict.fromkeys(names))

    def _single(self, name: str, screened: Mapping[str, float]) -> Hypothesis:
        return self._row((name,), self._prior("effect", len(screened), name))

    def _attitude_effects(self) -> list[str]:
        """Names of the effects of the platform's attitude that explain most of the residuals of the dwells' means, all
        directions weighed alike.

        Where the setting error was not stated, it is estimated from the same residuals, so that the linear tests give
        these effects little weight. And a rotation that is not small is not linear along the specific force, where
        readings are most exact.
        """
        effects = {name: self.effects.candidate(name).effect for name in self.effects.best}
        effects = {name: effect for name, effect in effects.items() if isinstance(effect, FrameEffect)}
        linearised = self.before.fit.linearised
        unexplained = unweighted_left(linearised, list(effects.values()))
        gains = -0.5 * (3 * len(linearised.dwells) - linearised.model.count) * np.log(np.maximum(unexplained, 1e-12))
        ranked = sorted(zip(gains.tolist(), effects, strict=True), reverse=True)[: _MOST["attitude"]]
        return [name for gain, name in ranked if gain > max(SCREEN_LOG_BF, ranked[0][0] - SCREEN_LOG_BF)]

    def _pairs(self, screened: Mapping[str, float]) -> list[tuple[str, str]]:
        """Return the likeliest pairs, and the likeliest effects beside a random walk."""
        if len(screened) < 2:
            return []
        log_bayes = self._log_bayes_of_pairs(screened)
        ranked = sorted(log_bayes, key=lambda names: -log_bayes[names])[: _MOST["pair"]]
        limit = _screening_limit(log_bayes.values())
        pairs = [names for names in ranked if log_bayes[names] > limit]
        if self.walk and self.before.fit.walk_gain > 0.0:
            pairs += [(name, self.walk) for name in self._likeliest_beside_walk()]
        return pairs

    def _likeliest_beside_walk(self) -> list[str]:
        """Return the effects that are likeliest beside a random walk."""
        with_walk = self._refit((self.walk,))
        test = self.refits.assess_beside_walk(with_walk, self.effects.independent_tests)
        beside = Hypotheses(self.refits, with_walk, test)
        # an effect may be visible beside the walk only, where the noise is another
        visible = beside._numbers.keys() & self._numbers.keys()
        log_bayes = {name: log for name, log in beside._log_bayes_of_effects().items() if name in visible}
        limit = _screening_limit(log_bayes.values())
        return [name for name, log in log_bayes.items() if log > limit][: _MOST["walk"]]

    def _log_bayes_of_pairs(self, screened: Mapping[str, float]) -> dict[tuple[str, str], float]:
        """Return the log Bayes factors of pairs by the linear tests: each effect at the value of its constant that is
        best alone, and the other at any value."""
        best, log_bayes = self.effects.best, dict[tuple[str, str], float]()
        for name in filter(best.__contains__, screened):
            alone = self._log_bayes(name, self._delta_chi2(name))
            deltas = self.effects.scan.beside(best[name]) / self.inflation
            logs = self._log_bayes_of_candidates(deltas)
            for other, numbers in self._numbers.items():
                k = numbers[int(np.argmax(logs[numbers]))]
                if other == name or not deltas[k] > 0.0:
                    continue
                pair = (name, other) if screened[name] >= screened[other] else (other, name)
                log = alone + float(logs[k]) + self._log_share_of(other, float(deltas[k]))
                log_bayes[pair] = max(log_bayes.get(pair, -math.inf), log)
        return log_bayes

    def _log_bayes_of_candidates(self, deltas: Floats) -> Floats:
        """Return the log Bayes factors (n,) of all candidates of the linear tests from their falls of chi-squared."""
        dofs = np.array([candidate.dof for candidate in self.effects.scan.candidates])
        log_bayes = np.full(len(deltas), -math.inf)
        for dof in set(dofs[dofs > 0].tolist()):
            log_bayes[dofs == dof] = size_evidence(dof, deltas[dofs == dof])
        return log_bayes

    @cached_property
    def _numbers(self) -> dict[str, list[int]]:
        """Numbers of the candidates of each visible effect: one for each value of its constant."""
        return {name: numbers for name in self.effects.best if (numbers := values_of(self.effects.scan, name))}

    def _beside_unknown(self, rows: Sequence[Hypothesis], screened: Mapping[str, float]) -> Iterator[Hypothesis]:
        """Yield the rows of the likeliest effects, each beside a formula that is no known effect; none where one effect
        alone is the likeliest and leaves no misfit."""
        with_effects = (row for row in rows if row.effects and row.refit)
        likeliest = max(with_effects, key=lambda row: row.log_evidence, default=None)
        if likeliest is None or likeliest.refit is None:
            return
        if len(likeliest.effects) == 1 and likeliest.refit.consistency.consistent:
            return
        for name in likeliest.effects:
            if name != self.walk:
                yield from self._formulas(screened, name)

    def _formulas(self, screened: Mapping[str, float], beside: str = "") -> Iterator[Hypothesis]:
        """Yield the rows of formulas that are no known effect, the likeliest of each driver; ``beside``: a known effect
        that is missing, too."""
        known = (beside,) if beside else ()
        before = self._refit(known) if beside else self.before
        kind, count = ("beside", len(screened)) if beside else ("formula", 1)
        effects = [self.effects.candidate(name).effect for name in self.effects.best]
        # at the end of the range of its constant an effect is the limit of another one, which may be a formula
        effects = [each for each in effects if each.unknown is None or each.value < _END * each.unknown.high]
        names_in_model = [effect.name for effect in before.model.effects]
        drivers = dict[str, list[FormulaFamily]]()
        for family in self.refits.families(before.fit, effects):
            if family.rank and not family.known:
                drivers.setdefault(family.driver, []).append(family)
        logs = {driver: self._log_bayes_of_formulas(families) for driver, families in drivers.items()}
        limit = 0.0 if beside else _screening_limit(log for name, log in screened.items() if name != self.walk)
        means = {driver: float(np.logaddexp.reduce(own)) - math.log(len(own)) for driver, own in logs.items()}
        for driver in sorted(drivers, key=lambda driver: -means[driver])[: _MOST["formula"]]:
            if logs[driver].max() < limit:
                continue
            best = int(np.argmax(logs[driver]))
            share = means[driver] - float(logs[driver][best])
            formulas = drivers[driver][best].formulas_beside(names_in_model)
            row = self._row(known, self._prior(kind, count * len(drivers), *known) + share, formulas)
            family = drivers[driver][best].family or NONE
            if family in self._families(known):  # a known effect of the same family makes up for the formula's shape
                row = replace(row, effects=(), refit=row.refit and self._refit(formulas))
            yield replace(row, driver=driver, families=tuple(dict.fromkeys([*self._families(row.effects), family])))

    def _log_bayes_of_formulas(self, families: Sequence[FormulaFamily]) -> Floats:
        """Return the log Bayes factors of the formulas of one driver by the linear tests."""
        return np.array([float(size_evidence(each.rank, each.delta_chi2 / self.inflation)) for each in families])

    def _row(self, effects: tuple[str, ...], log_prior: float, formulas: tuple[str, ...] = ()) -> Hypothesis:
        """Return the row of effects or formulas, refitted and weighed."""
        try:
            refit = self._refit((*effects, *formulas))
        except UnobservableError:  # the run does not tell its coefficients: nothing speaks for it
            return Hypothesis(effects, formulas, log_evidence=-math.inf)
        if self._is_impossible(refit, effects, formulas):
            return Hypothesis(effects, formulas, log_evidence=-math.inf)
        marginals = self.evidence.of(refit.fit, walk=self.walk in effects)
        if not marginals:
            return Hypothesis(effects, formulas, log_evidence=-math.inf)
        logs = [marginal.log + self._log_share(effects, marginal.delta_chi2) for marginal in marginals]
        best: MarginalLikelihood = marginals[int(np.argmax(logs))]
        walks, log = self.walk in effects, float(np.logaddexp.reduce(logs)) + log_prior
        log += self._log_odds_within_dwells(refit) if walks else 0.0
        delta_chi2 = best.delta_chi2 if best.dof else 2.0 * self.before.fit.walk_gain
        if refit.model.oscillates and not self.before.model.oscillates:
            disturbed = disturbed_dwell(refit.fit)
            if disturbed.p_value < _APART:
                self._disturbed.append((log, disturbed))
                return Hypothesis(effects, formulas, log_evidence=-math.inf)
        return Hypothesis(effects, formulas, "", self._families(effects), log, delta_chi2, best.dof + walks, refit)

    def _is_impossible(self, refit: Calibration, effects: Sequence[str], formulas: Sequence[str]) -> bool:
        """Tell whether what a refit adds is what no sensor could have.

        A formula may be nearly the same as one of the parameters, and follow what else is missing by the little in
        which it is not. An effect whose coefficients are far beyond any size that is usual is another one.
        """
        names, parameters = {text.partition("=")[0].strip() for text in formulas}, refit.parameters
        for effect in refit.model.effects:
            coefficients = [parameters[coefficient.symbol] for coefficient in effect.coefficients]
            values = np.array([coefficient.value or 0.0 for coefficient in coefficients])
            if str(effect) in names and np.abs(effect.added(self._stimulus, values)).max() > _IMPOSSIBLE_MPS2:
                return True
            usual = effect.typical.of(self.evidence.grade) or effect.typical.navigation
            least = np.abs(values) - 2.0 * np.array([coefficient.sigma or 0.0 for coefficient in coefficients])
            if str(effect) in effects and usual and least.max(initial=0.0) > _UNHEARD_OF * usual[1]:
                return True
        return False

    def _log_odds_within_dwells(self, refit: Calibration) -> float:
        """Return the log odds of what a walk explains within dwells, where it goes on but has no column.

        They are the ratio of the densities of the trends with the walk and without it: a walk that should move the
        readings within dwells, and does not, is none. They are no more than the p-values of both allow, as that of any
        irregular change is. Without it, the trends are those that the same columns leave in the noise of the run, or
        those without its effects, if these are smaller: coefficients that are hardly determined may be far off.
        """
        if not self.test.trend:
            return 0.0
        noise = replace(self.before.noise, sensitivity_mps2_per_k=refit.noise.sensitivity_mps2_per_k)
        beside, walking = trend(replace(refit.fit, noise=noise)), trend(refit.fit)
        if beside is None or walking is None:
            return 0.0
        standing = max(beside, self.test.trend, key=lambda each: each.log_density)
        return min(walking.log_density - standing.log_density, _log_odds(standing) - _log_odds(walking))

    def _families(self, effects: Sequence[str]) -> tuple[str, ...]:
        """Return the families of effects, each once."""
        return tuple(dict.fromkeys(effect_named(name, self.before.bench).family for name in effects))

    def _refit(self, added: Sequence[str]) -> Calibration:
        return self.refits.with_effects(self.before, added)

    def _prior(self, kind: str, members: int, *effects: str) -> float:
        """Return the log of the prior probability of these effects, or formulas, among so many of their kind."""
        weight = math.prod(effect_named(name, self.before.bench).prior for name in effects)
        return math.log(weight * KINDS[kind] / max(members, 1))
