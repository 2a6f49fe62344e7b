"""The terms that a run may have, as columns of its likelihood: effects at each value of their constant, unknown
functions, a random walk of the biases. Each has sizes with a prior, and a share in the prior of its row.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from scipy.special import softmax

from kf_calib.bench.arrays import Floats, Indices
from kf_calib.diagnosis.candidate_tests import GRID, CandidateTests
from kf_calib.diagnosis.coefficient_sizes import SizePrior, best_sigma, sensor_grade, usual_sizes
from kf_calib.diagnosis.in_noises import InNoises
from kf_calib.diagnosis.run_likelihood import (
    Combination,
    RunLikelihood,
    Sizes,
    log_bayes,
    log_bayes_beside,
    orthonormal_columns,
)
from kf_calib.diagnosis.unknown_terms import (
    MOST_ALTERNATIVES,
    RETURNING,
    UnknownTerm,
    constants_s,
    text_named,
    unknown_terms,
)
from kf_calib.diagnosis.within_rows import Courses, log_bayes_by_size
from kf_calib.dwells.qr import orthonormal
from kf_calib.effects import Coefficient, Effect, RotationEffect, Stimulus, effect_named, walk_named
from kf_calib.effects.effect import Grade
from kf_calib.effects.formula import formula
from kf_calib.estimation.candidate_scan import SEEN
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.observability import impossible_size
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.within_dwell_trend import trend_beside
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.terms import Scatter
from kf_calib.support.tail_probabilities import LEVEL

_DECADES = 7.0  # above one sigma: sizes of what has no usual size
_NODES = 40  # sizes that are tried: the likelihood of q columns is as wide as 1 / sqrt(2 q) of its logarithm
_FEW, _NODES_OF_FEW = 2, 20  # columns of which a step twice as long sums it to 1e-3
_SAME = 0.999  # cosine above which a summand is a known effect
_END = 0.99  # of the range of a constant
_LEAST = 1e-3  # share of the largest part of a term that a part of it has at least
_FEWEST_WAVES, _WAVES, _SMOOTH = 24, 40, 12  # of a random walk, two a dwell, and of what is smooth
_RATIO = 0.01  # prior probability of one ratio of the sizes that three accelerometers have: one of 3 * 6 * 6
_RETURNS, _PER_DWELL = (4, 8, 16, 32, 64), 0.75  # parts of a run within which a bias may come back, and most of them
_SETTINGS = 3.0  # setting errors, as share of a column, by which it is left of the model and is still not seen
_Course = Callable[[Floats], Floats]
_DECAY: tuple[tuple[float, _Course], ...] = (
    (1.0, lambda u: np.exp(-u)),
    (0.33, lambda u: u * np.exp(-u)),  # rms of a logarithm that is up to half of one to the next constant
    (0.15, lambda u: 0.5 * (u * u - u) * np.exp(-u)),
)
"""Sizes of a decay and its derivatives by the logarithm of its time constant, Taylor's series, of t/tau."""
_RAMP: tuple[tuple[float, _Course], ...] = (
    (1.0, lambda u: u), (0.3, lambda u: u * u), (0.3, np.ones_like)
)  # fmt: skip
"""Sizes of what goes on through a dwell, of t over its length."""
_INSTANTS = 200  # of a dwell, at which the lengths of courses are compared
_WIDE = 16  # columns from which on a decomposition takes longer than what others leave of it in all sizes
_IN_ALL = 0.5  # share of what all accelerometers have, each with its own coefficient, and not one alone; so with axes
EVERY = slice(None)
"""All columns of a term."""


@dataclass(frozen=True)
class RunTerm:
    """Columns (q,) of one term in the likelihood.

    row: the name of an effect, or ``?`` and the number of an unknown function. log_share: log of its share in the prior
    of its row. effect: with the constant at which it has these columns. relation: the number of that of its
    coefficients. summands: of the unknown function, those that it has. bearers: columns of each accelerometer, or of
    each axis of a rotation, that may have it alone. only: which of the columns of all bearers these are. sizes: of its
    coefficients. scales: factors (q,) of the waves of what is irregular, which each accelerometer may have by its own
    size.
    """

    row: str
    columns: Indices
    log_share: float
    effect: Effect | None = None
    relation: int = 0
    summands: tuple[int, ...] = ()
    bearers: tuple[slice, ...] = ()
    only: slice = field(default_factory=lambda: EVERY)
    sizes: Sizes = field(default_factory=lambda: Sizes(np.zeros(0), np.zeros(0)))
    scales: Floats | None = None

    @property
    def alone(self) -> bool:
        """Whether it is of one accelerometer, or axis, alone."""
        return self.only != EVERY

    @property
    def log_share_of_form(self) -> float:
        """The log of the share of its relation, and of the bearers that it is of."""
        relations = self.effect.relations if self.effect is not None else ()
        (log,) = [log for log, only in of_bearers(self.bearers) if only == self.only]
        return log - math.log(max(len(relations), 1))

    @property
    def is_known(self) -> bool:
        """Whether it is an effect of the catalogue."""
        return not self.row.startswith("?")


