"""The posterior over explanations of a misfit: nothing, noise, effects, pairs of them, unknown functions, one dwell.

Each explanation is a set of terms in one likelihood (``run_likelihood``), averaged over their sizes and over the noise
from dwell to dwell. All are weighed where the run was fitted, and the likeliest again where their own fit is, because
large effects are not linear. The prior of a kind is shared among its members, so that a hundred unknown functions do
not outvote one effect.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag

from kf_calib.bench.arrays import Floats, Indices, portions
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.diagnosis.coefficient_sizes import best_sigma, usual_sizes
from kf_calib.diagnosis.dwells_apart import DwellsApart
from kf_calib.diagnosis.hypothesis_table import (
    AS_WELL,
    IRREGULAR,
    KINDS,
    LISTED,
    NOISE,
    NONE,
    NOTHING,
    PRIOR,
    SURE,
    Hypothesis,
    HypothesisTable,
    table_of,
)
from kf_calib.diagnosis.in_noises import ROUNDING, InNoises, Spanned
from kf_calib.diagnosis.noise_sizes import INDEPENDENT, NoiseFamily, NoiseSizes
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.run_likelihood import Projected, RunLikelihood, log_bayes_together
from kf_calib.diagnosis.run_terms import (
    RunTerm,
    RunTerms,
    log_bayes_of_columns,
    of_bearers,
    sizes_of,
)
from kf_calib.diagnosis.unknown_terms import name_of_formula, text_named
from kf_calib.diagnosis.within_rows import Courses
from kf_calib.effects import Effect, effect_named
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.axes_across import AxesAcross
from kf_calib.estimation.observability import impossible_size
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.within_dwell_trend import p_of_steady_oscillation, trend
from kf_calib.noise.terms import RandomWalk, ThermometerError
from kf_calib.support import stage
from kf_calib.support.tail_probabilities import CLEAR, LEVEL, chi_squared_tail, log_odds_of
from kf_calib.support.text import listing

_IRREGULAR = 0.1  # share of an unknown cause in scatter that was not stated
_BESIDE = 2  # rows of effects, and of unknown functions, beside which dwells are tried
_AGAINST_STATED = 0.5  # the same of scatter beyond what was stated
_OF_ORIENTATION = 0.8  # share of unknown causes that depend on the orientation alone, and come back with it
_INEXACT = 0.1  # share of functions that each arrival changes by another amount
_WITHIN = 0.01  # prior probability of irregular changes that show within dwells only
_HEADS = 3  # effects beside which all other terms are tried: likeliest in any noise, in that stated, and in pairs
_NO_SIGN, _ONE = 0.5, 1e-3  # what is left of an effect beside one that is the same: of chi-squared, and a share
_SAME = 1e-6  # squared sine of the angle below which two effects are one
_REFITTED, _ALWAYS = 8, 3  # rows of effects that are fitted at most, and single ones that always are
_BEHIND, _BENT = 10.0, 0.02  # in log evidence, and share of the gain: rows further behind are not fitted
_NODES = {1: 16, 2: 16, 3: 8}  # sizes of each of so many effects
_ROUNDING, _UNSEEN = 1e-5, 1e-3  # least scatter over the misfit: where noise within dwells was seen, and where not
_AT_ONCE = 8  # sizes of noise, of which the products of all columns are copied
_SUMMANDS, _MORE = 3, 3.0  # formulas that describe an unknown function at most, and what each has to gain

_Fitted = tuple[Hypothesis, Spanned, Courses]
_Head = tuple[int, ...]
_Rows = dict[frozenset[str], tuple[float, tuple[str, ...]]]


class RunPosterior:
    """The posterior of one run.

    refits: those of the run. before: the run without what is missing. test: its linear tests.
    """

    def __init__(self, refits: Refits, before: Calibration, test: CandidateTests) -> None:
        self._refits, self._before, self._test = refits, before, test
        self._noise = before.noise.without_estimates().without(RandomWalk)
        misfit_mps2 = float(np.sqrt(np.mean(before.residuals_mps2**2)))
        self._least_mps2 = (_ROUNDING if before.noise.within_seen else _UNSEEN) * misfit_mps2
        self._run = RunTerms(before, self._noise, self._least_mps2, test, self._with_constants())
        self._sizes = NoiseSizes(self._run.likelihood, self._noise, before.consistency.dof, self._turns())
        self._refused = set[str]()
        self._of_refits = dict[tuple[str, ...], tuple[RunLikelihood, Floats, Floats, Floats]]()

    def _turns(self) -> dict[str, Floats]:
        """Return the change (D, 3) of the dwells' means by a turn of each gimbal, where the run shows it."""
        bench, run = self._before.model.bench, self._run
        gimbals = range(1, len(bench.axes) + 1) if bench.angles else ()
        turns = {f"gimbal {k}": run.likelihood.turned_by(run.formula_of(f":{k} = 1")) for k in gimbals}
        return {name: turn for name, turn in turns.items() if turn is not None}

    def table(self, refitted: bool = True) -> HypothesisTable:
        """All rows with their probabilities; the likeliest are fitted if ``refitted``."""
        stage.say(f"weighing {len(self._run.terms)} explanations in {len(self._sizes.covariances)} noises")
        rows = [*self._without_terms(), *self._singles(), *self._dwells_apart()]
        if refitted:
            rows = self._fitted(_merged([*rows, *self._several()]))
            fitted = self._likeliest_fitted(rows)
            rows = _with_sure_dwells(self._with_changes_within(rows, fitted), self._dwells_beside(rows, fitted))
        rows = [row for row in rows if math.isfinite(row.log_evidence)]
        table = replace(table_of(rows), scattering=self._scattering)
        return replace(table, same=self._same_as(table.first)) if refitted else table

    def _same_as(self, first: Hypothesis) -> tuple[str, ...]:
        """Return the effects that explain just what a single effect does, whether they have it as their only column or
        as one of several: what the effect explains with other columns than theirs is no more than noise."""
        if len(first.effects) != 1 or first.formulas or first.effects[0] not in self._best:
            return ()
        (name,) = first.effects
        number = self._best[name]
        noise = self._likeliest_noise(number)
        others = [
            other for other in self._run.names if other != name and other != self._run.walk and other in self._best
        ]
        bases, readings = self._run.bases([number, *(self._best[other] for other in others)], noise)
        along, rank = bases[0] @ readings, int(bases[0].any(axis=1).sum())
        turns, cosines, _ = np.linalg.svd(bases[0] @ np.swapaxes(bases[1:], 1, 2))
        shared = 1.0 - cosines**2 < min(_ONE, _NO_SIGN / max(float(along @ along), 1e-300))
        apart = np.sum(np.where(shared, 0.0, along @ turns) ** 2, axis=1)
        alone = rank - shared.sum(axis=1)
        return tuple(
            other for other, dof, statistic in zip(others, alone.tolist(), apart.tolist(), strict=True)
            if dof < rank and (not dof or chi_squared_tail(dof, statistic) > LEVEL)
        )  # fmt: skip

    def _with_constants(self) -> list[tuple[Effect, float]]:
        """Return those of the effects that explain most that have a constant, as they are fitted, and the sigma of the
        log of the constant; none where nothing has to be missing."""
        fitted = list[tuple[Effect, float]]()
        if self._test.consistent is not False:
            return fitted
        most = sorted(self._test.effects.best, key=lambda name: -self._tested(name)[0])[:_ALWAYS]
        for name in (name for name in most if effect_named(name, self._before.bench).unknown):
            try:
                refit = self._refits.with_effects(self._before, (name,))
            except UnobservableError:  # the run does not tell its coefficients
                continue
            effect, place = refit.model.effects[-1], refit.model.parts[name].start
            constant = refit.parameters[effect.unknown.symbol] if effect.unknown else None
            if constant is not None and constant.value is not None and effect.smooth and not effect.held:
                fitted.append((effect, float(refit.fit.sigma[place + len(effect.coefficients)])))
        return fitted

    # The noise in which rows are weighed

    @cached_property
    def _noises(self) -> list[InNoises]:
        """The products of all columns in the noises of each family."""
        return self._sizes.in_families(self._run.in_noises)

    @property
    def _firsts(self) -> list[int]:
        """The number, among all noises, of the first of each family."""
        return [0, *itertools.accumulate(len(noises.logs) for noises in self._noises)][:-1]

    @cached_property
    def _base(self) -> Floats:
        """Log likelihoods (noises,) without any term."""
        return np.concatenate([noises.logs for noises in self._noises])

    @cached_property
    def _log_bayes(self) -> Floats:
        """Log Bayes factors (terms, noises) of all terms."""
        few = [(noises, part) for noises in self._noises for part in portions(len(noises), _AT_ONCE)]
        return np.hstack([self._run.log_bayes(noises, range(len(noises))[part]) for noises, part in few])

    @cached_property
    def _log_evidence(self) -> Floats:
        """Log evidence (terms,) of all terms, without their priors."""
        return np.logaddexp.reduce(self._sizes.evidence(self._base + self._log_bayes), axis=1)

    @cached_property
    def _without(self) -> Floats:
        """Log evidence (families,) of no term."""
        return self._sizes.evidence(self._base[None])[0]

    def _likeliest_noise(self, k: int) -> Floats | None:
        """The covariances (D, 3, 3) of the noise that is likeliest beside a term, in units of that stated."""
        return self._sizes.covariances[int(np.argmax(self._base + self._log_bayes[k]))]

    # Rows

    def _without_terms(self) -> list[Hypothesis]:
        """Return the rows without a term: nothing, noise, and causes that change irregularly from dwell to dwell."""
        prior, of_noise, irregular = math.log(PRIOR["nothing"]), list[float](), list[float]()
        noises = [(family, float(log)) for family, log in zip(self._sizes.families, self._without, strict=True)]
        irregular.append(noises[0][1] + prior + math.log(_WITHIN))
        for family, log in (*noises[1:], *((family, log) for _, family, log in self._sizes.of_one)):
            share = self._share_of_unknown(family)
            of_noise.append(log + prior + math.log(1.0 - share))
            irregular += [log + prior + math.log(share)] if share else []
        within = max(self._run.likelihood.courses.log_bayes_alike, 0.0)  # it need not change within dwells
        log_nothing, log_irregular = noises[0][1] + prior, _log_sum(irregular) + within
        if self._test.consistent is False:  # chance, or a cause of which there is no term: at least as p has it
            odds = log_odds_of(self._test.p_value or 0.0) + math.log(PRIOR["unknown"] / PRIOR["nothing"])
            if log_irregular - log_nothing < odds:
                both = float(np.logaddexp(log_irregular, log_nothing))
                log_nothing, log_irregular = (both - float(np.logaddexp(0.0, sign * odds)) for sign in (1.0, -1.0))
        rows = [
            Hypothesis(families=(NOTHING,), log_evidence=log_nothing),
            Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=log_irregular),
        ]
        return [*rows, Hypothesis(families=(NOISE,), log_evidence=_log_sum(of_noise))] if of_noise else rows

    def _share_of_unknown(self, family: NoiseFamily) -> float:
        """Return the share of an unknown cause in noise: in setting errors that nobody stated none, which are usual."""
        stated = {"setting": self._noise.setting.stated}
        if any(stated.get(part, self._noise.scatter.stated) for part in family.parts):
            others = 1.0 - _OF_ORIENTATION if self._run.repeats else 1.0  # which has a row of its own
            return others * _AGAINST_STATED / (others * _AGAINST_STATED + 1.0 - _AGAINST_STATED)
        return 0.0 if family.parts == ("setting",) else _IRREGULAR

    @property
    def _scattering(self) -> str:
        """The accelerometer, or the gimbal, that alone scatters, where that is the likeliest noise; else ""."""
        logs = {name: log for name, _, log in self._sizes.of_one}
        name = max(logs, key=logs.__getitem__, default="")
        return name if name and logs[name] > self._without[1:].max() else ""

    def _singles(self) -> list[Hypothesis]:
        """Return the rows of one term each."""
        return [self._row_of((row,), log) for row, log in self._by_row(self._log_evidence).items()]

    def _by_row(self, logs: Floats) -> dict[str, float]:
        """Return the log evidence of each row from those of its terms."""
        of_row = dict[str, list[float]]()
        for term, log in zip(self._run.terms, logs.tolist(), strict=True):
            of_row.setdefault(term.row, []).append(log + term.log_share)
        return {row: _log_sum(values) for row, values in of_row.items()}

    def _row_of(self, names: Sequence[str], log: float) -> Hypothesis:
        """Return the row of some effects and unknown functions, with its prior."""
        effects = tuple(each for name in names if not name.startswith("?") for each in self._run.effects_of(name))
        unknown = [self._run.unknown[int(name[1:])] for name in names if name.startswith("?")]
        families = [self._effects[name].family for name in effects]
        families += [term.family or NONE for term in unknown]
        log += self._log_prior(effects, len(unknown))
        tested = [self._tested(name) for name in effects]
        statistic, dof = tested[0][0] if len(names) == len(effects) == 1 else 0.0, sum(dof for _, dof in tested)
        driver = AS_WELL.join(sorted(term.driver for term in unknown))
        return Hypothesis(effects, (), driver, tuple(dict.fromkeys(families)), log, statistic, dof)

    @cached_property
    def _effects(self) -> dict[str, Effect]:
        """The effects that the run may have, by their names."""
        return {name: effect_named(name, self._before.bench) for name in self._run.names}

    def _log_prior(self, effects: Sequence[str], functions: int = 0) -> float:
        """Return the log of the prior probability of some effects and unknown functions."""
        causes, unknown = max(self._run.causes, 3), len(self._run.unknown)
        prior = math.prod(self._effects[name].prior for name in effects)
        known = len(self._run.causes_of(effects))
        among = math.comb(causes, known) * math.comb(unknown, functions)
        return math.log(PRIOR[KINDS[known, functions]] * prior / among)

    def _tested(self, name: str) -> tuple[float, int]:
        """Return the fall of chi-squared by an effect in the linear tests, and its degrees of freedom."""
        effects = self._test.effects
        if name in effects.best:
            return float(effects.scan.statistics[effects.best[name]]), effects.candidate(name).dof
        return 2.0 * self._before.fit.walk_gain, 1

    def _dwells_apart(self) -> list[Hypothesis]:
        """Return the rows of dwells that are off, and nothing else is missing."""
        run, rows = self._run.likelihood, list[Hypothesis]()
        found = DwellsApart(run.spanned, run.courses, self._noises, self._sizes).rows_of_dwells()
        likeliest = max((log for log, _ in found), default=0.0)
        for log, places in ((log, places) for log, places in found if log > likeliest - _BEHIND):
            numbers = self._numbers(places)
            words = f"dwell{'s' * (len(numbers) > 1)} {listing(map(str, sorted(numbers)))} alone"
            rows.append(Hypothesis(driver=words, families=(NONE,), log_evidence=log, dwells=numbers))
        return rows

    def _numbers(self, places: Sequence[int]) -> tuple[int, ...]:
        """Return the numbers of some of the dwells."""
        return tuple(self._before.fit.dwells[k].number for k in places)

    def _dwells_beside(self, rows: Sequence[Hypothesis], fitted: Sequence[_Fitted]) -> list[Hypothesis]:
        """Return the rows of dwells that are off beside the likeliest effects, and unknown functions."""
        likeliest = sorted(rows, key=lambda row: -row.log_evidence)
        unknown = [row for row in likeliest if self._number(row) is not None and not (row.effects or row.dwells)]
        beside = [self._with_dwells(*each) for each in fitted]
        run = self._run.likelihood
        for row in unknown[:_BESIDE]:
            if (courses := self._courses_beside(row)) is not None:
                name = f"?{self._number(row)}"
                columns, alone = self._run.terms[self._best[name]].columns, self._by_row(self._log_evidence)[name]
                exact = self._row_of((name,), alone)  # what differs in each dwell is no dwell that is off
                beside.append(self._with_dwells(exact, run.spanned.beside(columns, run.lengths), courses))
        return beside

    def _courses_beside(self, row: Hypothesis) -> Courses | None:
        """Return what the unknown function of a row leaves of the courses within dwells; None where it has none, or one
        whose columns have any size only together."""
        number = self._number(row)
        if number is None or not self._run.unknown[number].summands:
            return None
        k = self._best[f"?{number}"]
        return self._run.courses_beside(k, self._likeliest_noise(k))

    def _where_fitted(self, refit: Calibration) -> tuple[Spanned, Courses]:
        """Return the rows of a run, with the effects that a refit has in addition in the model, and what they leave in
        the likeliest noise of the courses of the readings within dwells: the refit of a bad model may follow the means
        against these."""
        likelihood, logs, grams, along = self._in_noises_of(refit)
        k = int(np.argmax(logs + _gains(grams, along)))
        likeliest = _likeliest(grams[k], along[k])
        places = np.arange(len(likeliest))
        states = likelihood.states_beside(self._sizes.covariances[k], places, likeliest)
        courses = likelihood.courses_at(states, likeliest)
        return likelihood.spanned.beside(places, likelihood.lengths), courses

    def _with_dwells(self, row: Hypothesis, rows: Spanned, courses: Courses) -> Hypothesis:
        """Return a row with dwells that are off beside what it has, which is in the model of ``rows``.

        What they gain beside an unknown function counts in part: what this leaves is larger in some dwells.
        """
        noises = self._sizes.in_families(partial(InNoises, rows))
        found = DwellsApart(rows, courses, noises, self._sizes).rows_of_dwells()
        log, places = max(found, default=(-math.inf, ()))
        without = self._sizes.evidence(np.concatenate([of_family.logs for of_family in noises])[None])[0]
        gain = log - float(np.logaddexp.reduce(without))
        gain = min(gain, INDEPENDENT * gain) if row.driver else gain
        return replace(row, dwells=self._numbers(places), log_evidence=row.log_evidence + gain)

    def _number(self, row: Hypothesis) -> int | None:
        """Return the number of the unknown function of a row; None where it has none."""
        return next((k for k, term in enumerate(self._run.unknown) if term.driver == row.driver), None)

    def _several(self) -> list[Hypothesis]:
        """Return the rows of the likeliest effects, and of the likeliest summands of unknown functions, each with any
        other term beside it, and of the likeliest pairs with one more effect, or unknown function."""
        terms, heads = self._run.terms, [(k,) for k in (*self._heads(), *self._summands_to_pair())]
        alone = [self._base + self._log_bayes[k] + self._log_share_of(k) for (k,) in heads]
        pairs, beside = _Rows(), list[tuple[_Head, Floats, Floats]]()
        for head, likelihoods, logs in self._beside(heads, alone):
            name, is_known = terms[head[0]].row, terms[head[0]].is_known
            of_rows = self._by_row(logs)
            if not is_known:
                left = of_rows.get(self._run.arrivals, -math.inf) + math.log(_INEXACT)
                both = float(np.logaddexp(self._of_two_summands(head[0], logs), left))
                pairs[frozenset({name})] = both, (name,)
            self._add_beside(pairs, head, of_rows)
            beside.append((head, likelihoods, logs))
        alone_of = self._by_row(self._log_evidence)
        alone_of |= {name: max(log, alone_of[name]) for log, (name, *others) in pairs.values() if not others}
        for k in (k for k, unknown in enumerate(self._run.unknown) if not unknown.summands):
            alone_of.pop(f"?{k}", None)  # what changes irregularly has no formula
        rows = {key: self._row_beside(names, log, alone_of, pairs) for key, (log, names) in pairs.items()}
        triples, several = _Rows(), self._pairs_to_extend(rows, beside)
        for head, _, logs in self._beside([head for head, _ in several], [alone for _, alone in several]):
            self._add_beside(triples, head, self._by_row(logs))
        return [*rows.values(), *(self._row_beside(names, log, alone_of, pairs) for log, names in triples.values())]

    def _beside(self, heads: Sequence[_Head], alone: Sequence[Floats]) -> Iterator[tuple[_Head, Floats, Floats]]:
        """Yield heads, some terms together each, with the log likelihoods (terms, noises) and log evidence (terms,) of
        all terms beside them; alone: log likelihoods (noises,) of the heads."""
        if not heads:
            return
        # beside one more term less noise is likely, not more
        likely = [self._sizes.likely(logs, self._log_bayes.max(axis=0)) for logs in alone]
        explained = self._explained(heads, likely)
        for h, head in enumerate(heads):
            names = [self._run.terms[k].row.replace("?", "unknown function ") for k in head]
            stage.say(f"weighing all beside {listing(names)}")
            logs = np.repeat(alone[h][None], len(self._run.terms), axis=0)
            for family, (noises, first) in enumerate(zip(self._noises, self._firsts, strict=True)):
                sizes = [k - first for k in likely[h][family]]
                logs[:, likely[h][family]] += self._run.log_bayes(noises, sizes, explained[h, family])
            yield head, logs, np.logaddexp.reduce(self._sizes.evidence(logs, likely[h]), axis=1)

    def _add_beside(self, rows: _Rows, head: _Head, of_rows: dict[str, float]) -> None:
        """Add the log evidence of rows of the terms of a head with one other row each, which may have come already; of
        three causes one at most is an unknown function, or a walk: two of them and an effect fit nearly everything."""
        terms = [self._run.terms[k] for k in head]
        for other, log in of_rows.items():
            names = *(term.row for term in terms), other
            changes = other == self._run.arrivals and not all(term.is_known for term in terms)
            too_free = len(names) > 2 and len(_unknown(names)) + (self._run.walk in names) > 1
            if not changes and not too_free and all(self._is_pair(term.row, other) for term in terms):
                before, names = rows.get(frozenset(names), (-math.inf, names))
                rows[frozenset(names)] = max(before, log), names

    def _row_beside(self, names: Sequence[str], log: float, alone: dict[str, float], pairs: _Rows) -> Hypothesis:
        """Return a row where what effects gain beside an unknown function counts in part, as far as this explains more
        than the effects do without it: no function is just one that is tried, and what it leaves is no noise of
        independent dwells. What changes irregularly has no formula: it is noise, with which all of it counts."""
        unknown = _unknown(names)
        known = [name for name in names if name not in unknown]
        functions = max((alone.get(name, -math.inf) for name in unknown), default=-math.inf)
        effects = max((alone[name] for name in known), default=math.inf)
        effects = max(effects, pairs.get(frozenset(known), (-math.inf,))[0])
        log -= (1.0 - INDEPENDENT) * max(min(functions - effects, log - functions), 0.0)
        return self._row_of(names, log)

    def _pairs_to_extend(self, rows: dict[frozenset[str], Hypothesis], beside: Sequence[tuple[_Head, Floats, Floats]]
                         ) -> list[tuple[_Head, Floats]]:  # fmt: skip
        """Return the terms of the likeliest pairs, and of the likeliest of effects alone, in noise that is averaged
        over and in that stated, which explain more than any such row of one term, with their log likelihoods (noises,).
        What has no formula is tried beside pairs, and no pair is made of it."""
        terms, best = self._run.terms, dict[frozenset[str], tuple[float, float, _Head, Floats]]()
        for (head,), likelihoods, logs in beside:
            for other, k in self._likeliest_of(logs, self._with_formula).items():
                names = frozenset({terms[head].row, other})
                if len(names) == 2 and names in rows and names not in best and len(_unknown(names)) < 2:
                    alone = likelihoods[k] + self._log_share_of(k)
                    best[names] = rows[names].log_evidence, float(likelihoods[k, 0]), (head, k), alone
        chosen, singles, stated = dict[_Head, Floats](), self._singles(), self._base[0] + self._log_bayes[:, 0]
        for known in ({True, False}, {True}):
            least = max((row.log_evidence for row in singles if bool(row.effects) in known), default=math.inf)
            of_stated = max((stated[k] for k, term in enumerate(terms) if term.is_known in known), default=math.inf)
            among = [each for each in best.values() if {terms[k].is_known for k in each[2]} <= known]
            likeliest = sorted((each for each in among if each[0] > least), key=lambda each: -each[0])[:_HEADS]
            largest = sorted((each for each in among if each[1] > of_stated + _BEHIND), key=lambda each: -each[1])
            chosen |= {head: alone for *_, head, alone in (*likeliest, *largest[:_HEADS])}
        return [*chosen.items()]

    def _is_pair(self, one: str, other: str) -> bool:
        """Tell whether two rows together are another explanation: neither is of a gimbal that the other has, nor are
        they all gimbals of one kind of error, which have a row of their own."""
        both = {*self._run.effects_of(one)}, {*self._run.effects_of(other)}
        return not both[0] & both[1] and len(self._run.causes_of([*set.union(*both)])) > 1

    def _summands_to_pair(self) -> list[int]:
        """Return the numbers of the likeliest summands of the unknown functions in which one is likeliest."""
        best = self._likeliest(k for k, term in enumerate(self._run.terms) if len(term.summands) == 1)
        return sorted(best.values(), key=lambda k: -float(self._log_evidence[k]))[:_BESIDE]

    def _of_two_summands(self, one: int, logs: Floats) -> float:
        """Return the log evidence of two summands of an unknown function, from that of all terms beside one."""
        head, terms = self._run.terms[one], self._run.terms
        others = [k for k, term in enumerate(terms) if term.row == head.row and len(term.summands) == 1]
        others = [k for k in others if terms[k].only == head.only and terms[k].summands != head.summands]
        unknown = self._run.unknown[int(head.row[1:])]
        if len(others) < 2 or unknown.at_once == 1:
            return -math.inf
        share = math.log(unknown.share(2) / math.comb(len(others) + 1, 2))
        return _log_sum(logs[others].tolist()) - self._log_share_of(one) + share + head.log_share_of_form

    def _explained(self, heads: Sequence[tuple[int, ...]], likely: Sequence[list[list[int]]]
                   ) -> dict[tuple[int, int], Floats]:  # fmt: skip
        """Return what the terms of each head explain of all columns, in the noises of each family that are likely
        beside them."""
        groups = [np.unique(np.concatenate([self._run.terms[k].columns for k in head])) for head in heads]
        explained = dict[tuple[int, int], Floats]()
        for family, (noises, first) in enumerate(zip(self._noises, self._firsts, strict=True)):
            numbers = sorted({k for of_head in likely for k in of_head[family]})
            of_heads = noises.explained_by(groups, [k - first for k in numbers])
            explained |= {(h, family): own[np.isin(numbers, likely[h][family])] for h, own in enumerate(of_heads)}
        return explained

    def _heads(self) -> list[int]:
        """Return the numbers of the likeliest terms of the likeliest effects: in noise that is averaged over and, since
        beside another effect the noise is less than with one alone, in none beyond what was stated. Nor does one alone
        show what an effect has in the other accelerometers: beside others it is tried in all, too."""
        best = {name: k for name, k in self._best.items() if not name.startswith("?") and name != self._run.walk}
        in_noise = sorted(best, key=lambda name: -self._log_evidence[best[name]])[:_HEADS]
        in_none = sorted(best, key=lambda name: -self._log_bayes[best[name], 0])[:_HEADS]
        heads = list(dict.fromkeys([*in_noise, *in_none]))
        heads += dict.fromkeys(self._ahead_of_pairs(list(best), heads) if len(best) > 1 else [])
        in_all = self._likeliest(k for k, term in enumerate(self._run.terms) if not term.alone)
        return [*dict.fromkeys(of[name] for of in (best, in_all) for name in heads if name in of)]

    def _ahead_of_pairs(self, names: Sequence[str], heads: Sequence[str]) -> list[str]:
        """Return the likelier effect of each pair that, in the noise that was stated, lets chi-squared fall nearly as
        much as a head with any other effect, without being such a pair: alone neither of the two need stand out."""
        bases, readings = self._run.bases([self._best[name] for name in names], None)
        along, products = bases @ readings, np.einsum("iqr,jpr->ijqp", bases, bases)
        left = along - np.einsum("ijqp,iq->ijp", products, along)
        beside = np.eye(along.shape[1]) * (1.0 + _SAME) - np.einsum("ijqp,ijqs->ijps", products, products)
        more = np.sum(left * np.linalg.solve(beside, left[..., None])[..., 0], axis=2)
        gains = np.triu(np.sum(along**2, axis=1)[:, None] + more, 1)
        least = gains.max() - 2.0 * _BEHIND
        of_heads = np.isin(names, heads)
        gains[of_heads[:, None] | of_heads] = -np.inf
        pairs = [divmod(k, len(names)) for k in np.argsort(-gains, axis=None)[:_HEADS].tolist()]
        evidence = [float(self._log_evidence[self._best[name]]) for name in names]
        likely = [i if evidence[i] > evidence[j] else j for i, j in pairs if gains[i, j] > least]
        return [str(names[k]) for k in likely]

    @cached_property
    def _best(self) -> dict[str, int]:
        """The number of the likeliest term of each row."""
        return self._likeliest(range(len(self._run.terms)))

    def _likeliest(self, numbers: Iterable[int]) -> dict[str, int]:
        """Return the number of the likeliest of some terms of each row."""
        return self._likeliest_of(self._log_evidence, numbers)

    def _likeliest_of(self, logs: Floats, numbers: Iterable[int]) -> dict[str, int]:
        """Return the number of the likeliest of some terms of each row by log evidence (terms,)."""
        least_first = sorted(numbers, key=lambda k: (float(logs[k]), -k))
        return {self._run.terms[k].row: k for k in least_first}

    @cached_property
    def _with_formula(self) -> list[int]:
        """The numbers of terms of one effect, or of one summand of an unknown function."""
        terms = enumerate(self._run.terms)
        return [k for k, term in terms if len(term.summands) == 1 or (term.is_known and term.row != self._run.walk)]

    def _log_share_of(self, k: int) -> float:
        """Return the log of the mean likelihood of an effect, in one accelerometer or in all as a term has it, over
        that of the term; of a summand of an unknown function, of its share in the prior."""
        term = self._run.terms[k]
        return term.log_share if not term.is_known else self._log_mean(k, lambda other: other.alone == term.alone)

    def _log_share_of_constant(self, name: str) -> float:
        """Return the log of the mean likelihood over all values of an effect's constant, over that at the best."""
        k, term = self._best[name], self._run.terms[self._best[name]]
        alike = self._log_mean(k, lambda other: (other.relation, other.only) == (term.relation, term.only))
        return alike - term.log_share_of_form

    def _log_mean(self, k: int, alike: Callable[[RunTerm], bool]) -> float:
        """Return the log of the likelihood of those terms of a row that are alike, over that of one of them."""
        row, numbered = self._run.terms[k].row, zip(self._run.terms, self._log_evidence.tolist(), strict=True)
        logs = [log + term.log_share for term, log in numbered if term.row == row and alike(term)]
        return _log_sum(logs) - float(self._log_evidence[k])

    # Rows where their own fit is

    def _fitted(self, rows: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the rows with the likeliest of them fitted, and weighed where their fit is."""
        best = max(row.log_evidence for row in rows)
        least = best - _BEHIND - _BENT * max(best - float(self._without.max()), 0.0)
        effects = sorted((row for row in rows if row.effects and not row.driver), key=lambda row: -row.log_evidence)
        of_one = [row for row in effects if len(self._run.causes_of(row.effects)) == 1]
        single = [row for row in of_one if len(row.effects) == 1]
        # several behind one of their own have nothing to add
        alone = {id(row): [one.log_evidence for one in of_one if {*one.effects} < {*row.effects}] for row in effects}
        ahead = [row for row in effects if row.log_evidence > max(alone[id(row)], default=-math.inf)]
        single = [row for row in single if self._effects[row.effects[0]].scannable]
        single = sorted(single, key=lambda row: -row.statistic)[:_ALWAYS]  # large effects are far from linear
        likeliest = {id(row) for row in [*single, *(row for row in ahead[:_REFITTED] if row.log_evidence > least)]}
        fitted = self._without_refused([self._refitted(row) if id(row) in likeliest else row for row in rows])
        while more := self._to_be_fitted(fitted):
            fitted = self._without_refused([self._refitted(row) if id(row) in more else row for row in fitted])
        first = max(fitted, key=lambda row: row.log_evidence)
        least = first.log_evidence + math.log(LISTED)  # others are not shown
        return [self._described(row) if row.driver and row.log_evidence > least else row for row in fitted]

    def _to_be_fitted(self, rows: Sequence[Hypothesis]) -> set[int]:
        """Return the ids of the likeliest row, if it is of effects and not fitted, and of pairs of its effects; where
        it has an unknown function, or a random walk, of its effects alone, and of the likeliest others with them:
        beside each other, constants are others than alone, but for a random walk, and a function of any form, which
        have none."""
        first, *others = sorted(rows, key=lambda row: -row.log_evidence)
        likeliest, kept = [] if first.driver else [first], {*first.effects} - {self._run.walk}
        known = [row for row in others if row.effects and not row.driver]
        likeliest += [row for row in known if {*row.effects} < {*first.effects} and len(row.effects) > 1]
        if first.driver or kept != {*first.effects}:
            likeliest += [row for row in known if {*row.effects} == {*first.effects}]
            wider = [row for row in known if kept < {*row.effects} and self._run.walk not in row.effects]
            likeliest += wider[:_BESIDE]
        return {id(row) for row in likeliest if row.effects and row.refit is None and math.isfinite(row.log_evidence)}

    def _without_refused(self, rows: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the rows without an effect that its fit has refused: one with which the run tells nothing, or an
        oscillation that does not go on alike in all dwells."""
        return [row for row in rows if not self._refused & {*row.effects}]

    def _refitted(self, row: Hypothesis) -> Hypothesis:
        """Return a row of effects with its fit, weighed there unless dwells were folded otherwise for it."""
        try:
            refit = self._refits.with_effects(self._before, row.effects)
        except UnobservableError:  # the run does not tell its coefficients: nothing speaks for it
            if len(row.effects) == 1:
                self._refused.add(row.effects[0])
            return replace(row, log_evidence=-math.inf)
        if refit.model.oscillates and not self._before.model.oscillates and p_of_steady_oscillation(refit.fit) < CLEAR:
            self._refused |= {str(effect) for effect in refit.model.effects if effect.oscillates}
            return row
        folded, before = refit.fit.dwells.folded, self._before.fit.dwells.folded
        otherwise = (folded.carrier_hz, folded.averaged) != (before.carrier_hz, before.averaged)
        if self._run.walk in row.effects or otherwise:
            return replace(row, refit=refit)
        log, statistic = self._log_of_fit(refit)
        log += self._log_prior(row.effects) + sum(map(self._log_share_of_constant, row.effects))
        return replace(row, refit=refit, log_evidence=log, statistic=row.statistic or statistic)

    def _with_changes_within(self, rows: Sequence[Hypothesis], fitted: Sequence[_Fitted]) -> list[Hypothesis]:
        """Return rows with those of irregular changes beside the likeliest effects, for which speaks what these leave
        within dwells; beside a random walk of the biases all of it is irregular."""
        beside, walked = list[Hypothesis](), list[float]()
        for row, _, courses in fitted:
            if (within := courses.log_bayes_alike) > 0.0:
                log, families = row.log_evidence + within + math.log(_WITHIN), (*row.families, NONE)
                beside.append(replace(row, driver=IRREGULAR, families=families, log_evidence=log))
        for row in (row for row in rows if row.effects == (self._run.walk,) and not row.driver):
            left = trend(row.refit.fit) if row.refit and self._test.trend else None
            if left is not None:
                k = self._best[self._run.walk]
                within = self._run.courses_beside(k, self._likeliest_noise(k)).log_bayes_alike
                # the term's waves are too long for the walk within a dwell, of which the refit's noise has all
                within = min(within, log_odds_of(left.p_value))
                walked.append(row.log_evidence + within + math.log(_WITHIN))
        return [
            replace(row, log_evidence=_log_sum([row.log_evidence, *walked])) if row.driver == IRREGULAR else row
            for row in rows
        ] + beside

    def _likeliest_fitted(self, rows: Sequence[Hypothesis]) -> list[_Fitted]:
        """Return the likeliest rows of effects that were fitted, without a random walk, each with the rows of the run
        and what is left of its courses there."""
        known = [row for row in rows if row.refit and row.effects and not row.driver]
        known = [row for row in known if self._run.walk not in row.effects]
        likeliest = sorted(known, key=lambda row: -row.log_evidence)[:_ALWAYS]
        return [(row, *self._where_fitted(row.refit)) for row in likeliest if row.refit]

    def _log_of_fit(self, refit: Calibration) -> tuple[float, float]:
        """Return the log evidence of the effects that a refit has in addition, at the values of their constants, and
        the fall of chi-squared by them in the likeliest noise."""
        likelihood, base, grams, along = self._in_noises_of(refit)
        effects, known = refit.model.effects[len(self._before.model.effects) :], self._before.model.count
        named = {str(effect): effect for effect in effects}
        causes = [[named[name] for name in names] for names in self._run.causes_of([*named])]
        starts = {name: refit.model.parts[name].start - known for name in named}
        places = [
            np.concatenate([starts[str(effect)] + np.arange(len(effect.coefficients)) for effect in cause])
            for cause in causes
        ]
        every = np.concatenate(places)  # of these columns, without those of constants
        grams, along = grams[:, every][:, :, every], along[:, every]
        related = [*itertools.product(*map(_relations, causes))]
        usual = [(usual_sizes(cause[0], self._run.grade), impossible_size(cause[0])) for cause in causes]
        sizes = [
            [sizes_of(best_sigma(likelihood.columns(place) @ matrix), *prior, _NODES[len(causes)])
             for place, (_, matrix), prior in zip(places, relation, usual, strict=True)]
            for relation in related
        ]  # fmt: skip
        logs = list[Floats]()
        combined = [np.asarray(block_diag(*(matrix for _, matrix in relation)), float) for relation in related]
        gains = [_gains(matrix.T @ grams @ matrix, along @ matrix) for matrix in combined]
        for k in sorted(range(len(related)), key=lambda k: -float(np.max(base + gains[k]))):
            if logs and np.max(base + gains[k]) < np.max(logs) - _BEHIND:
                break  # evidence is less than the likelihood at its best
            matrix, widths = combined[k], [matrix.shape[1] for _, matrix in related[k]]
            together = log_bayes_together(matrix.T @ grams @ matrix, along @ matrix, widths, sizes[k])
            logs.append(base + together + sum(log for log, _ in related[k]))
        likeliest = int(np.argmax(np.max(logs, axis=0)))
        statistic = 2.0 * float(_gains(grams[[likeliest]], along[[likeliest]])[0])
        return float(np.logaddexp.reduce(self._sizes.evidence(np.array(logs)), axis=None)), statistic

    def _in_noises_of(self, refit: Calibration) -> tuple[RunLikelihood, Floats, Floats, Floats]:
        """Return the likelihood where a refit is and, in all noises, its logs (k,) without the effects that the refit
        has in addition, with G^T W G (k, q, q) and G^T W z (k, q) of their columns."""
        key = tuple(map(str, refit.model.effects))
        if key not in self._of_refits:
            known, added = self._before.model.count, map(refit.noise.term, (ThermometerError, AxesAcross))
            noise = self._noise.with_terms(*(term for term in added if term is not None))
            likelihood = RunLikelihood(refit.linearised, noise, self._least_mps2, known=known)
            every = np.arange(refit.model.count - known)
            noises = self._sizes.in_families(partial(likelihood.in_noises, groups=[every[None]]))
            one = np.zeros(1, np.intp)
            parts = [(own.logs, own.gram(0, np.arange(len(own)), one)[:, 0], own.along[:, every]) for own in noises]
            logs, grams, along = (np.concatenate(part) for part in zip(*parts, strict=True))
            self._of_refits[key] = likelihood, logs, grams, along
        return self._of_refits[key]

    # What an unknown function looks like

    def _described(self, row: Hypothesis) -> Hypothesis:
        """Return a row of an unknown function with the formulas that describe it, and their fit."""
        number = self._number(row)
        texts = self._formulas(number, row.effects) if number is not None and self._run.unknown[number].summands else []
        if not (texts or row.effects):
            return row
        taken = {effect.name for effect in self._before.model.effects}
        first = next(k for k in itertools.count() if not {name_of_formula(k + n) for n in range(len(texts))} & taken)
        formulas = tuple(text_named(text, first + n) for n, text in enumerate(texts))
        try:
            refit = self._refits.with_effects(self._before, (*row.effects, *formulas))
        except (UnobservableError, InputError):
            return replace(row, formulas=formulas)
        return replace(row, formulas=formulas, refit=refit)

    def _formulas(self, number: int, beside: Sequence[str]) -> list[str]:
        """Return the formulas of an unknown function that the readings ask for, those that explain most first."""
        run, unknown = self._run, self._run.unknown[number]
        flat = [place for name in beside for place in run.terms[self._best[name]].columns.tolist()]
        terms = [term for term in run.terms if term.row == f"?{number}" and not term.alone]
        places = np.unique(np.concatenate([term.columns for term in terms]))
        scores = np.array([self._scores(terms, places, flat, covariance) for covariance in self._sizes.covariances])
        at, _ = np.unravel_index(int(np.argmax(scores)), scores.shape)
        parts = {k: columns for term in terms for k, columns in run.of_summands(term)}
        rows = run.likelihood.projected(self._sizes.covariances[int(at)], places, flat)
        chosen = self._summands([*parts.values()], rows, unknown.at_once or _SUMMANDS)
        return [text for k in chosen for text in unknown.summands[[*parts][k]]]

    def _scores(self, terms: Sequence[RunTerm], places: Indices, flat: Sequence[int],
                covariance: Floats | None) -> list[float]:  # fmt: skip
        """Return the log evidence of terms in one noise."""
        rows = self._run.likelihood.projected(covariance, places, flat)
        found = ((rows.of(term.columns), term.log_share) for term in terms)
        return [rows.log + log_bayes_of_columns(columns, rows.readings) + share for columns, share in found]

    def _summands(self, parts: Sequence[Indices], rows: Projected, most: int) -> list[int]:
        """Return the summands, by their columns, that explain most together, each of which gains evidence."""
        chosen, log = list[int](), -math.inf
        while len(chosen) < min(most, len(parts)):
            rest = [k for k in range(len(parts)) if k not in chosen]
            both = [rows.of(np.concatenate([parts[j] for j in (*chosen, k)])) for k in rest]
            logs = [log_bayes_of_columns(columns, rows.readings) for columns in both]
            if max(logs) < log + _MORE:
                break
            chosen.append(rest[int(np.argmax(logs))])
            log = max(logs)
        return chosen


def _with_sure_dwells(rows: list[Hypothesis], beside: list[Hypothesis]) -> list[Hypothesis]:
    """Return rows with those of dwells beside others if the likeliest is of these, its clearest dwell surely off."""
    alone = {number for row in rows for number in row.dwells}  # with nothing beside them: these are the clearest
    beside = [replace(row, dwells=tuple(sorted(row.dwells, key=lambda number: number not in alone))) for row in beside]
    table = table_of([row for row in (*rows, *beside) if math.isfinite(row.log_evidence)])
    dwells = table.first.dwells[:1]
    sure = sum(row.probability for row in table.rows if {*dwells} & {*row.dwells}) >= SURE
    return [*rows, *beside] if sure and any(table.first.dwells == row.dwells for row in beside) else rows


def _unknown(names: Iterable[str]) -> list[str]:
    """Return those of the names of rows that are of unknown functions."""
    return [name for name in names if name.startswith("?")]


def _gains(gram: Floats, along: Floats) -> Floats:
    """Return by how much (k,) columns raise the log likelihood at its best: gram (k, q, q), along (k, q)."""
    return 0.5 * np.sum(along * _likeliest(gram, along), axis=-1)


def _likeliest(gram: Floats, along: Floats) -> Floats:
    """Return the coefficients (..., q) of columns that are likeliest, whatever the lengths of these: gram
    (..., q, q), along (..., q); what is rounding has none."""
    scales = 1.0 / np.sqrt(np.maximum(np.einsum("...qq->...q", gram), 1e-300))
    inverse = np.linalg.pinv(scales[..., None] * gram * scales[..., None, :], ROUNDING, hermitian=True)
    return np.asarray(scales * (inverse @ (scales * along)[..., None])[..., 0], float)


def _relations(cause: Sequence[Effect]) -> list[tuple[float, Floats]]:
    """Return the matrices (q, k) that may combine the columns of an effect, with the logs of their shares; of those
    that several gimbals have together, all have their own."""
    effect, *others = cause
    if others:
        return [(0.0, np.eye(sum(len(each.coefficients) for each in cause)))]
    matrices = [*effect.relations] or [np.eye(len(effect.coefficients))]
    some = of_bearers(effect.bearers)
    return [(log - math.log(len(matrices)), matrix[:, only]) for matrix in matrices for log, only in some]


def _merged(rows: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return rows of which those of the same causes are one."""
    merged = dict[tuple[tuple[str, ...], ...], Hypothesis]()
    for row in rows:
        key = row.effects, (row.driver,), row.families, tuple(map(str, row.dwells))
        before = merged.get(key, row)
        logs = [row.log_evidence] if before is row else [before.log_evidence, row.log_evidence]
        merged[key] = replace(before, log_evidence=_log_sum(logs))
    return [*merged.values()]


def _log_sum(logs: Sequence[float]) -> float:
    """Return the log of a sum from the logs of its terms."""
    return float(np.logaddexp.reduce([-math.inf, *logs]))
