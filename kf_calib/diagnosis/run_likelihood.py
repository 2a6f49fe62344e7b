"""One likelihood of a run for all explanations: what each adds are columns with a prior of their size.

The means of the dwells z (3 D,) of a model with the columns H are N(H x + G c, V): x has a prior as wide as any sensor
needs, the coefficients c of a term N(m, s^2), and V is the noise that was stated, with scatter s_s and setting errors
s_a of unknown size where nothing was stated of them. The readings within dwells add rows that noise from dwell to dwell
does not enter. With the rows whitened by V and projected off H, and w the eigenvalues of G^T G and t the projections of
z on its eigenvectors,

  log B(s) = -1/2 sum log(1 + s^2 w) + 1/2 sum s^2 t^2 / (1 + s^2 w)

is the Bayes factor of a term of size s. It is averaged over the sizes that are usual, or over all of them; and with the
restricted likelihood of the noise over its sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import AT_ONCE, Floats, Indices, Singles, portions
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.diagnosis.in_noises import ROUNDING, InNoises, Spanned
from kf_calib.diagnosis.within_rows import Courses, WithinRows
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.qr import spanned
from kf_calib.effects import Effect
from kf_calib.estimation.candidate_scan import SEEN
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns, few_at_a_time, stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Prior
from kf_calib.noise.means import means_of
from kf_calib.noise.noise_model import Noise, lift_rounding, mean_covariances
from kf_calib.noise.reml import FREE, Part, with_shared_noise

_FINE = 8  # parts of a step over which the likelihood is integrated
_FAR = 300.0  # in log likelihood, below the largest: a polynomial through values that differ by more swings out
_LEAST = 0.1  # sigma of a mean: noise that is smaller shows nothing
_ALONG = 1e-8  # variance along the force by errors across it: a turn by 2e-4 rad; less is lost in sums of the squares
_ROUNDING = 1e-13  # of columns of a length of one: their prior may be as small beside what is known best
_FACTORS = 8  # of which a product is a double, whatever the sizes
_MANY = 8  # columns of an accelerometer, from which on it is worth looking whether those of the others are apart

_ANY = Prior(misalignment_rad=math.pi, scale=10.0, bias_mps2=100.0)
_EXACT = 0.01  # to which log likelihoods are known
_NONE, _NO_PLACES = np.zeros(0), np.zeros(0, np.intp)

Combination = tuple[slice, Floats | None]
"""Columns, and the matrix by which they are combined; None: as they are."""


@dataclass(frozen=True)
class Sizes:
    """Sizes (m,) of a term's coefficients about their mean ``centre``, and the logs (m,) of their probabilities."""

    values: Floats
    logs: Floats
    centre: float = 0.0


@dataclass(frozen=True)
class Projected:
    """Some columns in one noise, projected off the model: their places (C,) among all, rows (r, C) of them, readings
    (r,); log: of the restricted likelihood without any term."""

    places: Indices
    columns: Floats
    readings: Floats
    log: float

    def of(self, places: Indices) -> Floats:
        """The rows (r, q) of a few of them."""
        return self.columns[:, np.searchsorted(self.places, places)]