@dataclass(frozen=True)
class _Alike:
    """Terms of q columns: their numbers (n,), the different sets (s, q) of columns that they have, which of these (n,)
    is that of each, and factors (n, q) of its columns; squares (n, m) of their sizes, logs (n, m) of their
    probabilities, and centres (n,)."""

    numbers: Indices
    places: Indices
    which: Indices
    scales: Floats
    squares: Floats
    log_weights: Floats
    centres: Floats


class RunTerms:
    """All terms of a run and its likelihood.

    before: the run without what is missing. noise, least_mps2: what was stated of it, and scatter that
    there is in any case. test: its linear tests, with the candidates. fitted: effects as they were fitted, with the
    sigma of the logarithm of their constant.
    """

    def __init__(self, before: Calibration, noise: Noise, least_mps2: float, test: CandidateTests,
                 fitted: Sequence[tuple[Effect, float]] = ()) -> None:  # fmt: skip
        self._linearised, self.bench = before.fit.linearised, before.bench
        self.grade: Grade = sensor_grade(before.fit)
        self.walk = "" if before.model.walks else walk_named(before.bench)
        self.unknown: list[UnknownTerm] = [*unknown_terms(before.bench, before.fit.dwells)]
        columns, self._without_formula = _Columns(), dict[str, Effect]()
        self._add_effects(columns, test, fitted)
        self._add_unknown(columns)
        self._add_orientations(columns)
        self._add_arrivals(columns, noise)
        if self.walk:
            self._add_walk(columns)
        self.likelihood = RunLikelihood(self._linearised, noise, least_mps2, columns.effects, blocks=columns.blocks)
        rms = self.likelihood.lengths / math.sqrt(self.likelihood.rows)
        unknown = np.where(rms > 0.0, columns.weights / np.where(rms > 0.0, rms, 1.0), 0.0)
        self.likelihood.rescale(np.where(columns.weights > 0.0, unknown, 1.0))
        # a column that the model has but for setting errors shows these, and nothing of a term
        setting_rad = before.noise.setting.size_rad
        self._least_share = max(SEEN, _SETTINGS * setting_rad if math.isfinite(setting_rad) else 0.0)
        self.terms = [*self._of_bearers(self._seen(columns.terms))]
        self.names = tuple(dict.fromkeys(term.row for term in self.terms if term.is_known))
        in_several = self._in_several_gimbals()
        self._members = {term.row: names for term, names in in_several}
        self.terms += [term for term, _ in in_several]
        self._decompositions = dict[tuple[InNoises, int, int], tuple[Floats, Floats, Floats]]()

    def _add_effects(self, columns: _Columns, test: CandidateTests, fitted: Sequence[tuple[Effect, float]]) -> None:
        """Add the candidates, each with every relation that its coefficients may have, and those that were fitted: of a
        large effect no other value of its constant is near enough."""
        candidates = test.effects.scan.candidates
        effects, tried = [each.effect for each in candidates], [each.tried for each in candidates]
        stimulus = stimulus_of(self._linearised.dwells, self.bench, self._linearised.state)
        logs = np.array([effect.log_share(stimulus) for effect in effects])
        for name in dict.fromkeys(map(str, effects)):
            numbers = [k for k, effect in enumerate(effects) if str(effect) == name]
            most = max(len(numbers), *(tried[k] for k in numbers))
            logs[numbers] -= float(np.logaddexp.reduce(logs[numbers])) + math.log(most / len(numbers))
        shares = logs.tolist()
        for effect, sigma in fitted:
            numbers = [k for k, each in enumerate(effects) if str(each) == str(effect)]
            nearest = min(numbers, key=lambda k: abs(math.log(effects[k].value / effect.value)))
            # of oscillations only the best is left, of those half a cycle in a run apart
            step = math.log(GRID) if len(numbers) > 1 else 0.5 / (stimulus.span_s * effect.value)
            if (width := math.sqrt(2.0 * math.pi) * sigma) < step:
                effects, shares = [*effects, effect], [*shares, shares[nearest] + math.log(width / step)]
        for effect, log in zip(effects, shares, strict=True):
            part, relations = columns.add([effect]), [*effect.relations] or [None]
            for number, matrix in enumerate(relations):
                block, share = columns.block(part, matrix), log - math.log(len(relations))
                columns.term(str(effect), [block], share, effect, number, bearers=effect.bearers)

    def _add_unknown(self, columns: _Columns) -> None:
        """Add the unknown functions: each summand alone, and all together."""
        block_of = cache(lambda text, weight: columns.block(columns.add([self.formula_of(text)]), weight=weight))
        for number, unknown in enumerate(self.unknown):
            blocks = [[block_of(text, unknown.weight(k)) for text in texts] for k, texts in enumerate(unknown.summands)]
            # the simplest come first, and are likeliest; of alternatives any is as likely
            shares = np.ones(len(blocks)) if unknown.at_once else np.arange(1.0, len(blocks) + 1.0) ** -2.0
            shares *= unknown.share(1) / shares.sum()
            for k, of_one in enumerate(blocks):
                bearers = self.formula_of(unknown.summands[k][0]).bearers
                columns.term(f"?{number}", of_one, math.log(shares[k]), summands=(k,), bearers=bearers)
            if not (unknown.at_once or len(blocks) == 1):
                every, share = [*itertools.chain(*blocks)], math.log(unknown.share(0))
                columns.term(f"?{number}", every, share, summands=(*range(len(blocks)),))

    def _add_orientations(self, columns: _Columns) -> None:
        """Add an unknown cause that is alike at each visit of an orientation, where some are visited again."""
        groups, dwells = orientations(self._linearised.dwells), self._linearised.dwells
        self.repeats = self.bench.angles and len(groups) < min(len(dwells), MOST_ALTERNATIVES)
        if self.repeats:
            of_dwell = np.empty(len(dwells), np.intp)
            for k, group in enumerate(groups):
                of_dwell[group] = k
            visits = _Visits(np.repeat(of_dwell, 3 * dwells.folded.piece_numbers), len(groups))
            self.unknown.append(UnknownTerm("the orientation alone, alike at each visit", "", ()))
            row = f"?{len(self.unknown) - 1}"
            self._without_formula[row] = visits
            columns.term(row, [columns.block(columns.add([visits]))], 0.0)

    def _add_arrivals(self, columns: _Columns, noise: Noise) -> None:
        """Add an unknown cause that each arrival starts anew, in each dwell by another amount of either sign, and that
        decays or goes on, where readings change within dwells by more than white noise does."""
        dwells, self.arrivals = self._linearised.dwells, ""
        white = noise.with_terms(Scatter(np.zeros(3), stated=True))
        changes = trend_beside(self._linearised, white, self._linearised.state)
        if len(dwells) > _WAVES or changes is None or changes.p_value > LEVEL:
            return
        numbers = np.repeat(np.arange(len(dwells)), 3 * dwells.folded.piece_numbers)
        longest_s = max(dwell.end_s - dwell.start_s for dwell in dwells)
        kinds = [*((_DECAY, tau_s) for tau_s in constants_s(1, longest_s)), (_RAMP, longest_s)]
        alternatives = [
            [*self._blocks_of_dwells(columns, numbers, courses, unit_s, longest_s)] for courses, unit_s in kinds
        ]
        self.unknown.append(UnknownTerm("time since arrival (by another amount in each dwell)", "memory", ()))
        self.arrivals = f"?{len(self.unknown) - 1}"
        columns.irregular(self.arrivals, alternatives, [np.ones(len(_DECAY) * len(dwells))])

    def _blocks_of_dwells(self, columns: _Columns, numbers: Indices, courses: Sequence[tuple[float, _Course]],
                          unit_s: float, longest_s: float) -> Iterator[int]:  # fmt: skip
        """Yield blocks of columns of each accelerometer, one for each of some courses, with a column for each dwell."""
        count, blocks = len(self._linearised.dwells), list[list[int]]()
        for size, course in courses:
            part = columns.add([_Visits(numbers, count, lambda t_s, f=course: f(t_s / unit_s))])
            weight = size * float(np.linalg.norm(course(np.linspace(0.0, longest_s / unit_s, _INSTANTS))))
            starts = range(part.start, part.stop, count)
            blocks.append([columns.block(slice(first, first + count), weight=weight) for first in starts])
        yield from itertools.chain(*zip(*blocks, strict=True))

    def _add_walk(self, columns: _Columns) -> None:
        """Add a random walk of the biases and, unknown, one of the scale factors; either as the integral of a walk is,
        smooth, with a spectrum that falls with w^2 more; and biases that change as irregularly and come back: the
        spectrum of a Gauss-Markov process of correlation time tau is that of a walk times
        w^2 tau^2 / (1 + w^2 tau^2), and that of 1/f noise is that of a walk times w."""
        dwells = self._linearised.dwells
        run_s, count = dwells[-1].end_s, min(max(2 * len(dwells), _FEWEST_WAVES), _WAVES)
        walks = [_Walk(run_s, most, of_scale) for of_scale in (False, True) for most in (count, min(count, _SMOOTH))]
        blocks = [columns.block(columns.add([walk])) for walk in walks]
        rates, even = walks[0].rates, np.ones(count)
        smooth = rates[0] / walks[1].rates
        taus_s = [run_s / share for share in _RETURNS if share < _PER_DWELL * len(dwells)]
        returning = [1.0 / np.sqrt(1.0 + 1.0 / np.square(rates * tau_s)) for tau_s in taus_s]
        returning.append(np.sqrt(rates / rates[-1]))
        family = effect_named(self.walk, self.bench).family
        self._without_formula[self.walk] = walks[0]
        columns.irregular(self.walk, [[blocks[0]]], [even])
        for driver, of_driver, number, scales in (
            ("time (smooth)", family, 1, [smooth]),
            ("time and specific force (smooth)", "scale in time", 3, [smooth]),
            ("time and specific force (irregular)", "scale in time", 2, [even]),
            (RETURNING, family, 0, returning),
        ):
            self.unknown.append(UnknownTerm(driver, of_driver, ()))
            row = f"?{len(self.unknown) - 1}"
            self._without_formula[row] = walks[number]
            columns.irregular(row, [[blocks[number]]], scales)

    def courses_beside(self, k: int, covariance: Floats | None) -> Courses:
        """What is left of the courses of the readings within dwells by an unknown function, or a random walk, as a term
        has it and as it is likeliest in one noise."""
        term, rows = self.terms[k], self.likelihood.projected(covariance, self.terms[k].columns)
        scales = np.ones(len(term.columns)) if term.scales is None else term.scales
        columns, squares = rows.of(term.columns) * scales, term.sizes.values**2
        values, vectors = np.linalg.eigh(columns.T @ columns)
        along = vectors.T @ (columns.T @ rows.readings)
        logs = term.sizes.logs + log_bayes_by_size(along**2, values, 1.0, squares).sum(axis=0)
        shrunk = squares[:, None] / (1.0 + squares[:, None] * values)
        likeliest = vectors @ (along * (softmax(logs) @ shrunk))
        effects = self.made_by(term)
        coefficients = np.zeros(sum(len(effect.coefficients) for effect in effects))
        coefficients[term.only] = likeliest * scales * self.likelihood.scales[term.columns]
        states = self.likelihood.states_beside(covariance, term.columns, likeliest * scales)
        return self.likelihood.courses_at(states, np.zeros(0), effects, coefficients)

    def made_by(self, term: RunTerm) -> list[Effect]:
        """The effects that make the columns of an unknown function, or of a random walk."""
        if term.row in self._without_formula:
            return [self._without_formula[term.row]]
        summands = self.unknown[int(term.row[1:])].summands
        return [self.formula_of(text) for number in term.summands for text in summands[number]]

    def of_summands(self, term: RunTerm) -> Iterator[tuple[int, Indices]]:
        """Yield the number of each summand that an unknown function has in a term, with its columns."""
        summands = self.unknown[int(term.row[1:])].summands
        widths = [sum(len(self.formula_of(text).coefficients) for text in summands[k]) for k in term.summands]
        yield from zip(term.summands, np.split(term.columns, np.cumsum(widths)[:-1]), strict=True)

    def formula_of(self, text: str) -> Effect:
        """The effect of a formula without a name."""
        return formula(text_named(text), self.bench.axes, self.bench.gravity_mps2, checked=False)

    def _seen(self, drafts: Sequence[RunTerm]) -> list[RunTerm]:
        """Return the terms of which something is seen, with their sizes; a summand that is a known effect is none."""
        raw, known, terms = self.likelihood.lengths, dict[tuple[int, ...], list[Floats]](), list[RunTerm]()
        ends = dict[tuple[str, tuple[int, ...]], list[Floats]]()
        for draft in drafts:
            if _at_its_end(draft.effect):
                basis = _basis(self.likelihood.columns(draft.columns))
                ends.setdefault((draft.row, basis.shape), []).append(basis)
        for draft in drafts:
            columns = self.likelihood.columns(draft.columns)
            if not (np.linalg.norm(columns, axis=0) > self._least_share * raw[draft.columns]).any():
                continue
            if not (draft.is_known or len(draft.summands) == 1):
                scaled = columns if draft.scales is None else columns * draft.scales
                best = float(np.linalg.norm(scaled, 2)) if draft.summands else 1.0 / best_sigma(scaled)
                terms.append(replace(draft, sizes=sizes_of(1.0 / best, None, nodes=_nodes(columns.shape[1]))))
                continue
            basis = _basis(columns)
            alike, limits = known.setdefault(basis.shape, []), ends.get((draft.row, basis.shape), [])
            if draft.is_known and not (limits and _largest_cosine(limits, basis) > _SAME):
                alike.append(basis)
            elif not draft.is_known and alike and _largest_cosine(alike, basis) > _SAME:
                continue
            if (least := best_sigma(columns)) < _most(draft):
                terms.append(replace(draft, sizes=self._sizes(draft, least)))
        return terms

    def _of_bearers(self, terms: Sequence[RunTerm]) -> Iterator[RunTerm]:
        """Yield terms, those of which each bearer has its own columns also as terms of one alone."""
        raw, lengths, ratios = self.likelihood.lengths, self.likelihood.lengths_left, dict[int, Floats]()
        for term in terms:
            for log_share, only in of_bearers(term.bearers):
                places, log = term.columns[only], term.log_share + log_share
                if len(places) == len(term.columns):
                    if term.scales is None:
                        yield replace(term, log_share=log)
                        continue
                    if places[0] not in ratios:  # several terms have the same columns
                        ratios[places[0]] = self._ratios(places)
                    yield replace(term, log_share=log + math.log(0.5))
                    scales = ratios[places[0]] * term.scales
                    yield replace(term, log_share=log + math.log(0.5 * _RATIO), scales=scales)
                elif (lengths[places] > self._least_share * raw[places]).any():
                    scales = None if term.scales is None else term.scales[only]
                    part = replace(term, columns=places, log_share=log, only=only, scales=scales)
                    least = 1.0 / lengths[places].max()
                    if least < _most(part):
                        yield replace(part, sizes=self._sizes(part, least))

    def _in_several_gimbals(self) -> list[tuple[RunTerm, tuple[str, ...]]]:
        """Return, for each error that more than one gimbal shows, the term of them all: what makes one gimbal err makes
        the others err, too, by as much. It comes with the names of the effects of which it has the columns."""
        of_kind, lengths = dict[str, list[RunTerm]](), self.likelihood.lengths_left
        for term in self.terms:
            if term.is_known and isinstance(term.effect, RotationEffect) and term.effect.gimbal is not None:
                of_kind.setdefault(term.effect.name, []).append(term)
        in_several = list[tuple[RunTerm, tuple[str, ...]]]()
        for name, each in of_kind.items():
            longest = [float(lengths[term.columns].max()) for term in each]
            seen = [term for term, length in zip(each, longest, strict=True) if length > _LEAST * max(longest)]
            if len(seen) > 1:
                term = replace(seen[0], row=name, columns=np.concatenate([term.columns for term in seen]))
                term = replace(term, sizes=self._sizes(term, 1.0 / max(longest)))
                in_several.append((term, tuple(term.row for term in seen)))
        return in_several

    def effects_of(self, row: str) -> tuple[str, ...]:
        """The names of the effects that the known terms of a row have: one, or that of each gimbal."""
        return self._members.get(row, (row,))

    def causes_of(self, effects: Sequence[str]) -> list[tuple[str, ...]]:
        """Effects, those that several gimbals have for one cause together."""
        together = [names for names in self._members.values() if {*names} <= {*effects}]
        alone = {*effects}.difference(*together)
        return [*together, *((name,) for name in effects if name in alone)]

    @property
    def causes(self) -> int:
        """The number of known causes: effects, and those that several gimbals have at once."""
        return len(self.names) + len(self._members)

    def _ratios(self, places: Indices) -> Floats:
        """Return factors (q,) of the columns of three accelerometers: the size that is likeliest for each of them alone
        in the noise that was stated, over the largest."""
        rows = self.likelihood.projected(None, places)
        columns = rows.of(places).reshape(len(rows.readings), 3, -1)
        values, vectors = np.linalg.eigh(np.einsum("rik,ril->ikl", columns, columns))
        along = np.einsum("ik,ikl->il", np.einsum("r,rik->ik", rows.readings, columns), vectors)
        sizes = np.geomspace(1.0, 1e4, 2 * _NODES) / math.sqrt(values.max())
        logs = log_bayes_by_size(along.ravel() ** 2, values.ravel(), 1.0, sizes**2)
        likeliest = sizes[logs.reshape(*values.shape, -1).sum(axis=1).argmax(axis=1)]
        return np.repeat(likeliest / likeliest.max(), columns.shape[2])

    def _sizes(self, term: RunTerm, least: float) -> Sizes:
        """Return the sizes of a term from the least that is seen."""
        usual = None if term.effect is None else usual_sizes(term.effect, self.grade)
        return sizes_of(least, usual, _most(term), _nodes(len(term.columns)))

    @cached_property
    def _alike(self) -> list[_Alike]:
        """The terms of equal numbers of columns."""
        widths, alike = np.array([len(term.columns) for term in self.terms]), list[_Alike]()
        for width in np.unique(widths).tolist():
            numbers = np.flatnonzero(widths == width)
            terms = [self.terms[k] for k in numbers.tolist()]
            sizes, unit = [term.sizes for term in terms], np.ones(width)
            places, which = np.unique([term.columns for term in terms], axis=0, return_inverse=True)
            alike.append(
                _Alike(
                    numbers, places, which.ravel(),  # of numpy 2.0 it is (n, 1)
                    np.array([unit if term.scales is None else term.scales for term in terms]),
                    np.stack([each.values for each in sizes]) ** 2, np.stack([each.logs for each in sizes]),
                    np.array([each.centre for each in sizes]),
                )
            )  # fmt: skip
        return alike

    def in_noises(self, shapes: Floats, squares: Floats) -> InNoises:
        """The products of the columns of all terms in noise of some sizes."""
        return self.likelihood.in_noises(shapes, squares, [alike.places for alike in self._alike])

    def log_bayes(self, noises: InNoises, sizes: Sequence[int], explained: Floats | None = None) -> Floats:
        """Log Bayes factors (terms, K) of all terms in noise of K of the sizes.

        explained (K, f, C + 1): what columns beside them, of any size, explain of all columns and of the readings.
        """
        logs = np.zeros((len(self.terms), len(sizes)))
        for number, alike in enumerate(self._alike):
            logs[alike.numbers] = self._log_bayes_of(noises, number, sizes, explained).T
        return logs

    def _log_bayes_of(self, noises: InNoises, number: int, sizes: Sequence[int], explained: Floats | None) -> Floats:
        """Return the log Bayes factors (K, n) of the terms that are alike."""
        alike = self._alike[number]
        squares, log_weights, centres = alike.squares, alike.log_weights, alike.centres
        rounding = noises.rounding[sizes][:, None]
        if explained is None:
            gram, along, lengths = self._products(noises, number, sizes)
            return log_bayes(gram, along, squares, log_weights, centres, lengths, rounding)
        parts = explained[..., alike.places[alike.which]] * alike.scales
        parts = np.moveaxis(parts, 1, 3)  # (K, n, q, f)
        if parts.shape[2] >= _WIDE and not centres.any():
            decomposed = zip(*(self._decomposed(noises, number, k) for k in sizes), strict=True)
            squared, turns, along = map(np.concatenate, decomposed)
            return log_bayes_beside(squared, turns, along, parts, explained[..., -1], squares, log_weights, rounding)
        gram, along, lengths = self._products(noises, number, sizes)
        gram -= parts @ np.swapaxes(parts, 2, 3)
        along -= (parts @ explained[:, None, :, -1:])[..., 0]
        return log_bayes(gram, along, squares, log_weights, centres, lengths, rounding)

    def _products(self, noises: InNoises, number: int, sizes: Sequence[int]) -> tuple[Floats, Floats, Floats]:
        """Return G^T W G (K, n, q, q) and G^T W z (K, n, q) of the terms that are alike, and the largest squares (K, n)
        of their columns."""
        alike = self._alike[number]
        which, scales = alike.which, alike.scales
        of_sizes = np.array(sizes)
        gram = noises.gram(number, of_sizes, which) * scales[:, :, None] * scales[:, None]
        along = noises.along[sizes][:, alike.places[which]] * scales
        return gram, along, noises.lengths[number][of_sizes[:, None], which] * scales.max(axis=1) ** 2

    def _decomposed(self, noises: InNoises, number: int, size: int) -> tuple[Floats, Floats, Floats]:
        """Return the terms that are alike turned to orthogonal columns in noise of one size, made once for all that
        they are tried beside."""
        key = noises, number, size
        if key not in self._decompositions:
            self._decompositions[key] = orthonormal_columns(
                *self._products(noises, number, [size]), noises.rounding[[size]][:, None]
            )
        return self._decompositions[key]

    def bases(self, numbers: Sequence[int], covariance: Floats | None) -> tuple[Floats, Floats]:
        """Orthonormal bases (n, q, r) of some terms in one noise, filled up with zeros, and the readings (r,)."""
        places = [self.terms[k].columns for k in numbers]
        rows = self.likelihood.projected(covariance, np.concatenate(places))
        bases = np.zeros((len(places), max(map(len, places)), len(rows.readings)))
        for basis, place in zip(bases, places, strict=True):
            left, sizes, _ = np.linalg.svd(rows.of(place), full_matrices=False)
            basis[: len(place)] = np.where(sizes > _LEAST * sizes[0], left, 0.0).T
        return bases, rows.readings


