"""Replication: whether what one half of the dwells names lowers the error of the other half, which it never saw.

The orientations are divided in two, every second one in the order of their first visit. The linear tests choose an
effect from one half alone and estimate its coefficients c there; with these, and with the parameters of the model from
the same half, it predicts the other. Let d be by how much the effect changes this prediction, r the innovation without
it, and S its covariance. If the effect is taken into account, chi-squared of the unseen half falls by

  2 d^T S^-1 r - d^T S^-1 d

Where nothing of it is true, the score d^T S^-1 r is normal with the variance d^T S^-1 d, whatever the choosing half
was; where the effect has the size found, this is its mean, too. With rows [H | G | z] and P the projection off H, all
follow from one matrix, that of all rows less that of the choosing half:

  [G z]^T P [G z] - [G z]_seen^T P_seen [G z]_seen

Both halves choose in turn. As they then judge each other, their p-values depend on each other; e times their geometric
mean holds for any dependence (V. Vovk and R. Wang, 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from kf_calib.bench.arrays import Floats, Indices
from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.diagnosis.run_terms import log_bayes_of_any_size
from kf_calib.effects import Effect
from kf_calib.estimation.candidate_scan import SEEN, Complement, Scan, counts_of, project, slices
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Calibration, Consistency
from kf_calib.estimation.score_test import triangles
from kf_calib.support.tail_probabilities import LEVEL, f_tail

FEWEST = 12
"""Dwells that a run needs to be divided."""


Answer = Literal["yes", "no", "cannot tell"]


@dataclass(frozen=True)
class UnseenHalf:
    """A half of the dwells, predicted by what the other half named.

    - dwells: their numbers. named: the effects that the other half chose; relevant: whether they are among those that
      the verdict names or leaves open.
    - fall: of chi-squared of this half by the prediction. predicted: the same as the size in the choosing half has it.
    - p_value: that noise lets the prediction do as well. p_less: that the size found lets it do as badly.
    """

    dwells: tuple[int, ...]
    named: tuple[str, ...]
    relevant: bool
    fall: float
    predicted: float
    p_value: float
    p_less: float


@dataclass(frozen=True)
class Replication:
    """Both halves; empty where the dwells are too few to be divided, or where no prediction can be made."""

    halves: tuple[UnseenHalf, ...] = ()

    @property
    def relevant(self) -> tuple[UnseenHalf, ...]:
        """The halves that were predicted by an effect of the verdict."""
        return tuple(half for half in self.halves if half.relevant)

    @property
    def fall(self) -> float:
        """Fall of chi-squared of dwells that choosing never saw, by effects of the verdict."""
        return sum(half.fall for half in self.relevant)

    @property
    def predicted(self) -> float:
        """The same as the sizes in the choosing halves have it."""
        return sum(half.predicted for half in self.relevant)

    @cached_property
    def p_value(self) -> float:
        """That noise lets predictions do as well; 1 without a prediction."""
        return _combined([half.p_value if half.relevant else 1.0 for half in self.halves])

    @cached_property
    def p_less(self) -> float:
        """That the sizes found let the same predictions do as badly."""
        return _combined([half.p_less if half.relevant else 1.0 for half in self.halves])

    @property
    def answer(self) -> Answer:
        """Whether the verdict replicates: a significant fall, or significantly less than predicted, or neither."""
        if self.p_value < LEVEL and self.fall > 0.0:
            return "yes"
        return "no" if self.p_less < LEVEL else "cannot tell"


def _combined(p_values: Sequence[float]) -> float:
    """Return e times the geometric mean of p-values, at most 1; 1 of none."""
    return min(1.0, math.e * math.exp(float(np.mean(np.log(np.maximum(p_values, 1e-300)))))) if p_values else 1.0


def replication(before: Calibration, relevant: Sequence[str], count: int, left: Consistency) -> Replication:
    """The replication of a verdict.

    before: the run without what is missing, in the noise that it leaves. relevant: names of the effects that the
    verdict names or leaves open. count: how many it names. left: the test of the misfit that they leave, by which
    noise is enlarged.
    """
    fitted, effects = before.fit, candidates(before.model)
    groups, walks = orientations(fitted.dwells), fitted.noise.for_goodness_of_fit.walk.steps
    if len(fitted.dwells) < FEWEST or len(groups) < 2 or walks or not {*map(str, effects)} & {*relevant}:
        return Replication()
    noise = max(1.0, left.statistic / left.dof) if left.dof > 0 else 1.0
    halves = [np.sort(np.concatenate(groups[first::2])) for first in (0, 1)]
    rows = _DividedRows(fitted, effects, halves, noise)
    if not rows.both_determine:
        return Replication()
    numbers = [dwell.number for dwell in fitted.dwells]
    unseen = list[UnseenHalf]()
    for seen in (0, 1):
        choice = rows.choice(seen, count)
        names = tuple(str(effect) for effect in choice.effects)
        figures = rows.prediction(seen, choice, max(left.dof, 1))
        of_verdict = bool({*names} & {*relevant})
        unseen.append(UnseenHalf(tuple(numbers[k] for k in halves[1 - seen]), names, of_verdict, *figures))
    return Replication(tuple(unseen))


@dataclass(frozen=True)
class _Choice:
    """What a half chose: effects, the places of their columns, and their coefficients (q,) with covariance."""

    effects: tuple[Effect, ...]
    places: Indices
    coefficients: Floats
    covariance: Floats


class _DividedRows:
    """The triangles of the whitened rows [H | W | G | z] of a run and of each half of its dwells."""

    def __init__(self, fitted: Fit, effects: Sequence[Effect], halves: Sequence[Indices], noise: float) -> None:
        self._effects, self._noise = effects, noise
        found = triangles(fitted.linearised, fitted.noise.for_goodness_of_fit, effects, halves)
        (self._whole, *self._halves), self._width = found
        self._complement = Complement(self._whole, self._width)
        self._complements = [Complement(half, self._width) for half in self._halves]

    @property
    def both_determine(self) -> bool:
        """Whether each half determines what the whole run does."""
        ranks = [_rank(rows[:, : self._width]) for rows in (self._whole, *self._halves)]
        return min(ranks) == max(ranks)

    def choice(self, seen: int, count: int) -> _Choice:
        """The likeliest effect by the linear tests in one half alone, and those that are likeliest beside it."""
        rows, counts = self._halves[seen], counts_of(self._effects)
        scan, parts, chosen = project(rows, self._width, self._effects, counts), slices(counts), list[int]()
        while len(chosen) < count:
            chosen.append(_likeliest(scan, chosen, self._noise))
        places = self._width + np.concatenate([np.arange(parts[k].start, parts[k].stop) for k in chosen])
        sizes = np.linalg.norm(rows[:, places], axis=0)
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        left = self._complements[seen].of(rows[:, [*places, -1]])
        basis, singular, right = np.linalg.svd(left[:, :-1] / sizes, full_matrices=False)
        determined = singular > SEEN
        inverse = (right[determined].T / singular[determined]) @ basis[:, determined].T / sizes[:, None]
        return _Choice(tuple(self._effects[k] for k in chosen), places, inverse @ left[:, -1], inverse @ inverse.T)

    def prediction(self, seen: int, choice: _Choice, dof: int) -> tuple[float, float, float, float]:
        """Fall of chi-squared of the unseen half by a choice, the fall predicted, and the p-values of both."""
        both = [*choice.places, -1]
        of_all = self._complement.of(self._whole[:, both])
        of_seen = self._complements[seen].of(self._halves[seen][:, both])
        gram = of_all.T @ of_all - of_seen.T @ of_seen
        matrix, coefficients = gram[:-1, :-1], choice.coefficients
        pull, score = matrix @ coefficients, float(gram[-1, :-1] @ coefficients)
        square, unsure = float(pull @ coefficients), float(pull @ choice.covariance @ pull)
        if square <= 0.0:
            return 0.0, 0.0, 1.0, 1.0
        expected = square - float(np.trace(matrix @ choice.covariance))
        more = _one_sided(score / math.sqrt(self._noise * square), dof)
        less = _one_sided((expected - score) / math.sqrt(self._noise * (square + unsure)), dof)
        return 2.0 * score - square, 2.0 * expected - square, more, less


def _likeliest(scan: Scan, beside: Sequence[int], noise: float) -> int:
    """Return the number of the likeliest candidate of the likeliest effect, beside one that was chosen.

    noise: the variance of what is left, by which falls of chi-squared are divided.
    """
    statistics = (scan.beside(beside[-1]) if beside else scan.statistics) / noise
    dofs = np.array([candidate.dof for candidate in scan.candidates])
    logs = np.full(len(dofs), -np.inf)
    for dof in set(dofs[dofs > 0].tolist()):
        along = np.sqrt(statistics[dofs == dof])[:, None] * np.eye(1, dof)
        logs[dofs == dof] = log_bayes_of_any_size(np.broadcast_to(np.eye(dof), (len(along), dof, dof)), along)
    taken, values = {str(scan.candidates[k].effect) for k in beside}, dict[str, list[int]]()
    for k in np.flatnonzero(np.isfinite(logs)).tolist():
        if str(scan.candidates[k].effect) not in taken:
            values.setdefault(str(scan.candidates[k].effect), []).append(k)
    means = {
        name: float(np.logaddexp.reduce(logs[own])) - math.log(len(own) / scan.candidates[own[0]].effect.prior)
        for name, own in values.items()
    }
    best = values[max(means, key=lambda name: means[name])]
    return best[int(np.argmax(logs[best]))]


def _rank(columns: Floats) -> int:
    """Return the number of directions that rows determine, columns of zeros left out."""
    sizes = np.linalg.norm(columns, axis=0)
    singular = np.linalg.svd(columns[:, sizes > 0.0] / sizes[sizes > 0.0], compute_uv=False)
    return int(np.sum(singular > 1e-4 * singular[0]))


def _one_sided(t: float, dof: float) -> float:
    """Return the probability that Student's t exceeds this."""
    tail = 0.5 * f_tail(1.0, dof, t * t)
    return tail if t > 0.0 else 1.0 - tail