class RunLikelihood:
    """The likelihood of one run, linearised where its fit is.

    linearised: the dwells with the columns of the model. noise: what was stated. least_mps2: scatter that there is in
    any case, by which rounding does not decide. effects: terms that may be missing, of which the columns are made.
    known: number of states of the model that have a flat prior; further ones are terms, whose columns come first.
    blocks: combinations of the columns, one after another, that take their place.

    The rows are whitened by what was stated. Of the model an orthonormal basis of what it spans is kept, and all else
    is projected off it.
    """

    def __init__(
        self,
        linearised: LinearisedDwells,
        noise: Noise,
        least_mps2: float,
        effects: Sequence[Effect] = (),
        known: int | None = None,
        blocks: Sequence[Combination] = (),
    ) -> None:
        self.linearised, self.noise = linearised, noise
        model = linearised.model
        known = self._known = model.count if known is None else known
        means, prior = with_shared_noise(linearised.dwells, noise, linearised.means, linearised.state)
        covariances = mean_covariances(noise, means, linearised.state) + least_mps2**2 * np.eye(3)
        self.means, self._root = means, np.linalg.inv(np.linalg.cholesky(lift_rounding(covariances)))
        design = np.concatenate([means.design[..., :known], means.design[..., model.count :]], axis=2)
        readings = means.readings - means.design[..., :known] @ linearised.state[:known]
        of_shared = np.concatenate([prior[:, :known], prior[:, model.count : -1]], axis=1)
        of_prior = np.concatenate([of_shared, _prior_of_twelve(model, of_shared.shape[1])])
        self._states = design.shape[2]
        z = (self._root @ readings[..., None])[..., 0]
        whitened = self._root @ design
        columns, within = self._made(effects, known, blocks, z, spanned(whitened.reshape(z.size, -1).copy())[0])
        self._courses, (of_model, more, more_z) = within.courses, within.rows()
        combined = np.zeros((len(of_prior) + len(more), columns.shape[2]))
        _combine(more, blocks, combined[len(of_prior) :])
        self.lengths = np.sqrt(_squares(columns) + np.einsum("rc,rc->c", combined, combined))
        more_z, of_model = np.append(np.zeros(len(of_prior)), more_z), np.concatenate([of_prior, of_model])
        self.spanned, self._to_states, self._along, self._onto = _off(whitened, columns, z, of_model, combined, more_z)
        log_root = float(np.log(np.abs(np.einsum("dii->di", self._root))).sum())
        self.spanned = replace(self.spanned, log=self.spanned.log + log_root + within.log)

    @property
    def rows(self) -> int:
        """Number of rows of means."""
        return self.spanned.readings.size

    def _made(
        self, effects: Sequence[Effect], known: int, blocks: Sequence[Combination], z: Floats, basis: Floats
    ) -> tuple[Floats | Singles, WithinRows]:
        """Return the columns (D, 3, C) of all terms in the means, and rows within dwells, made for a few dwells at a
        time: their values at all nodes take ten times the memory. z (D, 3): what the model leaves of the means; basis
        (3 D, r): what it spans."""
        linearised, dwells = self.linearised, self.linearised.dwells_at_state
        model, state = linearised.model, linearised.state
        stimulus, values = stimulus_of(dwells, model.bench, state), of_all_pieces(linearised.columns)
        made = sum(len(effect.coefficients) for effect in effects)
        count = sum(map(_width, blocks)) if blocks else model.count - known + made
        shape = len(dwells), 3, count
        # the log of a Bayes factor errs by as much as rounding changes chi-squared
        is_rough = float(np.sum(z**2)) * np.finfo(np.float32).eps < _EXACT
        columns: Floats | Singles = np.empty(shape, np.float32) if is_rough else np.empty(shape)
        # chi-squared of the means beyond its expectation, and no less than noise makes of it
        explained = max(float(np.sum(z**2)) - z.size, 0.0) + 3.0 * math.sqrt(2.0 * z.size)
        within = WithinRows(self.noise, linearised, known, np.append(state, np.zeros(made)), explained)
        squares = np.zeros(model.count - known + made)
        along = np.zeros((basis.shape[1], len(squares)))
        for few, some, pieces, nodes in few_at_a_time(dwells, stimulus, made):
            added = candidate_columns(some, effects, model.bench, state, nodes)
            of_states = OfPieces(values[pieces, ..., known : model.count], some.folded.ends)
            of_terms = of_states.beside(added) if known < model.count else added
            design = self._root[few] @ means_of(some, of_terms).design
            _combine(design, blocks, columns[few])
            along += basis[3 * few.start : 3 * few.stop].T @ design.reshape(-1, design.shape[2])
            squares += np.einsum("dic,dic->c", design, design)
            within.add(some, values[pieces], added.values, pieces, np.maximum(squares - np.sum(along**2, axis=0), 0.0))
        return columns, within

    def states_beside(self, covariances: Floats | None, places: Indices, coefficients: Floats) -> Floats:
        """The known states of the model, and what noise is that dwells share (known + shared,), as they are likeliest
        beside coefficients (q,) of some columns, with further noise, (D, 3, 3) in units of that stated: the fit may not
        have come to its end, or be of other noise."""
        rows = self.spanned
        left = rows.readings - rows.columns[..., places] @ coefficients
        parts = [rows.basis, left[..., None]]
        if covariances is not None:
            parts = [np.linalg.solve(np.linalg.cholesky(lift_rounding(np.eye(3) + covariances)), p) for p in parts]
        more = [rows.more_basis, (rows.more_readings - rows.more_columns[:, places] @ coefficients)[:, None]]
        basis, z = (np.vstack([p.reshape(-1, p.shape[2]), m]) for p, m in zip(parts, more, strict=True))
        along = np.linalg.lstsq(basis, z[:, 0])[0] + self._along - self._onto[:, places] @ coefficients
        states = self._to_states @ along
        states[: self._known] += self.linearised.state[: self._known]
        return states

    @cached_property
    def courses(self) -> Courses:
        """What the model, and noise that dwells share, leave of the courses of the readings within dwells."""
        if self._states == self._known:
            return self._courses
        return self.courses_at(self.states_beside(None, _NO_PLACES, _NONE), self.linearised.state[self._known :])

    def courses_at(self, states: Floats, terms: Floats, effects: Sequence[Effect] = (), coefficients: Floats = _NONE
                   ) -> Courses:  # fmt: skip
        """What is left of the courses of the readings within dwells at some states, as ``states_beside`` has them, of
        terms of the model that have no flat prior, and with effects of some coefficients (C,) that are not in it."""
        linearised, dwells = self.linearised, self.linearised.dwells_at_state
        bench, values = linearised.model.bench, of_all_pieces(linearised.columns)
        about, at = np.concatenate([states[: self._known], terms, [1.0]]), linearised.state
        within = WithinRows(self.noise, linearised, self._known, about, shared=states[self._known :])
        for _, some, pieces, nodes in few_at_a_time(dwells, stimulus_of(dwells, bench, at), len(coefficients)):
            added = candidate_columns(some, effects, bench, at, nodes).values @ coefficients
            within.add(some, values[pieces], added[..., None], pieces)
        return within.courses

    @property
    def lengths_left(self) -> Floats:
        """Lengths (C,) of the columns of the terms off the model."""
        columns, more = self.spanned.columns, self.spanned.more_columns
        return np.sqrt(_squares(columns) + np.einsum("rc,rc->c", more, more))

    def rescale(self, scales: Floats) -> None:
        """Multiply the columns of the terms by these (C,)."""
        for columns in (self.spanned.columns, self.spanned.more_columns):
            columns *= scales
        self._onto *= scales
        self.lengths, self.scales = self.lengths * scales, scales

    def columns(self, places: Indices) -> Floats:
        """Some columns (r, q) of the terms in the noise that was stated, off the model, in all rows."""
        parts = self.spanned.columns[..., places].reshape(-1, len(places)), self.spanned.more_columns[:, places]
        return np.concatenate(parts, dtype=np.float64)

    def in_noises(self, shapes: Floats, squares: Floats, groups: Sequence[Indices] = ()) -> InNoises:
        """The products of the columns of groups (n, q) in noise of some sizes; shapes (D, 3, 3): of unit size."""
        return InNoises(self.spanned if groups else self._bare, shapes, squares, groups)

    @cached_property
    def _bare(self) -> Spanned:
        """The rows without columns of terms."""
        spanned = self.spanned
        return replace(spanned, columns=spanned.columns[..., :0], more_columns=spanned.more_columns[:, :0])

    def projected(self, covariances: Floats | None, places: Indices, flat: Sequence[int] = ()) -> Projected:
        """Some columns with further noise, (D, 3, 3) in units of that stated, projected off the model, and off the
        columns ``flat`` of the terms."""
        places, rows = np.unique([*places, *flat]), self.spanned
        parts = [rows.basis, rows.columns[..., places].astype(np.float64), rows.readings[..., None]]
        log = rows.log
        if covariances is not None:
            lower = np.linalg.cholesky(lift_rounding(np.eye(3) + covariances))
            parts = [np.linalg.inv(lower) @ part for part in parts]
            log -= float(np.log(np.einsum("dii->di", lower)).sum())
        more = [rows.more_basis, rows.more_columns[:, places], rows.more_readings[:, None]]
        model, columns, z = (np.vstack([p.reshape(-1, p.shape[2]), m]) for p, m in zip(parts, more, strict=True))
        basis, upper = np.linalg.qr(model)
        log -= float(np.log(np.abs(np.diag(upper))).sum())
        columns, z = columns - basis @ (basis.T @ columns), z - basis @ (basis.T @ z)
        if len(flat):
            left = spanned(columns[:, np.searchsorted(places, flat)], SEEN)[0]
            columns, z = columns - left @ (left.T @ columns), z - left @ (left.T @ z)
        return Projected(places, columns, z[:, 0], log - 0.5 * float(z[:, 0] @ z[:, 0]))

    def sizes_of_noise(self) -> Floats:
        """Sizes (k,) of noise that are tried, in units of ``shapes_of``: from one that shows nothing to all of the
        misfit."""
        most = math.sqrt(self.misfit / max(self.rows - self._states, 1))
        step = self.step
        return _LEAST * np.exp(step * np.arange(int(math.log(max(3.0 * most, 30.0) / _LEAST) / step) + 4))

    @cached_property
    def misfit(self) -> float:
        """Chi-squared of the means without any term, in the noise that was stated."""
        return float(np.sum(self.spanned.readings**2) + np.sum(self.spanned.more_readings**2))

    @property
    def step(self) -> float:
        """Step of the logarithm of a size of noise: cubic interpolation of the likelihood of n rows, whose derivatives
        are about n, errs by n step^4 / 100 or so."""
        return min((10.0 / self.rows) ** 0.25, 0.6)

    def shapes_of(self, kind: Part) -> Floats:
        """Covariances (D, 3, 3) of scatter ("common"; "first" ... of one accelerometer) or of a setting error, of unit
        size where it equals the noise that was stated in its mean."""
        covariances = FREE[kind].shapes(self.means, self.linearised.state).sum(axis=0)
        return of_unit_size(self._root @ covariances @ np.swapaxes(self._root, 1, 2))

    def turned_by(self, effect: Effect) -> Floats | None:
        """The change (D, 3) of the means, whitened, by a unit coefficient of an effect; None where it changes none."""
        linearised, dwells = self.linearised, self.linearised.dwells_at_state
        added = candidate_columns(dwells, [effect], linearised.model.bench, linearised.state)
        made = means_of(dwells, added).design
        if not np.abs(made).max() > SEEN * linearised.model.bench.gravity_mps2:
            return None
        return (self._root @ made)[..., 0]


