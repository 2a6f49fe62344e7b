"""The posterior over explanations of a misfit: nothing, noise, effects, pairs, unknown functions, one wrong dwell.

Every explanation is a set of terms in one likelihood (``run_likelihood``). All are first weighed where the run was
fitted, then the likeliest where their own fit is, because large effects are not linear. The prior of a kind is shared
among its members.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.diagnosis.coefficient_sizes import SizePrior, best_sigma, sensor_grade, usual_sizes
from kf_calib.diagnosis.hypotheses import log_odds_of
from kf_calib.diagnosis.hypothesis_table import (
    IRREGULAR,
    NOISE,
    NONE,
    NOTHING,
    Hypothesis,
    HypothesisTable,
    table_of,
)
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.run_likelihood import Projected, RunLikelihood, Sizes, integrated, log_bayes, log_bayes_together
from kf_calib.diagnosis.unknown_terms import unknown_terms
from kf_calib.dwells.qr import orthonormal
from kf_calib.effects import Coefficient, Effect, Stimulus, effect_named, walk_named
from kf_calib.effects.formula import formula
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.results import Calibration
from kf_calib.noise.reml import OF_ONE

Ints = NDArray[np.intp]

PRIOR = {"nothing": 0.4, "effect": 0.38, "pair": 0.08, "unknown": 0.1, "beside": 0.02, "dwell": 0.02}
"""Prior probability of each kind of explanation; ``beside``: an effect beside an unknown function."""

_STATED, _UNSTATED = 0.02, 0.5  # prior probability of noise beyond what was stated, and of noise of which nothing was
_OF_ONE = 0.1  # share of one accelerometer alone in scatter
_RANGE = math.log(1e4)  # of the sizes of noise
_DECADES = 7.0  # of the sizes of what has no usual size
_NODES = 40
_SPARSE = 0.5  # share of one summand alone in the functions of a driver
_SAME = 0.99  # cosine above which a summand is a known effect
_END = 0.99  # of the range of a constant
_HIDDEN = 1e19  # sigma of columns of which rounding alone is seen
_WAVES = 40  # of a random walk
_REFITTED = 8
_BEHIND = 10.0  # in log evidence: rows further behind are not fitted
_HEADS = 3  # effects beside which all others are tried, in the noise of the run and in none beyond that stated
_SHORT = 0.01  # prior probability of irregular changes that show within dwells only
_NO_NOISE = 0.1  # share of an unknown cause in scatter that was not stated
_AGAINST_STATED = 0.5  # the same of noise that contradicts what was stated
_BENT = 0.02  # share of the gain by which a row may be further behind, as large effects bend
_TOLD = 5.0  # in log evidence: rows further behind are not described
_MORE = 3.0  # in log evidence: what one more formula has to gain
_NODES_OF_PAIR = 16
_SUMMANDS = 3  # most formulas that describe an unknown function


@dataclass(frozen=True)
class _Group:
    """Columns of one term, the sizes of their coefficients, and the log of its share in its row, which is an effect or
    ``?`` and the number of an unknown term; summands: which of this term's."""

    row: str
    columns: Ints
    log_share: float
    effect: Effect | None = None
    summands: tuple[int, ...] = ()
    sizes: Sizes = Sizes(np.zeros(0), np.zeros(0))


class _Columns:
    """The columns of all terms while they are put together: effects that make them, blocks of combinations of these,
    the weights of the blocks' columns (0: as they are), and groups of blocks."""

    def __init__(self) -> None:
        self.effects, self.blocks, self.groups = list[Effect](), list[tuple[slice, Floats | None]](), list[_Group]()
        self._weights, self._made, self._places = list[Floats](), 0, list[Ints]()
        self._count = 0

    @property
    def weights(self) -> Floats:
        return np.concatenate(self._weights)

    def add(self, effects: Sequence[Effect]) -> slice:
        """Add the columns of effects, and say where they are."""
        first, self._made = self._made, self._made + sum(len(effect.coefficients) for effect in effects)
        self.effects += effects
        return slice(first, self._made)

    def block(self, part: slice, matrix: Floats | None, weight: float = 0.0) -> int:
        """Add combinations of columns, and return their number."""
        width = part.stop - part.start if matrix is None else matrix.shape[1]
        self.blocks.append((part, matrix))
        self._weights.append(np.full(width, weight))
        self._places.append(np.arange(self._count, self._count + width))
        self._count += width
        return len(self.blocks) - 1

    def group(self, row: str, blocks: Sequence[int], log_share: float, effect: Effect | None = None,
              summands: tuple[int, ...] = ()) -> None:  # fmt: skip
        """Add the columns of some blocks as one term."""
        places = np.concatenate([self._places[block] for block in blocks])
        self.groups.append(_Group(row, places, log_share, effect, summands))


