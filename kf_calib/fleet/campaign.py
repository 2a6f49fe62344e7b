"""Many runs as their reduced factors: who was measured where and when, and what each run tells of every effect.

Of each factor [H | G | z] only what is left of G and z beside H is used: the rows below those of the run's own
parameters. The factors are read anew for each question and summed, so that memory does not grow with their number.

The marginal likelihood of coefficients with a normal prior in a linear model with normal noise is exact. With A the
information of the coefficients, b their score (A x = b has the estimate x) and S the standard deviations of their
prior, the likelihood averaged over the prior, divided by that without the coefficients, is

    log L = 1/2 b' S (1 + S A S)^-1 S b - 1/2 log |1 + S A S|

A prior of a size that nobody knows is averaged over the sizes of a grid in equal steps of the logarithm.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.effects import Bearer, described
from kf_calib.errors import InputError
from kf_calib.fleet.run_factor import ReferenceUnit, RunFactor, column_name

_TOGETHER = 64  # runs whose matrices are computed at once
SEEN = 1e-6
"""Share of the largest information of a unit, or of a column's norm: what is less is rounding, not seen."""
_LARGE = 64.0  # sigmas of one run, up to which sizes are expected where the catalogue knows no usual ones

_TOLD = 3  # units that a message names

_Part = tuple[str, str, int, int, Floats, Floats]
"""Label, unit, bench, rank, information and score of a block."""

Factors = Iterable[RunFactor] | Callable[[], Iterable[RunFactor]]
"""Factors of runs, or a function that reads them anew each time, so that memory does not grow with their number."""


@dataclass(frozen=True)
class RunKey:
    """One run: its name, its unit, its bench and its date; ``rank`` counts all runs by date."""

    run: str
    unit: str
    bench: str
    date: str
    rank: int


@dataclass(frozen=True)
class Group:
    """An effect's columns in the common order; unit: of the coefficients in SI is 1 / ``sigma``.

    - name: of the effect. columns: their indices. symbols: of the coefficients.
    - sigma: what one run leaves uncertain of a coefficient beside its own parameters, SI; 0 where no run shows it.
    - largest: the largest size that is expected, in ``sigma``.
    - borne_by: what can have it.
    """

    name: str
    columns: slice
    symbols: tuple[str, ...]
    sigma: float
    largest: float
    borne_by: Bearer


@dataclass(frozen=True)
class Blocks:
    """What runs, or units with all their runs on a bench, tell of all coefficients, these in units of ``Group.sigma``.

    - labels: names of runs or units. units: names of their units.
    - bench (n,), rank (n,): number of the bench; rank by date of the first run.
    - info (n, q, q), score (n, q): information of the coefficients and the right side of the normal equations.
    """

    labels: Sequence[str]
    units: Sequence[str]
    bench: NDArray[np.intp]
    rank: NDArray[np.intp]
    info: Floats
    score: Floats