class _Columns:
    """The columns of all terms while they are put together: effects that make them, blocks of combinations of these,
    the weights of the blocks' columns (0: as they are), and terms of blocks."""

    def __init__(self) -> None:
        self.effects, self.blocks, self.terms = list[Effect](), list[Combination](), list[RunTerm]()
        self._weights, self._places = list[Floats](), list[Indices]()
        self._made = self._count = 0

    @property
    def weights(self) -> Floats:
        """Usual sizes (C,) of the columns of unknown functions, relative to each other."""
        return np.concatenate(self._weights)

    def add(self, effects: Sequence[Effect]) -> slice:
        """Add the columns of effects; returns where they are."""
        first, self._made = self._made, self._made + sum(len(effect.coefficients) for effect in effects)
        self.effects += effects
        return slice(first, self._made)

    def block(self, part: slice, matrix: Floats | None = None, weight: float = 0.0) -> int:
        """Add combinations of columns; returns their number."""
        width = part.stop - part.start if matrix is None else matrix.shape[1]
        self.blocks.append((part, matrix))
        self._weights.append(np.full(width, weight))
        self._places.append(np.arange(self._count, self._count + width))
        self._count += width
        return len(self.blocks) - 1

    def term(self, row: str, blocks: Sequence[int], log_share: float, effect: Effect | None = None,
             relation: int = 0, summands: tuple[int, ...] = (), bearers: tuple[slice, ...] = (),
             scales: Floats | None = None) -> None:  # fmt: skip
        """Add a term with the columns of some blocks."""
        places = np.concatenate([self._places[block] for block in blocks])
        self.terms.append(RunTerm(row, places, log_share, effect, relation, summands, bearers, scales=scales))

    def irregular(self, row: str, alternatives: Sequence[Sequence[int]], spectra: Sequence[Floats]) -> None:
        """Add terms with the columns (3 n,) of some blocks, n of each of the three accelerometers: one term for each of
        the alternatives and of some factors (n,) of the columns, all as likely."""
        for blocks, scales in itertools.product(alternatives, spectra):
            count = len(scales)
            bearers = tuple(slice(k, k + count) for k in range(0, 3 * count, count))
            log_share = -math.log(len(spectra) * len(alternatives))
            self.term(row, blocks, log_share, bearers=bearers, scales=np.tile(scales, 3))


