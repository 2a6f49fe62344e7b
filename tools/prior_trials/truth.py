"""A truth drawn from the priors of the program: an explanation, its sizes, and noise from dwell to dwell.

What is drawn are the very weights that ``RunPosterior`` has before it sees a reading, so that a probability of 70 % has
to be right in 70 of 100 runs. A size that is below the noise of one mean has no row, and counts as nothing missing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.hypothesis_table import KINDS, PRIOR
from kf_calib.diagnosis.noise_sizes import NoiseSizes
from kf_calib.diagnosis.run_likelihood import RunLikelihood
from kf_calib.diagnosis.run_terms import _DECADES, EVERY, RunTerm, RunTerms
from kf_calib.dwells.pieces import OfPieces
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect, effect_named
from kf_calib.estimation.dwell_columns import candidate_columns
from kf_calib.noise.means import means_of

NOTHING, NOISE, UNKNOWN, DWELL = "nothing", "noise", "unknown", "one dwell"
_COUNTS = {kind: counts for counts, kind in KINDS.items()}
"""Effects and unknown functions of each kind of explanation."""

_NOISE_RANGE = (0.1, 100.0)  # of noise from dwell to dwell, in that which was stated
_LARGEST = 3000.0  # root of chi-squared of an explanation: a larger one is drawn again, since it is far from linear


@dataclass(frozen=True)
class Truth:
    """What is true of a run: the explanation as a row of the table has it, and what it adds to the readings at the
    nodes of all pieces (P, 3, 3); coefficients: of effects alone, by their names, at values of their constants."""

    label: str
    added_mps2: Floats
    coefficients: dict[str, list[float]]


class Prior:
    """The prior of one run without anything missing.

    terms, noises: of its posterior. dwells: of it, about which all is linear.
    """

    def __init__(self, terms: RunTerms, noises: NoiseSizes, dwells: DwellTable) -> None:
        self._terms, self._noises, self._dwells = terms, noises, dwells
        self._state = terms.likelihood.linearised.state

    def drawn(self, rng: np.random.Generator) -> Truth:
        """A truth: one explanation, and noise that does not depend on it."""
        label, added, coefficients = self._explanation(rng)
        while self._size(added) > _LARGEST:
            label, added, coefficients = self._explanation(rng)
        noisy, noise = self._noise(rng)
        if label == NOTHING and noisy:
            label = NOISE
        return Truth(label, added + noise, coefficients)

    def _size(self, added_mps2: Floats) -> float:
        """Return the root of chi-squared of what is added to the means of dwells, in the noise that was stated."""
        values = OfPieces(added_mps2[..., None], self._dwells.folded.ends)
        return float(np.linalg.norm(self._terms.likelihood._root @ means_of(self._dwells, values).design))

    def _explanation(self, rng: np.random.Generator) -> tuple[str, Floats, dict[str, list[float]]]:
        """Return one explanation: its label, what it adds, and its coefficients."""
        kind = _one_of(rng, [*PRIOR], [*PRIOR.values()])
        names, nothing = self._terms.names, np.zeros((len(self._dwells.folded.pieces), 3, 3))
        weights = [effect_named(name, self._terms.bench).prior for name in names]
        known, unknown = _COUNTS.get(kind, (0, 0))
        sets = [*itertools.combinations(range(len(names)), known)]
        chosen = sorted(names[k] for k in _one_of(rng, sets, [math.prod(weights[k] for k in each) for each in sets]))
        parts = [self._of_row(rng, name) for name in chosen]
        # what each arrival changes has a row where a quiet run shows it by chance
        numbers = [k for k in range(len(self._terms.unknown)) if f"?{k}" != self._terms.arrivals]
        of_unknown = rng.choice(numbers, unknown, replace=False).tolist()
        parts += [self._of_row(rng, f"?{number}") for number in of_unknown]
        if kind == "dwell":
            return DWELL, self._one_dwell(rng), {}
        names = [*chosen, *(UNKNOWN for _ in of_unknown)]
        seen = [(name, part) for name, part in zip(names, parts, strict=True) if part is not None]
        label = " + ".join(dict.fromkeys(name for name, _ in seen)) or NOTHING
        known = {name: coefficients for name, (_, coefficients) in seen if coefficients}
        return label, sum((added for _, (added, _) in seen), nothing), {} if unknown else known

    def _of_row(self, rng: np.random.Generator, row: str) -> tuple[Floats, list[float]] | None:
        """Return what a term of a row adds, and its coefficients; None where its size is one that nothing shows."""
        terms = [term for term in self._terms.terms if term.row == row]
        if not terms:
            return None
        term = _one_of(rng, terms, np.exp([term.log_share for term in terms]).tolist())
        shares = np.exp(term.sizes.logs)
        index = int(np.searchsorted(np.cumsum(shares), rng.random()))
        if index == len(shares):
            return None
        drawn = term.sizes.centre + term.sizes.values[index] * rng.standard_normal(len(term.columns))
        effects, coefficients = self._effects(rng, term, drawn)
        return self._columns(effects) @ coefficients, coefficients.tolist() if term.effect is not None else []

    def _effects(self, rng: np.random.Generator, term: RunTerm, drawn: Floats) -> tuple[list[Effect], Floats]:
        """Return the effects of a term with the coefficients in SI that it has by those drawn."""
        if term.effect is not None:
            relations = [*term.effect.relations]
            if not relations:
                return [term.effect], _in_all(term, drawn, len(term.effect.coefficients))
            matrix = relations[int(rng.integers(len(relations)))]
            return [term.effect], matrix @ drawn[: matrix.shape[1]]
        effects = self._terms.made_by(term)
        if not term.summands:
            return effects, self._without_formula(rng, term, drawn)
        unknown = self._terms.unknown[int(term.row[1:])]
        of_texts = [unknown.weight(k) for k in term.summands for _ in unknown.summands[k]]
        weights = np.repeat(of_texts, [len(effect.coefficients) for effect in effects])
        rms = self._rms(effects)
        drawn = _in_all(term, drawn, len(rms))
        return effects, np.where(rms > 0.0, weights / np.where(rms > 0.0, rms, 1.0), 0.0) * drawn

    def _without_formula(self, rng: np.random.Generator, term: RunTerm, drawn: Floats) -> Floats:
        """Return the coefficients of what is irregular, of one accelerometer alone or of all three. Where each has a
        size of its own, it is drawn: the term has the likeliest by its readings."""
        count = len(drawn) if term.only != EVERY else len(drawn) // 3
        scales = np.ones(len(drawn)) if term.scales is None else term.scales
        if len(drawn) > count and np.ptp(scales.reshape(3, -1), axis=0).any():
            scales = np.outer(10.0 ** rng.uniform(-2.0, 0.0, 3), scales.reshape(3, -1).max(axis=0)).ravel()
        return _in_all(term, drawn * scales, 3 * count)

    def _rms(self, effects: Sequence[Effect]) -> Floats:
        """Return the rms (C,) of the columns of effects, in units of the noise, as the terms are scaled."""
        likelihood = self._terms.likelihood
        own = RunLikelihood(likelihood.linearised, likelihood.noise, 1e-12, effects)
        return own.lengths / math.sqrt(own.rows)

    def _columns(self, effects: Sequence[Effect]) -> Floats:
        """Return the columns (P, 3, 3, C) of effects at the nodes."""
        return candidate_columns(self._dwells, effects, self._terms.bench, self._state).values

    def _one_dwell(self, rng: np.random.Generator) -> Floats:
        """Return offsets of one dwell alone, of any size."""
        size = 10.0 ** rng.uniform(0.0, _DECADES)
        return self._at_dwells(size * rng.standard_normal((1, 3)), [int(rng.integers(len(self._dwells)))])

    def _noise(self, rng: np.random.Generator) -> tuple[bool, Floats]:
        """Return whether there is noise from dwell to dwell beyond what was stated, and what it adds."""
        families = self._noises.families
        family = _one_of(rng, families, np.exp([family.log_prior for family in families]).tolist())
        if not family.parts:
            return False, np.zeros((len(self._dwells.folded.pieces), 3, 3))
        size = float(np.exp(rng.uniform(*np.log(_NOISE_RANGE))))
        values, turns = np.linalg.eigh(family.shapes)
        errors = size * np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
        return True, self._at_dwells((turns @ errors[..., None])[..., 0], range(len(self._dwells)))

    def _at_dwells(self, errors: Floats, dwells: Sequence[int]) -> Floats:
        """Return offsets (d, 3), in units of the noise of the mean of some dwells, at the nodes of all pieces."""
        ends, added = self._dwells.folded.ends, np.zeros((len(self._dwells.folded.pieces), 3, 3))
        for k, error in zip(dwells, errors, strict=True):
            added[ends[k] : ends[k + 1]] = np.linalg.solve(self._terms.likelihood._root[k], error)
        return added


def with_truth(dwells: DwellTable, truth: Truth) -> DwellTable:
    """The dwells with what is true added to their readings."""
    return dwells.plus(on_basis(truth.added_mps2))


def _in_all(term: RunTerm, drawn: Floats, count: int) -> Floats:
    """Return the coefficients (count,) of all accelerometers, zeros where one alone has a term."""
    coefficients = np.zeros(count)
    coefficients[term.only] = drawn
    return coefficients


def _one_of(rng: np.random.Generator, things: Sequence, weights: Sequence[float]):
    """Return one of some things, by their weights."""
    shares = np.cumsum(weights)
    return things[int(np.searchsorted(shares, rng.random() * shares[-1]))]