@dataclass(frozen=True)
class _Block:
    """Groups of q columns each: their numbers (n,) and columns (n, q); G^T G (n, q, q) and G^T z (n, q) of the rows
    within dwells; squares (n, m) of their sizes, logs (n, m) of the probabilities of these, and centres (n,)."""

    numbers: Ints
    places: Ints
    gram: Floats
    along: Floats
    squares: Floats
    log_weights: Floats
    centres: Floats


class Posterior:
    """The posterior of one run.

    refits: those of the run. before: the run without what is missing. test: its linear tests.
    """

    def __init__(self, refits: Refits, before: Calibration, test: CandidateTests) -> None:
        self.refits, self.before, self.test = refits, before, test
        noise = before.noise
        self.noise = replace(
            noise,
            walk_mps2_per_sqrt_s=0.0,
            scatter_mps2=noise.scatter_mps2 if noise.scatter_stated else np.zeros(3),
            setting_rad=noise.setting_rad if noise.setting_stated or noise.attitude_unknown else 0.0,
        )
        self.grade = sensor_grade(before.fit)
        self.walk = "" if before.model.walks else walk_named(before.bench)
        self.candidates = [candidate.effect for candidate in test.effects.scan.candidates]
        self.tried = [candidate.tried for candidate in test.effects.scan.candidates]
        self.terms = [*unknown_terms(before.bench, before.fit.dwells)]
        self._make_columns()

    def _make_columns(self) -> None:
        """Make the columns of all terms, and group them by row."""
        axes, gravity = self.before.bench.axes, self.before.bench.gravity_mps2
        columns, shares = _Columns(), self._log_shares_of_values()
        for k, effect in enumerate(self.candidates):
            part = columns.add([effect])
            relations = [*effect.relations] or [None]
            for matrix in relations:
                columns.group(str(effect), [columns.block(part, matrix)], shares[k] - math.log(len(relations)), effect)
        for number, term in enumerate(self.terms):
            blocks = [
                columns.block(columns.add([formula(_named(t), axes, gravity, checked=False) for t in texts]), None,
                              term.weight(k))
                for k, texts in enumerate(term.summands)
            ]  # fmt: skip
            share = math.log((1.0 if term.exclusive or len(blocks) == 1 else _SPARSE) / len(blocks))
            for k, block in enumerate(blocks):
                columns.group(f"?{number}", [block], share, summands=(k,))
            if not term.exclusive and len(blocks) > 1:
                columns.group(f"?{number}", blocks, math.log(1.0 - _SPARSE), summands=(*range(len(blocks)),))
        if self.walk:
            waves = _Walk(self.before.fit.dwells[-1].end_s, min(len(self.before.fit.dwells), _WAVES))
            columns.group(self.walk, [columns.block(columns.add([waves]), None)], 0.0)
        self.likelihood = RunLikelihood(self.before.linearised, self.noise, columns.effects)
        self.likelihood.recombined(columns.blocks)
        rms = self.likelihood.column_rms()
        self.likelihood.rescaled(np.where(columns.weights > 0.0, columns.weights / np.where(rms > 0, rms, np.inf), 1.0))
        self.groups = self._seen_groups(columns.groups)

    def _log_shares_of_values(self) -> list[float]:
        """Log of the share of each value of a constant in its effect: the density falls by as much as a time constant is
        longer than the effect goes on in this run."""
        of_name = dict[str, list[int]]()
        for k, effect in enumerate(self.candidates):
            of_name.setdefault(str(effect), []).append(k)
        logs = np.array([-math.log(max(e.value / e.acts_for_s(self._stimulus), 1.0)) for e in self.candidates])
        for numbers in of_name.values():
            tried = max(len(numbers), *(self.tried[k] for k in numbers))
            logs[numbers] -= float(np.logaddexp.reduce(logs[numbers])) + math.log(tried / len(numbers))
        return logs.tolist()

    def _seen_groups(self, drafts: Sequence[_Group]) -> list[_Group]:
        """The groups of which something is seen, with their sizes; a summand that is a known effect is no unknown
        function."""
        plain = self.likelihood.whole()
        known = dict[int, list[Floats]]()
        groups = list[_Group]()
        for draft in drafts:
            own = plain[:, draft.columns]
            least = best_sigma(own)
            if least > _HIDDEN:
                continue
            width = len(draft.columns)
            if draft.row[0] != "?":
                usual = None if draft.effect is None else usual_sizes(draft.effect, self.grade)
                if not _is_limit(draft.effect):
                    known.setdefault(width, []).append(orthonormal(own / np.linalg.norm(own, axis=0).max())[0])
                groups.append(replace(draft, sizes=_sizes(least, usual)))
                continue
            if len(draft.summands) == 1 and len(known.get(width, ())):
                basis = orthonormal(own / np.linalg.norm(own, axis=0).max())[0]
                bases = [each for each in known[width] if each.shape == basis.shape]
                if bases and float(np.linalg.norm(np.stack(bases).swapaxes(1, 2) @ basis, -2, (1, 2)).max()) > _SAME:
                    continue
            groups.append(replace(draft, sizes=_sizes(least, None)))
        return groups

    @cached_property
    def _stimulus(self) -> Stimulus:
        linearised = self.before.fit.linearised
        return stimulus_of(linearised.dwells, self.before.bench, linearised.state)

    # -- noise ---------------------------------------------------------------------------------------------------

    @cached_property
    def _families(self) -> list[tuple[tuple[str, ...], Floats, float]]:
        """Parts of the noise that may be free: names, their shapes (D, 3, 3), and the log of the prior."""
        noise, like = self.noise, self.likelihood
        stated = {"setting": noise.setting_stated, "common": noise.scatter_stated}
        priors = {part: _STATED if is_stated else _UNSTATED for part, is_stated in stated.items()}

        def log_prior(parts: Sequence[str]) -> float:
            return sum(math.log(p if part in parts else 1.0 - p) for part, p in priors.items())

        families = [((), np.zeros((0, 3, 3)), log_prior(()))]
        model = self.before.model
        if (1 if noise.attitude_unknown else 3) * len(self.before.fit.dwells) <= model.count - len(model.fixed):
            return families
        common = like.shapes_of("common")
        families.append((("common",), common, log_prior(("common",))))
        if noise.attitude_unknown:
            return families
        setting = like.shapes_of("setting")
        families.append((("setting",), setting, log_prior(("setting",))))
        if not (noise.setting_stated and noise.scatter_stated):
            families.append((("setting", "common"), setting + common, log_prior(("setting", "common"))))
        return families

    @cached_property
    def _noises(self) -> list[tuple[int, float, Floats | None]]:
        """All noises that are tried: number of the family, size, covariance."""
        sizes = self.likelihood.sizes_of_scatter()
        noises: list[tuple[int, float, Floats | None]] = [(0, 0.0, None)]
        for k, (_, shapes, _) in enumerate(self._families[1:], start=1):
            noises += [(k, size, size**2 * shapes) for size in sizes.tolist()]
        return noises

    def _integrated(self, logs: Floats) -> Floats:
        """Log evidence (n, families) from log likelihoods (n, noises), with the priors of the noise."""
        of_families = np.array([k for k, _, _ in self._noises])
        parts = [logs[:, of_families == 0][:, 0] + self._families[0][2]]
        for k, (_, _, prior) in enumerate(self._families[1:], start=1):
            parts.append(integrated(logs[:, of_families == k], self.likelihood.step) - math.log(_RANGE) + prior)
        return np.stack(parts, axis=1)

    # -- rows ----------------------------------------------------------------------------------------------------

    def _scan(self) -> tuple[Floats, Floats, Floats]:
        """Log likelihoods without terms (noises,), log Bayes factors of all groups (groups, noises), and those of one
        wrong dwell (noises,)."""
        base, bayes, dwell = list[float](), list[Floats](), list[float]()
        for _, _, covariance in self._noises:
            rows = self.likelihood.projected(covariance)
            base.append(rows.log)
            bayes.append(self._bayes_of(rows))
            dwell.append(self._of_one_dwell(rows))
        return np.array(base), np.array(bayes).T, np.array(dwell)

    def _scan_beside(self, flat: Ints, logs: Floats) -> Floats:
        """Log Bayes factors (groups, noises) of all groups beside a term with the columns ``flat`` and the log
        likelihoods ``logs`` (noises,).

        What is beside it makes less noise likelier, not more: noise larger than is likeliest without is left out.
        """
        bayes, families = np.zeros((len(self.groups), len(logs))), np.array([k for k, _, _ in self._noises])
        for family in np.unique(families).tolist():
            places = np.flatnonzero(families == family)
            for k in places[: int(np.argmax(logs[places])) + 2].tolist():
                bayes[:, k] = self._bayes_of(self.likelihood.projected(self._noises[k][2], flat))
        return bayes

    def _bayes_of(self, rows: Projected) -> Floats:
        """Log Bayes factors (groups,) of all terms in one noise."""
        logs, columns = np.zeros(len(self.groups)), np.ascontiguousarray(rows.columns.T)
        for block in self._blocks:
            own = columns[block.places]
            gram, along = own @ np.swapaxes(own, 1, 2), own @ rows.readings
            if rows.more:
                gram, along = gram + block.gram, along + block.along
            logs[block.numbers] = log_bayes(gram, along, block.squares, block.log_weights, block.centres)
        return logs

    @cached_property
    def _blocks(self) -> list[_Block]:
        """The groups of equal width."""
        more, readings = self.likelihood.more
        blocks, transposed = list[_Block](), np.ascontiguousarray(more.T)
        widths = np.array([len(group.columns) for group in self.groups])
        for width in np.unique(widths).tolist():
            numbers = np.flatnonzero(widths == width)
            groups = [self.groups[k] for k in numbers.tolist()]
            places = np.array([group.columns for group in groups])
            own = transposed[places]
            blocks.append(
                _Block(
                    numbers, places, own @ np.swapaxes(own, 1, 2), own @ readings,
                    np.stack([group.sizes.values for group in groups]) ** 2,
                    np.stack([group.sizes.logs for group in groups]), np.array([g.sizes.centre for g in groups]),
                )
            )  # fmt: skip
        return blocks

    def _of_one_dwell(self, rows: Projected) -> float:
        """Log Bayes factor of an offset of any size in one dwell alone."""
        gram, along = rows.of_dwells()
        logs = _log_bayes_of_any(gram, along)
        self._last_dwell = int(np.argmax(logs))
        return float(np.logaddexp.reduce(logs)) - math.log(len(logs))

    # -- the table -----------------------------------------------------------------------------------------------

    def table(self, refitted: bool = True) -> HypothesisTable:
        """The rows with their probabilities; the likeliest are fitted if ``refitted``."""
        base, bayes, dwell = self._scan()
        rows = [*self._without_terms(base), *self._singles(base, bayes, dwell)]
        if refitted:
            rows += self._beside(base, bayes)
            rows = self._fitted(rows)
        rows = [row for row in rows if math.isfinite(row.log_evidence)]
        return replace(table_of(rows), scattering=self._scattering())

    def _without_terms(self, base: Floats) -> list[Hypothesis]:
        """The rows without a term: nothing, noise, and causes that change irregularly."""
        logs = self._integrated(base[None])[0] + math.log(PRIOR["nothing"])
        log_noise, unknown = list[float](), [float(logs[0]) + math.log(_SHORT)]
        for (parts, _, _), log in zip(self._families[1:], logs[1:].tolist(), strict=True):
            share = self._share_of_unknown(parts, base)
            log_noise.append(log + math.log(1.0 - share))
            unknown += [log + math.log(share)] if share else []
        for parts, log in self._of_one:
            share = self._share_of_unknown(parts, base)
            log_noise.append(log + math.log(PRIOR["nothing"] * (1.0 - share)))
            unknown += [log + math.log(PRIOR["nothing"] * share)] if share else []
        irregular = float(np.logaddexp.reduce(unknown))
        irregular += log_odds_of(self.test.trend.p_value) if self.test.trend else 0.0
        return [
            Hypothesis(families=(NOTHING,), log_evidence=float(logs[0])),
            Hypothesis(families=(NOISE,), log_evidence=float(np.logaddexp.reduce([-math.inf, *log_noise]))),
            Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=irregular),
        ]

    @cached_property
    def _of_one(self) -> list[tuple[tuple[str, ...], float]]:
        """Log evidence of scatter of one accelerometer alone, without the prior of no effect."""
        if len(self._families) < 2 or self.noise.attitude_unknown:
            return []
        prior, logs = self._families[1][2] + math.log(_OF_ONE / 3.0), list[tuple[tuple[str, ...], float]]()
        sizes = self.likelihood.sizes_of_scatter()
        for part in OF_ONE:
            shapes = self.likelihood.shapes_of(part)
            base = np.array([[self.likelihood.bare(size**2 * shapes) for size in sizes.tolist()]])
            logs.append(((part,), float(integrated(base, self.likelihood.step)[0]) - math.log(_RANGE) + prior))
        return logs

    def _scattering(self) -> int:
        """The number of the accelerometer that alone scatters, where that is the likeliest noise; else 0."""
        if not self._of_one:
            return 0
        best = int(np.argmax([log for _, log in self._of_one]))
        return best + 1 if self._of_one[best][1] > self._log_of_noise else 0

    def _share_of_unknown(self, parts: Sequence[str], base: Floats) -> float:
        """The share of an unknown cause in these parts of the noise: where they contradict what was stated, a cause
        that differs from orientation to orientation explains as much, unless repeated orientations tell."""
        noise = self.before.noise
        stated = {"setting": noise.setting_stated} | dict.fromkeys(("common", *OF_ONE), noise.scatter_stated)
        if not any(stated[part] for part in parts):
            return 0.0 if parts == ("setting",) else _NO_NOISE
        return _AGAINST_STATED

    def _singles(self, base: Floats, bayes: Floats, dwell: Floats) -> list[Hypothesis]:
        """The rows of one term each."""
        evidence = np.logaddexp.reduce(self._integrated(base + bayes), axis=1)
        self._log_of_groups = evidence
        names = self._number_of_names
        unknown = len(self.terms)
        logs = dict[str, list[float]]()
        for group, log in zip(self.groups, evidence.tolist(), strict=True):
            logs.setdefault(group.row, []).append(log + group.log_share)
        rows = list[Hypothesis]()
        for row, values in logs.items():
            log = float(np.logaddexp.reduce(values))
            if row[0] == "?":
                term = self.terms[int(row[1:])]
                log += math.log(PRIOR["unknown"] / unknown)
                rows.append(Hypothesis(driver=term.driver, families=(term.family or NONE,), log_evidence=log))
            else:
                effect = effect_named(row, self.before.bench)
                log += math.log(PRIOR["effect"] * effect.prior / names)
                rows.append(Hypothesis((row,), families=(effect.family,), log_evidence=log,
                                       statistic=self._delta_chi2(row), dof=self._dof(row)))  # fmt: skip
        if not self.noise.attitude_unknown:
            log = float(np.logaddexp.reduce(self._integrated((base + dwell)[None])[0])) + math.log(PRIOR["dwell"])
            number = self.before.fit.dwells[self._last_dwell].number
            rows.append(Hypothesis(driver=f"dwell {number} alone", families=(NONE,), log_evidence=log))
        return rows

    def _delta_chi2(self, name: str) -> float:
        effects = self.test.effects
        if name in effects.best:
            return float(effects.scan.statistics[effects.best[name]])
        return 2.0 * self.before.fit.walk_gain

    def _dof(self, name: str) -> int:
        return self.test.effects.candidate(name).dof if name in self.test.effects.best else 1

    @cached_property
    def _number_of_names(self) -> int:
        return len({group.row for group in self.groups if group.row[0] != "?"})

    @cached_property
    def _best_of(self) -> dict[str, int]:
        """The likeliest group of each row."""
        best = dict[str, int]()
        for k, group in enumerate(self.groups):
            if group.row not in best or self._log_of_groups[k] > self._log_of_groups[best[group.row]]:
                best[group.row] = k
        return best

    def _beside(self, base: Floats, bayes: Floats) -> list[Hypothesis]:
        """The rows of pairs: the likeliest effects, each with any other term beside it."""
        best = {name: k for name, k in self._best_of.items() if name[0] != "?" and name != self.walk}
        of_noise = sorted(best, key=lambda name: -self._log_of_groups[best[name]])[:_HEADS]
        of_none = sorted(best, key=lambda name: -bayes[best[name], 0])[:_HEADS]
        order = dict.fromkeys([*of_noise, *of_none])  # beside another effect the noise is less than with one alone
        names = self._number_of_names
        unknown, pairs = len(self.terms), dict[tuple[str, str], float]()
        for name in order:
            group = self.groups[best[name]]
            with_name = base + bayes[best[name]] + self._log_rest(name)
            beside = self._scan_beside(group.columns, with_name)
            logs = np.logaddexp.reduce(self._integrated(with_name + beside), axis=1)
            of_rows = dict[str, list[float]]()
            for other, log in zip(self.groups, logs.tolist(), strict=True):
                if other.row != name:
                    of_rows.setdefault(other.row, []).append(log + other.log_share)
            for other, values in of_rows.items():
                log, key = float(np.logaddexp.reduce(values)), (name, other)
                if other[0] != "?" and (other, name) in pairs:
                    key = (other, name)
                pairs[key] = max(pairs.get(key, -math.inf), log)
        rows, bench = list[Hypothesis](), self.before.bench
        for (name, other), log in pairs.items():
            effect = effect_named(name, bench)
            if other[0] == "?":
                term = self.terms[int(other[1:])]
                prior = PRIOR["beside"] * effect.prior / names / unknown
                families = tuple(dict.fromkeys((effect.family, term.family or NONE)))
                rows.append(Hypothesis((name,), ("?",), term.driver, families, log + math.log(prior)))
            else:
                second = effect_named(other, bench)
                prior = PRIOR["pair"] * effect.prior * second.prior / math.comb(max(names, 2), 2)
                families = tuple(dict.fromkeys((effect.family, second.family)))
                rows.append(Hypothesis((name, other), families=families, log_evidence=log + math.log(prior)))
        return rows

    def _log_rest(self, name: str) -> float:
        """Log of the mean likelihood over all values of an effect's constant, over that at the best."""
        logs = [log + group.log_share for group, log in zip(self.groups, self._log_of_groups, strict=True)
                if group.row == name]  # fmt: skip
        return float(np.logaddexp.reduce(logs) - self._log_of_groups[self._best_of[name]])

    def _fitted(self, rows: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The rows with the likeliest of them fitted, and weighed where their fit is."""
        best = max(row.log_evidence for row in rows)
        limit = best - _BEHIND - _BENT * max(best - self._log_of_noise, 0.0)
        order = sorted((row for row in rows if row.effects and not row.formulas), key=lambda row: -row.log_evidence)
        chosen = {id(row) for row in [row for row in order if row.log_evidence > limit][:_REFITTED]}
        result = [self._refitted(row) if id(row) in chosen else row for row in rows]
        first = max(row.log_evidence for row in result) - _TOLD
        return [self._described(row) if row.driver and row.log_evidence > first else row for row in result]

    @cached_property
    def _log_of_noise(self) -> float:
        """Log evidence of the model without any term, without the prior of that."""
        base = np.array([[self.likelihood.bare(covariance) for _, _, covariance in self._noises]])
        return float(np.logaddexp.reduce(self._integrated(base)[0]))

    def _refitted(self, row: Hypothesis) -> Hypothesis:
        """A row of effects with its fit, weighed there."""
        try:
            refit = self.refits.with_effects(self.before, row.effects)
        except UnobservableError:
            return replace(row, log_evidence=-math.inf)
        folded, before = refit.fit.dwells[0], self.before.fit.dwells[0]
        otherwise = (folded.carrier_hz, folded.averaged) != (before.carrier_hz, before.averaged)
        if self.walk in row.effects or otherwise:
            return replace(row, refit=refit)
        log = self._log_of_fit(refit) + sum(self._log_rest(name) for name in row.effects)
        return replace(row, refit=refit, log_evidence=log + self._log_prior(row.effects))

    def _log_of_fit(self, refit: Calibration) -> float:
        """Log evidence of the effects that a refit has in addition, linearised there, at the values of their
        constants."""
        known, noise, model = self.before.model.count, self.noise, refit.model
        if refit.noise.sensitivity_mps2_per_k is not None:
            noise = replace(noise, sensitivity_mps2_per_k=refit.noise.sensitivity_mps2_per_k)
        likelihood = RunLikelihood(refit.linearised, noise, (), known)
        effects = [effect for effect in model.effects if model.parts[str(effect)].start >= known]
        places = [model.parts[str(effect)].start - known + np.arange(len(effect.coefficients)) for effect in effects]
        usual = [usual_sizes(effect, self.grade) for effect in effects]
        related = [*itertools.product(*([*effect.relations] or [np.eye(len(effect.coefficients))] for effect in effects))]
        plain = likelihood.whole()
        logs = np.full((len(related), len(self._noises)), -math.inf)
        sizes = [[_sizes(best_sigma(plain[:, p] @ matrix), u, _NODES_OF_PAIR) for p, u, matrix in
                  zip(places, usual, matrices, strict=True)] for matrices in related]  # fmt: skip
        for k, (_, _, covariance) in enumerate(self._noises):
            rows = likelihood.projected(covariance, whole=True)
            for j, matrices in enumerate(related):
                parts = [rows.columns[:, p] @ matrix for p, matrix in zip(places, matrices, strict=True)]
                logs[j, k] = rows.log + log_bayes_together(parts, rows.readings, sizes[j])
        return float(np.logaddexp.reduce(self._integrated(logs), axis=None)) - math.log(len(related))

    def _log_prior(self, effects: Sequence[str]) -> float:
        """Log of the prior probability of one or two effects."""
        names = self._number_of_names
        among = names if len(effects) == 1 else math.comb(max(names, 2), 2)
        prior = math.prod(effect_named(name, self.before.bench).prior for name in effects)
        return math.log(PRIOR["effect" if len(effects) == 1 else "pair"] * prior / max(among, 1))

    def _described(self, row: Hypothesis) -> Hypothesis:
        """A row of an unknown function with the formulas that describe it, and their fit."""
        number = next((k for k, term in enumerate(self.terms) if term.driver == row.driver), None)
        if number is None:
            return row
        texts = self._formulas(number, row.effects)
        taken = {effect.name for effect in self.before.model.effects}
        first = next(k for k in itertools.count() if not {_name(k + n) for n in range(len(texts))} & taken)
        formulas = tuple(_named(text, first + n) for n, text in enumerate(texts))
        try:
            return replace(row, formulas=formulas, refit=self.refits.with_effects(self.before, (*row.effects, *formulas)))
        except (UnobservableError, InputError):
            return replace(row, formulas=formulas)

    def _formulas(self, number: int, beside: Sequence[str]) -> list[str]:
        """The formulas of an unknown function that the readings ask for, those first that explain most."""
        flat = np.concatenate([np.zeros(0, np.intp), *(self.groups[self._best_of[name]].columns for name in beside)])
        groups, term = [group for group in self.groups if group.row == f"?{number}"], self.terms[number]
        noises = [self.likelihood.projected(covariance, flat) for _, _, covariance in self._noises]
        scores = np.array(
            [[rows.log + self._bayes(group.columns, rows) + group.log_share for group in groups] for rows in noises]
        )
        at, which = np.unravel_index(int(np.argmax(scores)), scores.shape)
        rows, best = noises[int(at)], groups[int(which)]
        if len(best.summands) == 1:
            return [*term.summands[best.summands[0]]]
        ends = np.cumsum([self._width(texts) for texts in term.summands])[:-1]
        parts = np.split(best.columns, ends)
        chosen, log = list[int](), 0.0
        while len(chosen) < min(_SUMMANDS, len(parts)):
            logs = {k: self._bayes(np.concatenate([parts[j] for j in (*chosen, k)]), rows)
                    for k in range(len(parts)) if k not in chosen}  # fmt: skip
            likeliest = max(logs, key=lambda k: logs[k])
            if chosen and logs[likeliest] < log + _MORE:
                break
            chosen.append(likeliest)
            log = logs[likeliest]
        return [text for k in chosen for text in term.summands[k]]

    def _width(self, texts: Sequence[str]) -> int:
        """Number of columns of formulas."""
        bench = self.before.bench
        return sum(len(formula(_named(t), bench.axes, bench.gravity_mps2, checked=False).coefficients) for t in texts)

    def _bayes(self, places: slice | Floats, rows: Projected) -> float:
        """Log Bayes factor of some columns of any size."""
        columns, more = rows.columns[:, places], self.likelihood.more
        gram, along = columns.T @ columns, columns.T @ rows.readings
        if rows.more:
            gram, along = gram + more[0][:, places].T @ more[0][:, places], along + more[0][:, places].T @ more[1]
        return float(_log_bayes_of_any(gram[None], along[None])[0])


class _Walk(Effect):
    """The path of a random walk of the biases from its beginning: sums of waves (Karhunen and Loeve)."""

    name, title, source = "walk", "", ""

    def __init__(self, run_s: float, count: int) -> None:
        self.run_s, self.count = run_s, count

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"w{k}", "m/s^2", 1.0, "m/s^2") for k in range(3 * self.count))

    def columns(self, s: Stimulus) -> Floats:
        rates = (np.arange(self.count) + 0.5) * np.pi / self.run_s
        waves = math.sqrt(2.0 / self.run_s) * np.sin(s.elapsed_s[:, None] * rates) / rates
        columns = np.zeros((len(s), 3, 3, self.count))
        columns[:, range(3), range(3)] = waves[:, None]
        return columns.reshape(len(s), 3, -1)


def _is_limit(effect: Effect | None) -> bool:
    """Whether an effect is at the end of the range of its constant, where it is the limit of another one, which may be
    an unknown function."""
    return effect is not None and effect.unknown is not None and effect.value >= _END * effect.unknown.high


def _sizes(least: float, usual: SizePrior | None, nodes: int = _NODES) -> Sizes:
    """Sizes from one sigma of what is determined best, each with its prior probability; smaller ones show nothing."""
    if usual is None:
        values = least * 10.0 ** (_DECADES * (np.arange(nodes) + 0.5) / nodes)
        return Sizes(values, np.full(nodes, -math.log(nodes)))
    if usual.value:
        logs = np.full(nodes, -1e300)
        logs[0] = 0.0
        return Sizes(np.full(nodes, usual.low), logs, usual.value)
    edges = np.geomspace(least, max(1e3 * usual.high, 1e4 * least), nodes + 1)
    shares = np.diff(usual.below(edges))
    shares[-1] += 1.0 - float(usual.below(edges[-1:])[0])
    return Sizes(np.sqrt(edges[1:] * edges[:-1]), np.log(np.maximum(shares, 1e-300)))


def _log_bayes_of_any(gram: Floats, along: Floats) -> Floats:
    """Log Bayes factors (n,) of terms of any size."""
    sizes = _sizes(1.0 / math.sqrt(max(float(np.einsum("nqq->nq", gram).max()), 1e-40)), None)
    squares, logs = (np.broadcast_to(values, (len(gram), _NODES)) for values in (sizes.values**2, sizes.logs))
    return log_bayes(gram, along, squares, logs, np.zeros(len(gram)))


def _named(text: str, number: int = 0) -> str:
    """A formula with a name in front, from ``:z = sin(q1)`` or ``sin(q1)``."""
    name = _name(number)
    return f"{name}{text}" if text.startswith(":") else f"{name} = {text}"


def _name(number: int) -> str:
    """Names of formulas: mine, mine2, mine3 ..."""
    return f"mine{number + 1}" if number else "mine"