class _Visits(Effect):
    """A bias of each accelerometer that is another in each orientation, or dwell: numbers (m,) of these
    at all instants, and how many there are. course: by what it is multiplied at times since arrival (m,), s."""

    name, title, source = "visits", "", ""

    def __init__(self, numbers: Indices, count: int, course: _Course = np.ones_like) -> None:
        self.numbers, self.count, self.course = numbers, count, course

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"v{k}", "m/s^2", 1.0, "m/s^2") for k in range(3 * self.count))

    def columns(self, s: Stimulus) -> Floats:
        instants = np.arange(len(self.numbers))[s.places if s.whole is not None else slice(None)]
        columns = np.zeros((len(s), 3, 3, self.count))
        values = self.course(s.since_arrival_s)
        for i in range(3):
            columns[np.arange(len(s)), i, i, self.numbers[instants]] = values
        return columns.reshape(len(s), 3, -1)


class _Walk(Effect):
    """The path of a random walk of the biases, or the scale factors, from its beginning: sums of waves (Karhunen and
    Loeve)."""

    name, title, source = "walk", "", ""

    def __init__(self, run_s: float, count: int, of_scale: bool = False) -> None:
        self.run_s, self.count, self.of_scale = run_s, count, of_scale
        self.rates = (np.arange(count) + 0.5) * np.pi / run_s

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"w{k}", "m/s^2", 1.0, "m/s^2") for k in range(3 * self.count))

    def columns(self, s: Stimulus) -> Floats:
        waves = math.sqrt(2.0 / self.run_s) * np.sin(s.elapsed_s[:, None] * self.rates) / self.rates
        columns = np.zeros((len(s), 3, 3, self.count))
        columns[:, range(3), range(3)] = waves[:, None] * (s.along[:, :, None] if self.of_scale else 1.0)
        return columns.reshape(len(s), 3, -1)


