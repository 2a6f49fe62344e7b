"""Candidates against a model: what each would explain, what it cannot be told from, how small it may be.

The candidates' columns G are evaluated and whitened once for a run and its noise, and written in an orthonormal frame
of their own. Beside any model H, readings z, and columns that come later only these are whitened; what they have in
the frame and beside it is a small matrix, in which G and z are projected off H. Everything asked of a candidate is
then read from that: its score test, its coefficients, its overlap with any other, and the size at which it would be
found.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.line_spectrum import Line
from kf_calib.dwells.qr import orthonormal
from kf_calib.dwells.sufficient_statistics import DwellFactor, lines_of
from kf_calib.effects import Effect, Stimulus
from kf_calib.estimation import random_walk, square_root_information
from kf_calib.estimation.dwell_columns import Carried, candidate_columns, stimulus_of
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.noise_model import Noise, steps
from kf_calib.estimation.periodogram import Periodogram

_SEEN = 1e-6
"""A candidate of which the model leaves less than this share is invisible."""

_SAME = 1.0 - 1e-6
"""Cosine above which two directions are one."""

_TOGETHER = 24  # columns, at least, that are whitened at a time: memory stays that of the result
_CELLS = 10_000  # columns times dwells that are whitened at a time, where that is more
_OF_ONE_KIND = 400  # the same of many effects of one kind
_MANY = 100  # oscillations, of which a periodogram is quicker


@dataclass(frozen=True, repr=False)
class Candidate:
    """One effect (its unknown at one value) as far as the model does not explain it.

    basis (d, k): orthonormal, of what is left of its columns; directions (d, q): those of the basis that are nearest to
    the columns, whichever way the basis is turned; inverse (q, k): coefficients = inverse @ basis^T r;
    columns (d, q): what is left of the columns, per unit of the coefficients; hidden (q,): which of these are not
    determined; visibility: the largest share of a column that is left; tried: the best of so many values of its
    constant, each a test of its own.
    """

    effect: Effect
    columns: Floats
    basis: Floats
    directions: Floats
    inverse: Floats
    hidden: Mask
    visibility: float
    tried: int = 1

    @property
    def dof(self) -> int:
        return self.basis.shape[1]

    @cached_property
    def sigma(self) -> Floats:
        """Of the coefficients (q,), were it the only effect added; infinite where not determined."""
        return np.where(self.hidden, np.inf, np.linalg.norm(self.inverse, axis=1))

    def within(self, other: Candidate, cosine: float = _SAME) -> bool:
        """Whether all that it can do the other can do, too, by the largest principal angle: then no reading can speak
        for it and against the other."""
        if not 0 < self.dof <= other.dof:
            return False
        cosines = self.basis.T @ other.basis
        if np.vdot(cosines, cosines) <= self.dof * cosine**2:  # the smallest is no larger than their root mean square
            return False
        return float(np.linalg.svd(cosines, compute_uv=False)[-1]) > cosine

    def overlap(self, other: Candidate) -> float:
        """Cosine of the smallest principal angle: 1 where some combination of the one mimics one of the other."""
        if not (self.dof and other.dof):
            return 0.0
        return float(np.linalg.svd(self.basis.T @ other.basis, compute_uv=False)[0])


@dataclass(frozen=True, repr=False)
class Scan:
    """Candidates in a common orthonormal frame of d dimensions, and the residual (d,) there, of unit noise."""

    candidates: tuple[Candidate, ...]
    residual: Floats

    @cached_property
    def statistics(self) -> Floats:
        """By how much adding each candidate would lower chi-squared; chi-squared of its dof if nothing is missing."""
        return np.array([np.sum((each.basis.T @ self.residual) ** 2) for each in self.candidates])

    def explained(self, columns: Floats) -> tuple[float, int]:
        """By how much all of these columns (d, q) of the frame together lower chi-squared, and their rank."""
        left, singular, _ = np.linalg.svd(columns, full_matrices=False)
        spanned = left[:, singular > 1e-6]
        return float(np.sum((spanned.T @ self.residual) ** 2)), spanned.shape[1]

    def coefficients(self, candidate: Candidate) -> Floats:
        """Coefficients (q,) of a candidate, were it the only effect added."""
        return candidate.inverse @ (candidate.basis.T @ self.residual)


class Frame:
    """The whitened columns of ``effects`` over all dwells, C = basis (m, r) coordinates (r, q), basis orthonormal.

    It serves every model of the same dwells that is judged by the same noise; rotations and input axes stay linearised
    at the ``state`` it was made with.
    """

    def __init__(self, carried: Carried, noise: Noise, effects: Sequence[Effect]) -> None:
        self.dwells, self.noise, self.state, self.effects = carried.dwells, noise, carried.state, list(effects)
        self.parts = _parts(effects)
        self._stimulus = stimulus_of(carried.dwells, carried.model.bench, carried.state)
        self.basis, self.coordinates = orthonormal(
            whitened_columns(carried, noise, effects, carried.state, self._stimulus)
        )
        self._periodogram: Periodogram | None = None
        self._lines: dict[float, tuple[Line, ...]] = {}
        self._last: tuple[Carried, Floats, Floats, int] | None = None

    def only(self, effects: Sequence[Effect]) -> Frame:
        """The frame with no others than these effects, which it has to have."""
        own = dict(zip(map(_key, self.effects), self.parts, strict=True))
        out = copy.copy(self)
        out.effects = list(effects)
        out.coordinates = np.concatenate(
            [self.coordinates[:, :0], *(self.coordinates[:, own[_key(each)]] for each in effects)], axis=1
        )
        out.parts = _parts(effects)
        return out

    def has(self, effect: Effect) -> bool:
        """Whether the effect, at the value where its constant stands, is among its own."""
        return _key(effect) in map(_key, self.effects)

    def lines(self, level: float) -> tuple[Line, ...]:
        """Oscillations in the readings of the dwells (``sufficient_statistics.lines_of``), whatever the model."""
        if level not in self._lines:
            self._lines[level] = lines_of(self.dwells, level)
        return self._lines[level]

    def serves(self, carried: Carried, noise: Noise) -> bool:
        """Whether these dwells are the frame's, judged by the same noise."""
        same = len(carried.dwells) == len(self.dwells) and all(map(_is, carried.dwells, self.dwells))
        return same and all(np.array_equal(getattr(noise, key), getattr(self.noise, key)) for key in _OF_NOISE)

    def scan(self, carried: Carried, more: Sequence[Effect] = ()) -> Scan:
        """Those of the effects that the model carried does not have, and ``more`` behind them, beside that model."""
        kept = [k for k, effect in enumerate(self.effects) if str(effect) not in carried.model.parts]
        inside, outside, width = self._model(carried)
        more_inside, more_outside = self._split(whitened_columns(carried, self.noise, more, self.state, self._stimulus))
        beside = square_root_information.accumulate([np.hstack([outside[:, :-1], more_outside, outside[:, -1:]])])
        own = [self.coordinates[:, self.parts[k]] for k in kept]
        count = sum(each.shape[1] for each in own)
        small = np.vstack([
            np.hstack([inside[:, :-1], *own, more_inside, inside[:, -1:]]),
            np.hstack([beside[:, :width], np.zeros((len(beside), count)), beside[:, width:]]),
        ])  # fmt: skip
        effects = [*(self.effects[k] for k in kept), *more]
        return project(
            square_root_information.accumulate([small]),
            width,
            effects,
            [len(effect.coefficients) for effect in effects],
        )

    def _model(self, carried: Carried) -> tuple[Floats, Floats, int]:
        """[H | W | z] of a model in the frame and beside it, and how many columns come before z; kept for the next
        scan beside the same."""
        if self._last is None or self._last[0] is not carried:
            rows, width = whiten_model(carried, self.noise, [], self.state, self._stimulus)
            self._last = carried, *self._split(rows), width
        return self._last[1:]

    def _split(self, rows: Floats) -> tuple[Floats, Floats]:
        """Columns (m, c) as coordinates (r, c) in the frame, and what is beside it (m, c)."""
        inside = self.basis.T @ rows
        return inside, rows - self.basis @ inside

    def falls(self, carried: Carried, effect: Effect, values_hz: Floats) -> Floats:
        """By how much an oscillation at each of these frequencies, alone, would lower chi-squared (n,) beside the model
        carried; the same frequencies every time."""
        if self._periodogram is None:
            self._periodogram = Periodogram(carried, self.noise, effect, values_hz)
        rows, width = _judged(carried.dwells, carried.columns, self.noise, self.state, STATE_COUNT)
        own = np.concatenate(rows[len(rows) - len(self.dwells) :])
        return self._periodogram.falls(_stacked(rows, self.dwells, self.noise), own[:, _inside(self.noise) :], width)


