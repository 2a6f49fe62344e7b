"""Candidates against a model: what each would explain, what it cannot be told from, how small it may be.

The whitened rows [H | G | z] of a run (H the model's columns, G the candidates', z the readings) are folded into one
triangle, and G and z are projected off H. Everything asked of a candidate is then read from a few small matrices:
its score test, its coefficients, its overlap with any other, and the size at which it would be found.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib import information
from kf_calib.effects import Effect
from kf_calib.folding import Carried, candidate_columns
from kf_calib.noise import Noise, steps
from kf_calib.samples import Floats, Mask
from kf_calib.walk import unfolded

_SEEN = 1e-6
"""A candidate of which the model leaves less than this share is invisible."""

_SAME = 1.0 - 1e-6
"""Cosine above which two directions are one."""

_TOGETHER = 200  # of many effects, so many are held at a time


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
        return float(np.linalg.svd(self.basis.T @ other.basis, compute_uv=False)[-1]) > cosine

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


def scan(carried: Carried, noise: Noise, effects: Sequence[Effect]) -> Scan:
    """Project ``effects`` off the model carried."""
    rows, width = _rows(carried, noise, effects)
    counts = [len(effect.coefficients) for effect in effects]
    return projected(information.accumulated(rows, steps(carried.dwells, noise)), width, effects, counts)


def projected(upper: Floats, width: int, effects: Sequence[Effect], counts: Sequence[int]) -> Scan:
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
    left, singular, _ = np.linalg.svd(information.scaled(rows[:, : width + 1])[0], full_matrices=False)
    explained, rest = left[:, singular > 1e-9], rows[:, width:]
    for _ in range(2):  # twice, or the rounding of what is large stays in what is left
        rest = rest - explained @ (explained.T @ rest)
    return rest


def falls(carried: Carried, noise: Noise, effects: Sequence[Effect]) -> Floats:
    """By how much each of many effects of one kind, alone, would lower chi-squared (n,): a scan's ``statistics``.

    Nothing else is asked of them, so the rows are not folded: of n columns in d rows that takes d n, not d n^2.
    """
    out = list[Floats]()
    for first in range(0, len(effects), _TOGETHER):
        part = effects[first : first + _TOGETHER]
        rows, width = _rows(carried, noise, part, reduced=False)
        if noise.walk_mps2_per_sqrt_s:
            stacked, walked = unfolded(rows, steps(carried.dwells, noise), width)
            width += walked
        else:
            stacked = np.concatenate(rows)
        sizes, rest = np.linalg.norm(stacked[:, width:-1], axis=0), _beside(stacked, width)
        columns = rest[:, :-1] / np.where(sizes > 0, sizes, 1.0)
        columns = columns.T.reshape(len(part), -1, len(rest))
        along, gram = columns @ rest[:, -1], columns @ columns.swapaxes(1, 2)
        inverse = np.linalg.pinv(gram, rcond=_SEEN, hermitian=True)
        out.append(np.einsum("ni,nij,nj->n", along, inverse, along))
    return np.concatenate(out)


def _rows(carried: Carried, noise: Noise, effects: Sequence[Effect], reduced: bool = True) -> tuple[list[Floats], int]:
    """Rows [H | G | z] of the model carried and of ``effects``, and how many columns come before G."""
    added = candidate_columns(carried.dwells, effects, carried.model.bench, carried.state)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(carried.columns, added, strict=True)]
    return information.judged(carried.dwells, columns, noise, carried.state, carried.model.count, reduced)


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