class Campaign:
    """Runs in the order of their dates, which can be read as often as needed.

    - factors: the factors, or a function that reads them anew each time.
    - reference: a unit whose scale factors are known.

    Raises InputError if there are no runs, or none of the reference unit.
    """

    def __init__(self, factors: Factors, reference: ReferenceUnit | None = None) -> None:
        held = factors if callable(factors) else tuple(factors)
        self._read = held if callable(held) else lambda: held
        self._reference = reference
        self.keys, symbols = _catalogue(self._read())
        if not self.keys:
            raise InputError("there are no runs to diagnose together: give at least two.")
        if not symbols:
            raise InputError("the runs have no columns of effects: runs that are diagnosed together need angles.")
        self._of_reference = sum(key.unit == reference.unit for key in self.keys) if reference else 0
        if reference and not self._of_reference:
            raise InputError(_not_measured(reference.unit, sorted({key.unit for key in self.keys})))
        self.benches = sorted({key.bench for key in self.keys})
        self._columns = [column_name(name, symbol) for name, own in symbols.items() for symbol in own]
        self._places = dict[tuple[str, ...], tuple[NDArray[np.intp], NDArray[np.intp]]]()
        self._units_si = np.ones(len(self._columns))
        self.groups = self._sized(symbols)
        for group in self.groups:
            self._units_si[group.columns] = group.sigma

    @cached_property
    def by_date(self) -> list[RunKey]:
        """The runs in the order of their dates."""
        return sorted(self.keys, key=lambda key: key.rank)

    @property
    def repeats(self) -> bool:
        """Whether a unit was measured more than once on a bench."""
        return len({(key.unit, key.bench) for key in self.keys}) < len(self.keys)

    def runs(self) -> Iterator[Blocks]:
        """Blocks of runs, in the order in which they are read."""
        return _stacked(
            (key.run, key.unit, self.benches.index(key.bench), key.rank, info, score)
            for key, info, score in self._run_information()
        )

    def units(self, repairs: Sequence[tuple[int, int]] = ()) -> Iterator[Blocks]:
        """Blocks of units, each the sum of its runs on one bench; repairs: bench and first rank after a repair, at
        which the runs of a unit are parted.

        Memory is small if the runs of a unit are read one after another.
        """
        return _stacked(self._unit_sums(repairs))

    def _unit_sums(self, repairs: Sequence[tuple[int, int]]) -> Iterator[_Part]:
        """Yield each unit when the last of its runs has been read."""
        begun = dict[Hashable, _Part]()
        runs_to_come = Counter(self._unit_key(key, repairs) for key in self.keys)
        for key, info, score in self._run_information():
            parted, rank = self._unit_key(key, repairs), key.rank
            if parted in begun:
                *_, first, known, along = begun[parted]
                rank, info, score = min(first, rank), known + info, along + score
            begun[parted] = key.unit, key.unit, self.benches.index(key.bench), rank, info, score
            runs_to_come[parted] -= 1
            if not runs_to_come[parted]:
                yield begun.pop(parted)

    def _unit_key(self, key: RunKey, repairs: Sequence[tuple[int, int]]) -> Hashable:
        bench = self.benches.index(key.bench)
        return key.unit, bench, sum(key.rank >= first for where, first in repairs if where == bench)

    def _run_information(self) -> Iterator[tuple[RunKey, Floats, Floats]]:
        """Yield information (q, q) and score (q,) of each run beside its own parameters."""
        for key, factor in zip(self.keys, self._read(), strict=True):
            upper = factor.factor
            if self._reference and key.unit == self._reference.unit:
                upper = self._reference.known(factor, self._of_reference)
            columns, places = self._effect_columns(factor)
            rows = upper[factor.width :, places] * self._units_si[columns]
            rows[:, _hidden(upper, factor.width, places)] = 0.0
            info, score = np.zeros((len(self._columns),) * 2), np.zeros(len(self._columns))
            info[np.ix_(columns, columns)] = rows.T @ rows
            score[columns] = rows.T @ upper[factor.width :, -1]
            yield key, info, score

    def _effect_columns(self, factor: RunFactor) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which of the common columns a run has, and where."""
        if factor.columns not in self._places:
            places = {name: k for name, k in factor.places.items() if k >= factor.width}
            columns = [k for k, name in enumerate(self._columns) if name in places]
            in_factor = [places[self._columns[k]] for k in columns]
            self._places[factor.columns] = np.array(columns, dtype=np.intp), np.array(in_factor, dtype=np.intp)
        return self._places[factor.columns]

    def _sized(self, symbols: Mapping[str, Sequence[str]]) -> list[Group]:
        """Return the effects with the sigma that one run leaves of their coefficients."""
        ends = np.cumsum([0, *map(len, symbols.values())]).tolist()
        parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
        total, runs = np.zeros(ends[-1]), np.zeros(ends[-1])
        for _, info, _ in self._run_information():
            information = np.diag(info)
            total, runs = total + information, runs + (information > 0.0)
        groups = list[Group]()
        for (name, of_effect), part in zip(symbols.items(), parts, strict=True):
            seen, effect = runs[part] > 0.0, described(name)
            sigma = float(np.mean(total[part][seen] / runs[part][seen])) ** -0.5 if seen.any() else 0.0
            grades = () if effect is None else (effect.typical.navigation, effect.typical.mems)
            usual = max((high for _, high in filter(None, grades)), default=0.0)
            largest = max(_LARGE, usual / sigma) if sigma else _LARGE
            borne_by = Bearer.EITHER if effect is None else effect.borne_by
            groups.append(Group(name, part, tuple(of_effect), sigma, largest, borne_by))
        return groups


def _catalogue(factors: Iterable[RunFactor]) -> tuple[list[RunKey], dict[str, list[str]]]:
    """Return the keys of all runs in the order of reading, and the symbols of all effects."""
    runs, symbols = list[tuple[str, str, str, str]](), dict[str, list[str]]()
    for factor in factors:
        runs.append((factor.run, factor.unit or factor.run, factor.bench or "", factor.date or ""))
        for column in factor.columns[factor.width :]:
            name, _, symbol = column.rpartition("/")
            of_effect = symbols.setdefault(name, [])
            of_effect += [symbol] if symbol not in of_effect else []
    order = sorted(range(len(runs)), key=lambda k: runs[k][3])
    ranks = {place: rank for rank, place in enumerate(order)}
    return [RunKey(*run, ranks[k]) for k, run in enumerate(runs)], symbols


def _hidden(upper: Floats, width: int, places: NDArray[np.intp]) -> Mask:
    """Return which columns the run's own parameters explain but for rounding."""
    rest, whole = np.linalg.norm(upper[width:, places], axis=0), np.linalg.norm(upper[:, places], axis=0)
    return np.asarray(rest <= SEEN * whole)