_OF_NOISE = ("sigma_mps2", "inflation", "setting_rad", "scatter_mps2", "walk_mps2_per_sqrt_s")


def _parts(effects: Sequence[Effect]) -> list[slice]:
    """Where the columns of each effect are."""
    ends = np.cumsum([0, *(len(effect.coefficients) for effect in effects)]).tolist()
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def _key(effect: Effect) -> tuple[str, float]:
    return str(effect), effect.value


def _is(one: object, other: object) -> bool:
    return one is other


def scan(carried: Carried, noise: Noise, effects: Sequence[Effect]) -> Scan:
    """Project ``effects`` off the model carried."""
    rows, width = whiten_model(carried, noise, effects)
    return project(
        square_root_information.accumulate([rows]), width, effects, [len(effect.coefficients) for effect in effects]
    )


def project(upper: Floats, width: int, effects: Sequence[Effect], counts: Sequence[int]) -> Scan:
    """The scan of a triangle [H | G | z] whose first ``width`` columns are the model's, then ``counts`` an effect."""
    sizes, rest = np.linalg.norm(upper[:, width:-1], axis=0), _beside(upper, width)
    units = np.where(sizes > 0, sizes, 1.0)
    columns, residual = rest[:-1, :-1] / units, rest[:-1, -1]
    ends = np.cumsum([0, *counts]).tolist()
    parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
    found = [_candidate(each, columns[:, part], units[part]) for each, part in zip(effects, parts, strict=True)]
    return Scan(tuple(found), residual)


