"""Candidates for a model, projected off it: what each explains of its residual."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.effects import Effect
from kf_calib.estimation import square_root_information

SEEN = 1e-6
"""A candidate is invisible if the model leaves less than this share of its columns."""


@dataclass(frozen=True, repr=False)
class Candidate:
    """One candidate effect, with any unknown constant at one value, after projection off the model.

    - effect: the candidate.
    - columns (d, q): the projected columns, per unit of each coefficient.
    - basis (d, k): an orthonormal basis of the span of ``columns``; k is the degrees of freedom of the test.
    - directions (d, q): the vectors in that span that are nearest to the columns; they do not depend on the choice of
      ``basis``.
    - inverse (q, k): maps a residual r to coefficients, ``inverse @ basis.T @ r``.
    - hidden (q,): True for each coefficient that the run does not determine.
    - visibility: the largest share of a column's norm that the projection leaves, 0 to 1.
    - tried: the number of values of the unknown constant of which this is the best; each counts as a separate test.
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
        """Degrees of freedom of the test: the rank of the projected columns."""
        return self.basis.shape[1]

    @cached_property
    def sigma(self) -> Floats:
        """Sigmas (q,) of the coefficients if only this effect is added; infinite where a coefficient is not
        determined."""
        return np.where(self.hidden, np.inf, np.linalg.norm(self.inverse, axis=1))

    @property
    def scales(self) -> Floats:
        """Sizes (q,) of the coefficients that a user would call large, in SI."""
        return np.array([each.scale for each in self.effect.coefficients])

    def overlap(self, other: Candidate) -> float:
        """Cosine of the smallest principal angle between the two spans; 1 if they share a direction, so that the run
        cannot tell some combination of the one from one of the other."""
        if not (self.dof and other.dof):
            return 0.0
        return float(np.linalg.svd(self.basis.T @ other.basis, compute_uv=False)[0])


@dataclass(frozen=True, repr=False)
class Scan:
    """The candidates and the whitened residual (d,) of the model, in a common orthonormal basis of d dimensions."""

    candidates: tuple[Candidate, ...]
    residual: Floats

    @cached_property
    def statistics(self) -> Floats:
        """Score statistics (n,): the decrease of chi-squared if each candidate alone is added, |basis^T r|^2.

        Each is chi-squared distributed with the candidate's degrees of freedom if the model is complete.
        """
        return np.array([np.sum((each.basis.T @ self.residual) ** 2) for each in self.candidates])

    def beside(self, k: int) -> Floats:
        """Decrease of chi-squared (n,) if each candidate is added beside candidate ``k``; zero for ``k`` itself."""
        basis, deltas = self.candidates[k].basis, np.zeros(len(self.candidates))
        rest = self.residual - basis @ (basis.T @ self.residual)
        for places, bases in self._stacked:
            left = bases - basis @ (basis.T @ bases)
            along, gram = rest @ left, np.swapaxes(left, 1, 2) @ left
            values, vectors = np.linalg.eigh(gram)  # squared cosines, of which those near zero are seen no more
            turned = np.einsum("ni,nij->nj", along, vectors)
            deltas[places] = np.sum(np.where(values > SEEN, turned**2 / np.maximum(values, SEEN), 0.0), axis=1)
        return deltas

    @cached_property
    def _stacked(self) -> list[tuple[list[int], Floats]]:
        """Numbers of the candidates of equal degrees of freedom, and their bases (n, d, k)."""
        found = dict[int, list[int]]()
        for k, each in enumerate(self.candidates):
            found.setdefault(each.dof, []).append(k)
        return [(own, np.array([self.candidates[k].basis for k in own])) for dof, own in found.items() if dof]

    def coefficients(self, candidate: Candidate) -> Floats:
        """Estimated coefficients (q,) of a candidate if only this effect is added."""
        return candidate.inverse @ (candidate.basis.T @ self.residual)


def counts_of(effects: Sequence[Effect]) -> list[int]:
    """Return the number of columns of each effect."""
    return [len(effect.coefficients) for effect in effects]


def slices(counts: Sequence[int]) -> list[slice]:
    """Return the slice of columns that belongs to each effect, for effects of so many columns."""
    return [slice(a, b) for a, b in itertools.pairwise(itertools.accumulate(counts, initial=0))]


def project(upper: Floats, width: int, effects: Sequence[Effect], counts: Sequence[int]) -> Scan:
    """Make the scan from a triangular factor [H | G | z].

    - upper: the factor.
    - width: number of columns H of the model.
    - effects: the candidates; counts: number of columns of each in G.
    """
    sizes, rest = np.linalg.norm(upper[:, width:-1], axis=0), Complement(upper, width).of(upper[:, width:])
    units = np.where(sizes > 0, sizes, 1.0)
    columns, residual = rest[:-1, :-1] / units, rest[:-1, -1]
    candidates = list[Candidate]()
    for effect, part, factors in zip(effects, slices(counts), _factors(columns, counts), strict=True):
        candidates.append(_candidate(effect, columns[:, part], units[part], *factors))
    return Scan(tuple(candidates), residual)


def _factors(columns: Floats, counts: Sequence[int]) -> list[tuple[Floats, Floats, Floats]]:
    """Return the singular value decomposition of the columns of each effect, those of as many columns in one call."""
    parts, factors_of_each = slices(counts), [(columns, columns, columns)] * len(counts)
    for count in dict.fromkeys(counts):
        places = [k for k, own in enumerate(counts) if own == count]
        stacked = np.array([columns[:, parts[k]] for k in places])
        for k, *factors in zip(places, *np.linalg.svd(stacked, full_matrices=False), strict=True):
            factors_of_each[k] = factors[0], factors[1], factors[2]
    return factors_of_each


def _candidate(
    effect: Effect, columns: Floats, units: Floats, left: Floats, singular: Floats, right: Floats
) -> Candidate:
    """Make a candidate from its projected ``columns`` (d, q), each divided by its norm before the projection, ``units``
    (q,), and the singular value decomposition of these."""
    seen = singular > SEEN
    lost = np.eye(len(units)) - right[seen].T @ right[seen]
    inverse = (right[seen].T / singular[seen]) / units[:, None]
    hidden, basis = np.asarray(np.diag(lost) > 1e-6), left[:, seen]
    return Candidate(
        effect, columns * units, basis, basis @ right[seen], inverse, hidden, float(singular.max(initial=0.0))
    )


class Complement:
    """The orthogonal complement of a model's columns H, the first ``width`` of whitened rows [H | ...] (m, c)."""

    def __init__(self, rows: Floats, width: int) -> None:
        scaled = square_root_information.scale_columns(rows[:, : width + 1])[0]
        left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
        self._explained = left[:, singular > 1e-9]

    def of(self, columns: Floats) -> Floats:
        """Columns (m, ...) projected off H."""
        for _ in range(2):  # projecting twice removes the rounding errors that large components leave in the remainder
            columns = columns - self._explained @ (self._explained.T @ columns)
        return columns