def _squares(columns: Floats | Singles) -> Floats:
    """Return the squares (C,) of columns (D, 3, C)."""
    return np.asarray(np.einsum("dic,dic->c", columns, columns, dtype=np.float64))


def of_unit_size(shapes: Floats) -> Floats:
    """Return covariances (D, 3, 3) scaled to the noise that was stated; by rounding none is negative."""
    values, vectors = np.linalg.eigh(shapes)
    shapes = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return shapes / max(float(np.einsum("dii->di", shapes).max(axis=1).mean()), 1e-300) + _ALONG * np.eye(3)


def _width(block: Combination) -> int:
    """Return the number of columns of a combination of columns."""
    part, matrix = block
    return part.stop - part.start if matrix is None else int(matrix.shape[1])


def _combine(columns: Floats, blocks: Sequence[Combination], combined: Floats | Singles) -> None:
    """Write combinations of columns (..., C) one behind the other; without any, the columns themselves."""
    if not blocks:
        combined[:] = columns
    first = 0
    for part, matrix in blocks:
        some = columns[..., part] if matrix is None else columns[..., part] @ matrix
        combined[..., first : first + some.shape[-1]] = some
        first += some.shape[-1]


def _prior_of_twelve(model: Model, states: int) -> Floats:
    """Return rows (12, P) of a prior of the twelve parameters about where they are, within which is any sensor.

    Without it a direction that the orientations do not show takes a degree of freedom as soon as the fit of an effect
    is off nominal by so little that its columns are no longer zero.
    """
    rows = np.zeros((STATE_COUNT, states))
    covariance = _ANY.covariance(paper_parameters.nominal(model.bench.nominal))
    rows[:, :STATE_COUNT] = np.linalg.inv(np.linalg.cholesky(covariance))
    return rows