def _nodes(columns: int) -> int:
    """Return how many sizes of a term of so many columns are tried."""
    return _NODES if columns > _FEW else _NODES_OF_FEW


def _most(term: RunTerm) -> float:
    """Return the size from which on there is nothing of a term."""
    return math.inf if term.effect is None else impossible_size(term.effect)


def _at_its_end(effect: Effect | None) -> bool:
    """Tell whether an effect is at the end of the range of its constant. There, and where it has the same columns, it
    is the limit of another one, which may be an unknown function."""
    return effect is not None and effect.unknown is not None and effect.value >= _END * effect.unknown.high


def _basis(columns: Floats) -> Floats:
    """Return an orthonormal basis (r, q) of columns."""
    return orthonormal(columns / max(float(np.linalg.norm(columns, axis=0).max()), 1e-300))[0]


def _largest_cosine(bases: Sequence[Floats], basis: Floats) -> float:
    """Return the cosine of the smallest of the largest angles between a basis and each of some others."""
    products = np.swapaxes(np.stack(bases), 1, 2) @ basis
    close = products[np.einsum("nij,nij->n", products, products) > _SAME**2 * basis.shape[1]]
    return float(np.linalg.svd(close, compute_uv=False).min(axis=1).max(initial=0.0))


def of_bearers(bearers: Sequence[slice]) -> list[tuple[float, slice]]:
    """Columns that a term may have, with the logs of their shares: those of all bearers, or of one alone."""
    if not bearers:
        return [(0.0, EVERY)]
    alone = math.log((1.0 - _IN_ALL) / len(bearers))
    return [(math.log(_IN_ALL), EVERY), *((alone, only) for only in bearers)]