def _beside(rows: Floats, width: int) -> Floats:
    """What rows [H | G | z] hold of G and z beside the first ``width`` columns."""
    left, singular, _ = np.linalg.svd(
        square_root_information.scale_columns(rows[:, : width + 1])[0], full_matrices=False
    )
    explained, rest = left[:, singular > 1e-9], rows[:, width:]
    for _ in range(2):  # twice, or the rounding of what is large stays in what is left
        rest = rest - explained @ (explained.T @ rest)
    return rest


def falls(carried: Carried, noise: Noise, effects: Sequence[Effect]) -> Floats:
    """By how much each of many effects of one kind, alone, would lower chi-squared (n,): a scan's ``statistics``.

    Nothing else is asked of them, so the rows are not folded: of n columns in d rows that takes d n, not d n^2.
    """
    if effects[0].oscillates and len(effects) > _MANY:
        rows, width = _judged(carried.dwells, carried.columns, noise, carried.state, carried.model.count)
        own = np.concatenate(rows[len(rows) - len(carried.dwells) :])[:, _inside(noise) :]
        many = Periodogram(carried, noise, effects[0], np.array([effect.value for effect in effects]))
        return many.falls(_stacked(rows, carried.dwells, noise), own, width)
    out = list[Floats]()
    for part in batches([len(effect.coefficients) for effect in effects], _OF_ONE_KIND):
        rows, width = whiten_model(carried, noise, [effects[k] for k in part])
        sizes, rest = np.linalg.norm(rows[:, width:-1], axis=0), _beside(rows, width)
        columns = rest[:, :-1] / np.where(sizes > 0, sizes, 1.0)
        columns = columns.T.reshape(len(part), -1, len(rest))
        along, gram = columns @ rest[:, -1], columns @ columns.swapaxes(1, 2)
        inverse = np.linalg.pinv(gram, rcond=_SEEN, hermitian=True)
        out.append(np.einsum("ni,nij,nj->n", along, inverse, along))
    return np.concatenate(out)


