"""The rows of the readings within dwells, of which noise from dwell to dwell takes nothing: the same in every noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Indices, Mask
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.whitened_rows import log_of_errors, whiten
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.terms import RandomWalk, Scatter, SettingError

_IMMENSE_MPS2 = 1e3  # scatter so large that nothing is left of a dwell's mean
_TALL = 2  # times as many rows as columns are kept before they are reduced
_CHANGES = 1e-3  # share of a column's largest value by which it changes within a dwell
_UNSEEN = 0.01  # chi-squared within dwells of a coefficient as large as the means allow, below which it has no rows
_ANY_SIZE = np.geomspace(0.1, 1e5, 61)  # of what disturbs a dwell, in units of the noise


@dataclass(frozen=True)
class Courses:
    """What the model leaves of the courses of the readings within dwells: squares (D,) in units of the noise, and their
    degrees of freedom (D,). along, made (D,): products of the courses that effects make with what is left, and with
    themselves."""

    squares: Floats
    freedom: Floats
    along: Floats
    made: Floats

    def log_bayes(self, prior: float) -> Floats:
        """Log Bayes factors (D,) of whatever changes the courses of some dwells alone, each with a prior probability
        and averaged over its size; zeros where it is likelier that all change alike: as much, or as the effects have
        it, in each dwell by another share.

        Of a size s, in units of the noise, with n degrees of freedom (1 + s^2)^(-n/2) exp(chi^2 s^2 / (2 (1 + s^2))).
        """
        own = np.logaddexp.reduce(self._by_size, axis=1) - math.log(len(_ANY_SIZE))
        return own if np.logaddexp(0.0, math.log(prior) + own).sum() > self.log_bayes_alike else np.zeros(len(own))

    @cached_property
    def log_bayes_alike(self) -> float:
        """Log Bayes factor of whatever changes the courses of all dwells, averaged over its size."""
        alike = self._by_size
        if self.made.any():
            by_share = log_bayes_by_size(self.along**2, self.made, 1.0, _ANY_SIZE**2 / self.made.max())
            alike = np.concatenate([alike, by_share], axis=1)
        return float(np.logaddexp.reduce(alike.sum(axis=0))) - math.log(alike.shape[1])

    @cached_property
    def _by_size(self) -> Floats:
        """Log Bayes factors (D, sizes) of whatever changes the course of each dwell."""
        return log_bayes_by_size(self.squares, np.ones(len(self.squares)), self.freedom, _ANY_SIZE**2)


def log_bayes_by_size(along_squared: Floats, made: Floats, freedom: Floats | float, squares: Floats) -> Floats:
    """Log Bayes factors (n, sizes) of n coefficients, each of one column g with the square made = g g, and along = g z,
    for squares (sizes,) of their sizes; freedom: number of such columns of which along_squared is the sum."""
    spread = squares * made[:, None]
    gained = squares * along_squared[:, None] / (1.0 + spread)
    return np.asarray(0.5 * (gained - np.reshape(freedom, (-1, 1)) * np.log1p(spread)), float)


class WithinRows:
    """The rows within dwells, gathered a few dwells at a time.

    noise: what was stated. linearised: the dwells with the columns of the model, of which the first ``known`` have a
    flat prior. about (p + made,): the state of the model, and coefficients of the columns of effects. explained: by how
    much these lower chi-squared of the means at most. shared: what noise that dwells share is taken to be, zeros if
    nothing is given.
    """

    def __init__(
        self, noise: Noise, linearised: LinearisedDwells, known: int, about: Floats, explained: float = math.inf,
        shared: Floats | None = None,
    ) -> None:  # fmt: skip
        self._model, self._state, self._known = linearised.model, linearised.state, known
        self._made = len(about) - self._model.count
        judging = noise.with_scatter_as_flicker(len(linearised.dwells)).without(RandomWalk)
        self._shared = judging.columns("run", linearised.dwells_at_state, linearised.state)
        without_means = judging if noise.attitude_unknown else judging.without(SettingError)
        self._noise = without_means.with_terms(Scatter(np.full(3, _IMMENSE_MPS2)))
        self._channels = 1 if noise.attitude_unknown else 3
        self._about = np.append(about, np.zeros(self._shared.shape[3]) if shared is None else shared)
        self._of_effects = np.concatenate([np.zeros(known), about[known:], np.zeros(self._shared.shape[3])])
        self._largest, self._unseen = np.zeros(len(self._about)), np.zeros(len(self._about) + 1)
        self._share = _UNSEEN / explained
        self._gathered = list[tuple[Floats, Indices]]()
        self._courses = list[Floats]()
        self.log = 0.0
        """Log of the density of the readings within dwells, but for chi-squared."""

    @property
    def courses(self) -> Courses:
        """What the model leaves of the course of each dwell."""
        return Courses(*np.concatenate(self._courses, axis=1))

    def add(self, dwells: DwellTable, of_model: Floats, of_effects: Floats, pieces: slice,
            of_means: Floats | float = 0.0) -> None:  # fmt: skip
        """Add a few dwells with their columns (P, K, 3, p) of the model and (P, K, 3, made) of effects; pieces: which
        of the run they have. Columns that do not change within dwells have no rows.

        of_means: squares of the terms' columns in the means so far. What the means tell of a coefficient bounds it, and
        where it then is not seen within dwells its column has no rows either.
        """
        if not self._noise.within_seen:
            self._courses.append(np.zeros((4, len(dwells))))
            return
        parts = [of_model, of_effects, self._shared[pieces]]
        nodes, moved = min(part.shape[1] for part in parts), list[Mask]()
        parts = [np.broadcast_to(p[:, :nodes], (len(p), nodes, *p.shape[2:])) for p in parts]
        for values in parts:  # one after another, because together they are many
            largest = self._largest[sum(map(len, moved)) :][: values.shape[3]]
            largest[:] = np.maximum(largest, np.maximum(values.max(axis=(0, 1, 2)), -values.min(axis=(0, 1, 2))))
            moved.append(_changing(values, dwells.folded.ends, largest))
        moved[0][:] = True
        both = [values[..., moves] for values, moves in zip(parts, moved, strict=True)]
        columns, moving = OfPieces(np.concatenate(both, axis=3), dwells.folded.ends), np.concatenate(moved)
        self.log += log_of_errors(dwells, self._noise, self._state)
        of_dwells = whiten(dwells, columns, self._noise, self._state, self._about[moving], reduced=False)
        freedom = self._channels * (dwells.folded.width * dwells.folded.piece_numbers - 1.0)
        made = self._of_effects[moving]
        pairs = [(rows[:, -1], rows[:, -1 - len(made) : -1] @ made) for rows in of_dwells]
        products = np.array([(left @ left, left @ course, course @ course) for left, course in pairs]).T
        self._courses.append(np.stack([products[0], np.asarray(freedom, float), *products[1:]]))
        self._unseen[self._known : self._model.count + self._made] = self._share * of_means
        self._gathered.append(self._reduced(np.concatenate(of_dwells), np.append(np.flatnonzero(moving), len(moving))))
        if sum(len(rows) for rows, _ in self._gathered) > _TALL * max(rows.shape[1] for rows, _ in self._gathered):
            self._gathered = [self._merged()]

    def rows(self) -> tuple[Floats, Floats, Floats]:
        """Rows of the model (r, known and shared), of the terms (r, the other states and made) and readings (r,)."""
        count, last = self._model.count, self._model.count + self._made
        width = self._known + self._shared.shape[3]
        if not self._gathered:
            return np.zeros((0, width)), np.zeros((0, count - self._known + self._made)), np.zeros(0)
        stacked, moving = self._merged()
        full = np.zeros((len(stacked), last + self._shared.shape[3] + 1))
        full[:, moving] = stacked
        of_model = np.zeros((len(full), width))
        # the twelve have none, but for noise of the angles
        of_model[:, STATE_COUNT : self._known] = full[:, STATE_COUNT : self._known]
        of_model[:, self._known :] = full[:, last:-1]
        readings = full[:, -1] + full[:, self._known : count] @ self._about[self._known : count]
        return of_model, full[:, self._known : last], readings

    def _merged(self) -> tuple[Floats, Indices]:
        """Return the rows gathered so far with the columns of all of them."""
        if len(self._gathered) == 1:
            return self._gathered[0]
        moving = np.unique(np.concatenate([columns for _, columns in self._gathered]))
        stacked, first = np.zeros((sum(len(rows) for rows, _ in self._gathered), len(moving))), 0
        for rows, columns in self._gathered:
            stacked[first : first + len(rows), np.searchsorted(moving, columns)] = rows
            first += len(rows)
        return self._reduced(stacked, moving)

    def _reduced(self, rows: Floats, columns: Indices) -> tuple[Floats, Indices]:
        """Return rows (m, n) of the columns that are seen within dwells, no more than there are columns, with the same
        products."""
        seen = np.einsum("rc,rc->c", rows, rows) > self._unseen[columns]
        rows = rows[:, seen]
        return (triangle(rows) if len(rows) > rows.shape[1] else rows), columns[seen]


def _changing(values: Floats, ends: Indices, largest: Floats) -> Mask:
    """Tell of each column (P, K, 3, C) whether it changes within dwells by more than noise of the angles makes."""
    starts = ends[:-1]
    highest = np.maximum.reduceat(values.max(axis=1), starts, axis=0)
    lowest = np.minimum.reduceat(values.min(axis=1), starts, axis=0)
    return np.asarray((highest - lowest).max(axis=(0, 1)) > _CHANGES * np.maximum(largest, 1e-300), bool)