def _stacked(parts: Iterator[_Part]) -> Iterator[Blocks]:
    """Yield blocks of as many parts as are computed at once."""
    while some := list(itertools.islice(parts, _TOGETHER)):
        labels, units, *arrays = zip(*some, strict=True)
        yield Blocks(labels, units, *map(np.array, arrays))


def _not_measured(unit: str, units: Sequence[str]) -> str:
    more = f" and {len(units) - _TOLD} more" if len(units) > _TOLD else ""
    return (
        f"no run is of the reference unit {unit}, they are of {', '.join(units[:_TOLD])}{more}: name a unit that was "
        "measured, or say of which unit the runs are in a list (.csv with the columns run and unit)."
    )


STEP = 2.0
"""Ratio of a size to the one before."""
FLAT = 1e6
"""Sigmas of one run: the prior of a coefficient of which nothing is known."""


def sizes(low: float, high: float, step: float = STEP) -> Floats:
    """Sizes from low to high in equal steps of the logarithm, at most ``step`` times the one before."""
    return np.geomspace(low, high, max(math.ceil(math.log(high / low) / math.log(step)), 1) + 1)


def log_evidence(info: Floats, score: Floats, prior: Floats) -> Floats:
    """log L (...,) of information (..., q, q), score (..., q) and standard deviations of the prior (..., q)."""
    shape, count = np.broadcast_shapes(info.shape[:-2], score.shape[:-1], prior.shape[:-1]), score.shape[-1]
    info = np.broadcast_to(info, (*shape, count, count))
    score, prior = (np.broadcast_to(each, (*shape, count)) for each in (score, prior))
    if not count:
        return np.zeros(score.shape[:-1])
    lower = np.linalg.cholesky(_within(info, prior))
    along = np.linalg.solve(lower, (prior * score)[..., None])[..., 0]
    return 0.5 * np.sum(along**2, axis=-1) - np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)


def posterior(info: Floats, score: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Mean (q,) and covariance (q, q) of the coefficients, with the same arguments."""
    inverse = np.linalg.inv(_within(info, prior))
    covariance = prior[:, None] * (0.5 * (inverse + inverse.T)) * prior
    return covariance @ score, covariance


def modes(info: Floats, score: Floats) -> tuple[Floats, Floats, Floats]:
    """Eigenvalues (..., q), score (..., q) and rows (..., q, q) of the directions in which the information is apart."""
    values, vectors = np.linalg.eigh(info)
    turned = np.swapaxes(vectors, -1, -2)
    return np.maximum(values, 0.0), (turned @ score[..., None])[..., 0], turned


def log_evidence_of_modes(values: Floats, score: Floats, size: Floats | float) -> Floats:
    """log L (...,) of eigenvalues and score (..., q) along them, for one ``size`` of all coefficients."""
    gain = np.asarray(size, float)[..., None] ** 2
    return 0.5 * np.sum(score**2 * gain / (1.0 + gain * values) - np.log1p(gain * values), axis=-1)


def log_mean(logarithms: Floats, axis: int | tuple[int, ...] | None = None) -> Floats:
    """Logarithm of the mean of numbers that are given by their logarithms."""
    whole = np.logaddexp.reduce(logarithms, axis=axis)
    return whole - np.log(logarithms.size / whole.size)


def _within(info: Floats, prior: Floats) -> Floats:
    """Return 1 + S A S."""
    return np.eye(info.shape[-1]) + prior[..., :, None] * info * prior[..., None, :]