def whiten_model(
    carried: Carried,
    noise: Noise,
    effects: Sequence[Effect],
    state: Floats | None = None,
    stimulus: Stimulus | None = None,
) -> tuple[Floats, int]:
    """Rows [H | W | G | z] (m, c) of unit noise of the model carried and of ``effects``, and how many columns come
    before G. state: where rotations and input axes are linearised, other than where the model is; stimulus: of the
    dwells there, where it is known."""
    at, dwells = carried.state if state is None else state, carried.dwells
    added = candidate_columns(dwells, effects, carried.model.bench, at, stimulus)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(carried.columns, added, strict=True)]
    rows, width = _judged(dwells, columns, noise, at, carried.model.count)
    return _stacked(rows, dwells, noise), width


def whitened_columns(
    carried: Carried, noise: Noise, effects: Sequence[Effect], state: Floats, stimulus: Stimulus
) -> Floats:
    """G (m, q) of ``whiten_model``, some effects at a time: it takes no more memory than the result."""
    sizes, out, first = [len(effect.coefficients) for effect in effects], np.zeros((0, 0)), 0
    for part in batches(sizes, columns_at_once(carried)) or [[]]:
        own = _columns_of_some(carried, noise, [effects[k] for k in part], state, stimulus)
        out = out if len(out) else np.empty((len(own), sum(sizes)))
        out[:, first : first + own.shape[1]], first = own, first + own.shape[1]
    return out


def _columns_of_some(
    carried: Carried, noise: Noise, effects: Sequence[Effect], state: Floats, stimulus: Stimulus
) -> Floats:
    dwells, bench = carried.dwells, carried.model.bench
    added = candidate_columns(dwells, effects, bench, state, stimulus)
    if not _inside(noise):
        return square_root_information.misfit_columns(dwells, added, noise, state)
    # a walk is whitened by the columns of the biases, which are among the twelve
    both = [
        np.concatenate([own[..., :STATE_COUNT], more], axis=3) for own, more in zip(carried.columns, added, strict=True)
    ]
    rows, width = _judged(dwells, both, noise, state, STATE_COUNT)
    return _stacked(rows, dwells, noise)[:, width:-1]


def columns_at_once(carried: Carried) -> int:
    """How many columns are whitened at a time: more of few dwells, for which calls cost more than what they do."""
    return max(_TOGETHER, _CELLS // len(carried.dwells))


def batches(sizes: Sequence[int], columns: int) -> list[list[int]]:
    """Numbers of effects of so many columns each, in order, as many together as have about ``columns``."""
    ends = (np.cumsum(sizes) // columns).tolist()
    return [[k for k, end in enumerate(ends) if end == each] for each in dict.fromkeys(ends)]


def _judged(
    dwells: Sequence[DwellFactor], columns: Sequence[Floats], noise: Noise, state: Floats, width: int
) -> tuple[list[Floats], int]:
    """``square_root_information.misfit_rows`` with all rows that the dwells have."""
    return square_root_information.misfit_rows(dwells, columns, noise, state, width, reduced=False)


def _stacked(rows: Sequence[Floats], dwells: Sequence[DwellFactor], noise: Noise) -> Floats:
    """All rows, a walk of the biases taken out of their noise."""
    return random_walk.whiten_walk(rows, steps(dwells, noise)) if _inside(noise) else np.concatenate(rows)


def _inside(noise: Noise) -> int:
    """How many columns lead a dwell's rows, of the steps that the biases take in it."""
    return 3 if noise.walk_mps2_per_sqrt_s else 0


def _candidate(effect: Effect, columns: Floats, units: Floats) -> Candidate:
    """``columns`` (d, q) in the frame, each divided by what it was before the projection, ``units`` (q,)."""
    left, singular, right = np.linalg.svd(columns, full_matrices=False)
    seen = singular > _SEEN
    lost = np.eye(len(units)) - right[seen].T @ right[seen]
    inverse = (right[seen].T / singular[seen]) / units[:, None]
    hidden, basis = np.asarray(np.diag(lost) > 1e-6), left[:, seen]
    return Candidate(
        effect, columns * units, basis, basis @ right[seen], inverse, hidden, float(singular.max(initial=0.0))
    )