def _off(
    model: Floats, columns: Floats | Singles, z: Floats, more_model: Floats, more_columns: Floats, more_z: Floats
) -> tuple[Spanned, Floats, Floats, Floats]:
    """Return what a model (D, 3, P) spans, with columns (D, 3, C) and readings (D, 3) off it; the matrix (P, k) from
    what it spans to its states, and what is along it of the readings (k,) and of the columns (k, C), which are
    overwritten."""
    whole = np.concatenate([model.reshape(-1, model.shape[2]), more_model])
    basis, to_states, log_volume = spanned(whole, _ROUNDING)
    of_means, more = basis[: z.size].reshape(*z.shape, -1), basis[z.size :]
    onto = more.T @ more_columns
    for few in portions(len(columns), AT_ONCE // 8):
        onto += np.tensordot(of_means[few], columns[few], axes=((0, 1), (0, 1)))
    for k in range(len(columns)):
        columns[k] -= of_means[k] @ onto
    for few in portions(len(more), AT_ONCE // 8):
        more_columns[few] -= more[few] @ onto
    along = basis.T @ np.append(z.ravel(), more_z)
    # columns with a prior of their own, as those of a thermometer's error, are integrated out: their number is no gain
    off = Spanned(of_means, columns, z - of_means @ along, more, more_columns, more_z - more @ along, -log_volume)
    return off, to_states, along, onto


def _eigen(gram: Floats, lengths: Floats | None, rounding: Floats | float) -> tuple[Floats, Floats, Floats]:
    """Return the roots (..., n) of the largest squares of columns, and the eigenvalues (..., n, q) and vectors
    (..., n, q, q) of gram (..., n, q, q) in units of these squares; arguments as of ``log_bayes``."""
    largest = np.einsum("...qq->...q", gram).max(axis=-1) if lengths is None else lengths
    scales = np.sqrt(np.maximum(largest, 1e-300))
    scaled = gram / scales[..., None, None] ** 2
    values, vectors = _eigh(scaled) if gram.shape[-1] > 1 else (scaled[..., 0], np.ones_like(scaled))
    return scales, np.where(values > np.expand_dims(rounding, -1), values, 0.0), vectors


def _eigh(gram: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues (..., q) and vectors (..., q, q); of many columns that follow each other by accelerometer, as
    of walks, of each alone where noise does not mix them, which takes a ninth of the time."""
    third, left = divmod(gram.shape[-1], 3)
    if left or third < _MANY:
        return np.linalg.eigh(gram)
    apart = np.moveaxis(gram.reshape(*gram.shape[:-2], 3, third, 3, third), -2, -3)  # (..., 3, 3, k, k)
    if np.abs(apart[..., ~np.eye(3, dtype=bool), :, :]).max() > ROUNDING:
        return np.linalg.eigh(gram)
    values, own = np.linalg.eigh(np.stack([apart[..., i, i, :, :] for i in range(3)], axis=-3))
    vectors = np.zeros((*gram.shape[:-2], 3, third, 3, third))
    for i in range(3):
        vectors[..., i, :, i, :] = own[..., i, :, :]
    return values.reshape(*gram.shape[:-1]), vectors.reshape(gram.shape)


def log_bayes(gram: Floats, along: Floats, squares: Floats, log_weights: Floats, centres: Floats,
              lengths: Floats | None = None, rounding: Floats | float = ROUNDING) -> Floats:  # fmt: skip
    """Log Bayes factors (..., n) of n terms of q columns, in several noises or one: gram (..., n, q, q) and along
    (..., n, q) = G^T z, each averaged over its sizes, of which the squares (..., n, m), the logs (n, m) of their
    probabilities and the centres (n,) are given.

    lengths: the largest squares (..., n) of columns before others were subtracted from them; None: those of gram.
    rounding (..., 1): share of these that is rounding.
    """
    scales, values, vectors = _eigen(gram, lengths, rounding)
    shifted, shift = along, 0.0
    if centres.any():
        shifted = along - gram.sum(axis=-1) * centres[:, None]
        shift = along.sum(axis=-1) * centres - 0.5 * gram.sum(axis=(-2, -1)) * centres**2
    turned = ((shifted / scales[..., None])[..., None, :] @ vectors)[..., 0, :] ** 2 * (values > 0.0)
    squares = squares * scales[..., None] ** 2
    gained, log_volume = np.zeros_like(squares), np.zeros_like(squares)
    for first in range(0, values.shape[-1], _FACTORS):
        volume = np.ones_like(squares)
        for k in range(first, min(first + _FACTORS, values.shape[-1])):
            spread = 1.0 + squares * values[..., k, None]
            gained += turned[..., k, None] / spread
            volume *= spread
        log_volume += np.log(volume)
    return log_of_sum(log_weights + 0.5 * (squares * gained - log_volume)) + shift


def orthonormal_columns(gram: Floats, along: Floats, lengths: Floats, rounding: Floats
                        ) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """The orthonormal columns U that the columns G of terms are turned to: the squares (..., n, q) L of those of which
    they are a part, G = U L^(1/2) T^T, the matrices T L^(-1/2) (..., n, q, q), and U^T z (..., n, q); arguments as of
    ``log_bayes``."""
    scales, values, vectors = _eigen(gram, lengths, rounding)
    units = np.where(values > 0.0, 1.0 / np.sqrt(np.where(values > 0.0, values, 1.0)), 0.0) / scales[..., None]
    turns = vectors * units[..., None, :]
    return values * scales[..., None] ** 2, turns, (along[..., None, :] @ turns)[..., 0, :]


def log_bayes_beside(squared: Floats, turns: Floats, along: Floats, explained: Floats, readings: Floats,
                     squares: Floats, log_weights: Floats, rounding: Floats) -> Floats:  # fmt: skip
    """The same beside f columns of any size, of which B is an orthonormal basis: explained (K, n, q, f) = G^T B and
    readings (K, f) = B^T z; squared, turns and along are the terms' ``orthonormal_columns``.

    With V = I + s^2 G G^T, M = B^T V^-1 B = (I - B^T U U^T B) + B^T U (I + s^2 L)^-1 U^T B and h = B^T V^-1 z it is

      1/2 (z^T (I - V^-1) z + h^T M^-1 h - |B^T z|^2) - 1/2 log det V - 1/2 log det M,

    so that for each size there is a matrix of f rows only. What of B lies in U is known to the root of ``rounding``
    (K, 1).
    """
    common = np.swapaxes(turns, -1, -2) @ explained
    apart, axes = np.linalg.eigh(np.eye(common.shape[-1]) - np.swapaxes(common, -1, -2) @ common)
    common, readings = common @ axes, (readings[:, None, None] @ axes)[..., 0, :]
    left = 1.0 / (1.0 + squares[..., None] * squared[..., None, :])
    pairs = (common[..., None] * common[..., None, :]).reshape(*common.shape[:-1], common.shape[-1] ** 2)
    matrices = (left @ pairs).reshape(*left.shape[:-1], *axes.shape[-2:])
    matrices += (np.maximum(apart, np.sqrt(rounding)[..., None])[..., None] * np.eye(apart.shape[-1]))[..., None, :, :]
    of_rest = readings - (along[..., None, :] @ common)[..., 0, :]
    right = of_rest[..., None, :] + left @ (common * along[..., None])
    roots = np.linalg.cholesky(matrices)
    gained = np.sum(np.linalg.solve(roots, right[..., None])[..., 0] ** 2, axis=-1)
    gained += (np.sum(along**2, axis=-1) - np.sum(readings**2, axis=-1))[..., None]
    gained -= (left @ along[..., None] ** 2)[..., 0]
    log_volume = 2.0 * np.log(np.einsum("...ff->...f", roots)).sum(axis=-1) - np.log(left).sum(axis=-1)
    return log_of_sum(log_weights + 0.5 * (gained - log_volume))


def log_of_sum(logs: Floats) -> Floats:
    """Log (...) of the sum of exp(logs) over the last axis (..., m); numpy's ``logaddexp`` takes several times as
    long."""
    largest = logs.max(axis=-1, keepdims=True)
    return np.asarray(largest[..., 0] + np.log(np.exp(logs - largest).sum(axis=-1)), float)


def log_bayes_together(gram: Floats, along: Floats, widths: Sequence[int], sizes: Sequence[Sizes]) -> Floats:
    """Log Bayes factors (k,) of terms together, each averaged over its sizes: gram (k, q, q) and along (k, q) = G^T z
    of all their columns, of which each term has as many as widths say."""
    groups = np.repeat(np.arange(len(widths)), widths)
    centre = np.array([each.centre for each in sizes])[groups]
    shift = along @ centre - 0.5 * centre @ gram @ centre
    mesh = np.stack([each.ravel() for each in np.meshgrid(*(s.values for s in sizes), indexing="ij")], axis=1)
    logs = np.sum([each.ravel() for each in np.meshgrid(*(s.logs for s in sizes), indexing="ij")], axis=0)
    scaled = mesh[:, groups]
    right = scaled * (along - gram @ centre)[:, None]
    # the root of I + S G^T G S, with S G^T z below: its last row is the root of what is gained
    count = len(groups)
    spread = np.zeros((*right.shape[:2], count + 1, count + 1))
    spread[..., :count, :count] = np.eye(count) + scaled[:, :, None] * gram[:, None] * scaled[:, None]
    spread[..., count, :count] = right
    spread[..., count, count] = 1.0 + np.sum(right**2, axis=2)
    root = np.linalg.cholesky(spread)
    gained = 0.5 * np.sum(root[..., count, :count] ** 2, axis=2)
    terms = logs + gained - np.log(np.einsum("kmqq->kmq", root)[..., :count]).sum(axis=2)
    return np.logaddexp.reduce(terms, axis=1) + shift


def integrated(logs: Floats, step: float) -> Floats:
    """Log of the integral (n,) of exp(logs) over the logarithm of a size, from its values (n, k) at equal steps,
    between which it is cubic (Lagrange's polynomials through four neighbours), but where it would exceed both
    neighbours by more than a log likelihood of n rows does: n step^2 / 4 with a curvature of 2 n at most."""
    logs = np.maximum(logs, logs.max(axis=1, keepdims=True) - _FAR)
    count = logs.shape[1]
    at = np.arange((count - 1) * _FINE + 1) / _FINE
    first = np.clip(np.floor(at).astype(int) - 1, 0, count - 4)
    u = at - first
    weights = np.stack([
        -(u - 1) * (u - 2) * (u - 3) / 6, u * (u - 2) * (u - 3) / 2, -u * (u - 1) * (u - 3) / 2,
        u * (u - 1) * (u - 2) / 6,
    ])  # fmt: skip
    fine = sum(weights[k] * logs[:, first + k] for k in range(4))
    before = np.minimum(at.astype(int), count - 2)
    fine = np.minimum(fine, np.maximum(logs[:, before], logs[:, before + 1]) + 2.5 / step**2)
    return np.logaddexp.reduce(fine, axis=1) + math.log(step / _FINE)