def sizes_of(least: float, usual: SizePrior | None, most: float = math.inf, nodes: int = _NODES) -> Sizes:
    """Sizes from one sigma of what is determined best, each with its prior probability: smaller ones show nothing.

    usual: the prior of the sizes; None: all decades above are as likely. most: the size from which on there are none.
    """
    most = max(most, 2.0 * least)
    if usual is None:
        decades = min(math.log10(most / least), _DECADES)
        values = least * 10.0 ** (decades * (np.arange(nodes) + 0.5) / nodes)
        return Sizes(values, np.full(nodes, -math.log(nodes)))
    if usual.value:
        logs = np.full(nodes, -1e300)
        logs[0] = 0.0
        return Sizes(np.full(nodes, usual.low), logs, usual.value)
    edges = np.geomspace(least, min(max(1e3 * usual.high, 1e4 * least), most), nodes + 1)
    shares = np.diff(usual.below(edges))
    shares[-1] += float(np.diff(usual.below(np.array([edges[-1], most])))[0])
    shares /= float(usual.below(np.array([most]))[0])
    return Sizes(np.sqrt(edges[1:] * edges[:-1]), np.log(np.maximum(shares, 1e-300)))


def log_bayes_of_columns(columns: Floats, readings: Floats) -> float:
    """Log Bayes factor of columns (r, q) of any size, projected as the readings (r,)."""
    return float(log_bayes_of_any_size((columns.T @ columns)[None], (columns.T @ readings)[None])[0])


def log_bayes_of_any_size(gram: Floats, along: Floats, lengths: Floats | None = None) -> Floats:
    """Log Bayes factors (..., n) of n terms of any size from G^T G (..., n, q, q) and G^T z (..., n, q); lengths as of
    ``log_bayes``."""
    largest = np.einsum("...qq->...q", gram).max(axis=(-2, -1))
    sizes = sizes_of(1.0, None)
    squares = sizes.values**2 / np.maximum(largest, 1e-40)[..., None, None]
    return log_bayes(gram, along, squares, sizes.logs, np.zeros(gram.shape[-3]), lengths)
