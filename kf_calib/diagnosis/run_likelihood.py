"""One likelihood of a run for all explanations: what each adds are columns with a prior of their size.

The means of the dwells z (3 D,) of a model with the columns H are N(H x + G c, V): x has a flat prior, the coefficients
c of a term N(m, s^2), and V is the noise that was stated, with scatter s_s and setting errors s_a of unknown size where
nothing was stated of them. The readings within dwells add rows that noise from dwell to dwell does not enter. With the
rows whitened by V and projected off H, and w the eigenvalues of G^T G and t the projections of z on its eigenvectors,

  log B(s) = -1/2 sum log(1 + s^2 w) + 1/2 sum s^2 t^2 / (1 + s^2 w)

is the Bayes factor of a term of size s. It is averaged over the sizes that are usual, or over all of them; and with the
restricted likelihood of the noise over its sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Indices, Mask
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns
from kf_calib.estimation.whitened_rows import whiten
from kf_calib.noise.means import means_of
from kf_calib.noise.noise_model import Noise, lift_rounding, mean_covariances
from kf_calib.noise.reml import FREE, Part, with_shared_noise
from kf_calib.noise.terms import RandomWalk, Scatter, SettingError

_IMMENSE_MPS2 = 1e3  # scatter so large that nothing is left of a dwell's mean
_SEEN = 1e-7  # share of a column that the model must leave for it to be seen
_CHANGES = 1e-3  # share of a column's largest value by which it changes within a dwell
_FINE = 8  # parts of a step over which the likelihood is integrated
_LEAST = 0.1  # sigma of a mean: noise that is smaller shows nothing
_ANY_SIZE = np.geomspace(_LEAST, 1e5, 61)  # of what disturbs a dwell, in units of the noise


@dataclass(frozen=True)
class Sizes:
    """Sizes (m,) of a term's coefficients about their mean ``centre``, and the logs (m,) of their probabilities."""

    values: Floats
    logs: Floats
    centre: float = 0.0


@dataclass(frozen=True)
class Projected:
    """Rows in one noise, projected off the model: columns (r, C), readings (r,); log: of the restricted likelihood
    without any term; basis (r, k) of what was projected off; root (D, 3, 3): what whitens the means in this noise;
    means_only: whether rows within dwells are left out, since they are the same in every noise."""

    columns: Floats
    readings: Floats
    log: float
    basis: Floats
    root: Floats
    means_only: bool

    def of_dwells(self) -> tuple[Floats, Floats]:
        """G^T G (D, 3, 3) and G^T z (D, 3) of offsets of the three accelerometers in one dwell alone."""
        count = len(self.root)
        off = self.basis[: 3 * count].reshape(count, 3, -1)
        turned = np.swapaxes(self.root, 1, 2)
        gram = turned @ (np.eye(3) - off @ np.swapaxes(off, 1, 2)) @ self.root
        return gram, (turned @ self.readings[: 3 * count].reshape(count, 3, 1))[..., 0]


@dataclass(frozen=True)
class Courses:
    """What the model leaves of the courses of the readings within dwells: squares (D,) in units of the noise, and their
    degrees of freedom (D,)."""

    squares: Floats
    freedom: Floats

    @classmethod
    def of(cls, rows: Sequence[Floats], dwells: DwellTable, channels: int) -> Courses:
        """From whitened rows of each dwell in which nothing is left of the means of its channels."""
        squares = np.array([float(of_dwell[:, -1] @ of_dwell[:, -1]) for of_dwell in rows])
        freedom = channels * (dwells.folded.width * dwells.folded.piece_numbers - 1.0)
        return cls(squares, np.asarray(freedom, float))

    def log_bayes(self) -> Floats:
        """Log Bayes factors (D,) of whatever changes the course of one dwell, of any size s in units of the noise: with
        n degrees of freedom (1 + s^2)^(-n/2) exp(chi^2 s^2 / (2 (1 + s^2))), averaged over s."""
        squares = _ANY_SIZE**2
        logs = -0.5 * self.freedom[:, None] * np.log1p(squares) + 0.5 * self.squares[:, None] * squares / (
            1.0 + squares
        )
        return np.logaddexp.reduce(logs, axis=1) - math.log(len(squares))


class RunLikelihood:
    """The likelihood of one run, linearised where its fit is.

    linearised: the dwells with the columns of the model. noise: what was stated. least_mps2: scatter that there is in
    any case, by which rounding does not decide. effects: terms that may be missing, of
    which ``columns`` are made. known: number of states of the model that have a flat prior; further ones are terms,
    whose columns come first.
    """

    def __init__(
        self,
        linearised: LinearisedDwells,
        noise: Noise,
        least_mps2: float,
        effects: Sequence[Effect] = (),
        known: int | None = None,
    ) -> None:
        self.linearised, self.noise = linearised, noise
        model = linearised.model
        known = model.count if known is None else known
        added = candidate_columns(linearised.dwells_at_state, effects, model.bench, linearised.state).values
        means, prior = with_shared_noise(linearised.dwells, noise, linearised.means, linearised.state)
        shared = means.design.shape[2] - model.count
        of_effects = means_of(linearised.dwells_at_state, OfPieces(added, linearised.dwells.folded.ends)).design
        design = np.concatenate([means.design[..., :known], means.design[..., model.count :]], axis=2)
        columns = np.concatenate([means.design[..., known : model.count], of_effects], axis=2)
        readings = means.readings - means.design[..., :known] @ linearised.state[:known]
        self.means = means
        covariances = mean_covariances(noise, means, linearised.state) + least_mps2**2 * np.eye(3)
        covariances = lift_rounding(covariances)
        self._root = np.linalg.inv(np.linalg.cholesky(covariances))
        self._log_root = -float(np.log(np.abs(np.einsum("dii->di", self._root))).sum())
        self._model, self._columns = self._root @ design, self._root @ columns
        self._readings = (self._root @ readings[..., None])[..., 0]
        of_prior = np.concatenate([prior[:, :known], prior[:, model.count : -1]], axis=1)
        within_model, within, within_z = self._within(added, known, shared)
        self._more_model = np.concatenate([of_prior, within_model])
        self._more_columns = np.concatenate([np.zeros((len(prior), columns.shape[2])), within])
        self._more_readings = np.append(np.zeros(len(prior)), within_z)

    @property
    def count(self) -> int:
        """Number of columns of terms."""
        return self._columns.shape[2]

    @property
    def rows(self) -> int:
        """Number of rows of means."""
        return self._readings.size

    def _within(self, added: Floats, known: int, shared: int) -> tuple[Floats, Floats, Floats]:
        """Rows of the readings within dwells: of the model (r, known + shared), the terms (r, C) and readings (r,)."""
        linearised, noise = self.linearised, self.noise
        dwells, model = linearised.dwells_at_state, linearised.model
        values, width = of_all_pieces(linearised.columns), model.count - known + added.shape[3]
        self.courses = Courses(np.zeros(len(dwells)), np.zeros(len(dwells)))
        if not noise.within_seen:
            return np.zeros((0, known + shared)), np.zeros((0, width)), np.zeros(0)
        judging = noise.with_scatter_as_flicker(len(dwells)).without(RandomWalk)
        without_means = judging if noise.attitude_unknown else judging.without(SettingError)
        without_means = without_means.with_terms(Scatter(np.full(3, _IMMENSE_MPS2)))
        parts = [values, added, judging.columns("run", dwells, linearised.state)]
        nodes = min(part.shape[1] for part in parts)
        both = np.concatenate([np.broadcast_to(p[:, :nodes], (len(p), nodes, *p.shape[2:])) for p in parts], axis=3)
        moving = _changing(both, dwells.folded.ends)
        moving[: model.count] = True
        about = np.zeros(int(moving.sum()))
        about[: model.count] = linearised.state
        moving_columns = OfPieces(both[..., moving], dwells.folded.ends)
        of_dwells = whiten(dwells, moving_columns, without_means, linearised.state, about, reduced=False)
        self.courses = Courses.of(of_dwells, dwells, 1 if noise.attitude_unknown else 3)
        rows = np.concatenate(of_dwells)
        if len(rows) > rows.shape[1]:
            rows = triangle(rows)
        full = np.zeros((len(rows), both.shape[3]))
        full[:, moving] = rows[:, :-1]
        last = model.count + added.shape[3]
        of_model = np.zeros((len(rows), known + shared))
        of_model[:, STATE_COUNT:known] = full[:, STATE_COUNT:known]  # the twelve have none, but for noise of the angles
        of_model[:, known:] = full[:, last:]
        readings = rows[:, -1] + full[:, known : model.count] @ linearised.state[known:]
        return of_model, full[:, known:last], readings

    def recombine(self, blocks: Sequence[tuple[slice, Floats | None]]) -> None:
        """Replace the columns of the terms by blocks of combinations of them."""
        for name in ("_columns", "_more_columns"):
            columns = getattr(self, name)
            parts = [columns[..., part] if matrix is None else columns[..., part] @ matrix for part, matrix in blocks]
            setattr(self, name, np.concatenate(parts, axis=-1))

    def append(self, combinations: Sequence[tuple[Indices, Floats]]) -> None:
        """Add combinations of columns of the terms, each behind the others."""
        for name in ("_columns", "_more_columns"):
            columns = getattr(self, name)
            parts = [columns[..., places] @ matrix for places, matrix in combinations]
            setattr(self, name, np.concatenate([columns, *parts], axis=-1))

    def column_lengths(self) -> Floats:
        """The length (C,) of each column, in units of the noise."""
        squares = np.einsum("dic,dic->c", self._columns, self._columns) + np.sum(self._more_columns**2, axis=0)
        return np.sqrt(squares)

    def rescale(self, scales: Floats) -> None:
        """Multiply the columns of the terms by these (C,)."""
        self._columns, self._more_columns = self._columns * scales, self._more_columns * scales

    def bare(self, covariances: Floats | None) -> float:
        """Log of the restricted likelihood with further noise, without any term."""
        log, chi2 = self._without_terms(covariances)
        return log - 0.5 * chi2

    def _without_terms(self, covariances: Floats | None) -> tuple[float, float]:
        """Return the log of the density of the rows that the model leaves, but for its exponent, and chi-squared."""
        model, _, readings, _, log = self._in_noise(covariances, columns=False)
        z = np.append(readings, self._more_readings)
        basis, upper = np.linalg.qr(np.concatenate([model, self._more_model]) @ self._seen)
        left = z - basis @ (basis.T @ z)
        return log - float(np.log(np.abs(np.diag(upper))).sum()), float(left @ left)

    def whole(self) -> Floats:
        """The columns (r, C) of the terms in the noise that was stated, projected off the model, in all rows."""
        return self.projected(None, whole=True).columns

    def projected(self, covariances: Floats | None, flat: Indices | None = None, whole: bool = False) -> Projected:
        """The rows with further noise, (D, 3, 3) in units of that stated, projected off the model, and off the columns
        ``flat`` of the terms.

        Rows within dwells in which neither the model nor these have columns are the same in every noise: they are left
        out, and ``means_only`` says so.
        """
        model, terms, z, root, log = self._in_noise(covariances)
        means_only = not (whole or self._has_more_model or (flat is not None and self._more_columns[:, flat].any()))
        if not means_only:
            model, z = np.concatenate([model, self._more_model]), np.append(z, self._more_readings)
            terms = np.concatenate([terms, self._more_columns])
        basis, upper = np.linalg.qr(model @ self._seen)
        log -= float(np.log(np.abs(np.diag(upper))).sum())
        terms, z = terms - basis @ (basis.T @ terms), z - basis @ (basis.T @ z)
        if flat is not None and len(flat):
            left = _directions(terms[:, flat])
            terms, z = terms - left @ (left.T @ terms), z - left @ (left.T @ z)
            basis = np.hstack([basis, left])
        log -= 0.5 * float(z @ z) + (0.5 * float(self._more_readings @ self._more_readings) if means_only else 0.0)
        return Projected(terms, z, log, basis, root, means_only)

    def explained_by(self, places: Indices, rows: Projected) -> tuple[Floats, Floats]:
        """What some columns explain of all columns, (f, C), and of the readings, (f,): products with an orthonormal
        basis of f vectors."""
        some, count = rows.columns[:, places], len(rows.columns)
        if rows.means_only:
            some = np.concatenate([some, self._more_columns[:, places]])
        left = _directions(some).T
        columns, readings = left[:, :count] @ rows.columns, left[:, :count] @ rows.readings
        if left.shape[1] > count:
            columns = columns + left[:, count:] @ self._more_columns
            readings = readings + left[:, count:] @ self._more_readings
        return columns, readings

    def _in_noise(
        self, covariances: Floats | None, columns: bool = True
    ) -> tuple[Floats, Floats, Floats, Floats, float]:
        """The rows of the means with further noise: of the model, the terms, and readings; what whitens them, and the
        log of their density."""
        count = len(self._root)
        root: Floats = np.broadcast_to(np.eye(3), self._root.shape)
        log = -self._log_root
        parts = [self._model, self._columns if columns else self._columns[..., :0], self._readings[..., None]]
        if covariances is not None:
            lower = np.linalg.cholesky(lift_rounding(np.eye(3) + covariances))
            root = np.asarray(np.linalg.inv(lower), float)
            parts = [root @ part for part in parts]
            log -= float(np.log(np.einsum("dii->di", lower)).sum())
        return parts[0].reshape(3 * count, -1), parts[1].reshape(3 * count, -1), parts[2].ravel(), root, log

    @property
    def _has_more_model(self) -> bool:
        return bool(self._more_model.any())

    @property
    def more(self) -> tuple[Floats, Floats]:
        """Rows within dwells and of prior knowledge: of the terms (r, C), and readings (r,)."""
        return self._more_columns, self._more_readings

    @cached_property
    def _seen(self) -> Floats:
        """Combinations (P, r) of the model's columns of unit length that are seen, without those that are none."""
        whole = np.concatenate([self._model.reshape(-1, self._model.shape[2]), self._more_model])
        sizes = np.linalg.norm(whole, axis=0)
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        _, singular, right = np.linalg.svd(whole / sizes, full_matrices=False)
        kept = singular > 1e-9 * singular.max(initial=1e-300)
        return (right[kept] / singular[kept, None]).T / sizes[:, None]

    def sizes_of_noise(self) -> Floats:
        """Sizes (k,) of noise that are tried, in units of ``shapes_of``: from one that shows nothing to all of the
        misfit."""
        most = math.sqrt(self.misfit / max(self.rows - self._model.shape[2], 1))
        step = self.step
        return _LEAST * np.exp(step * np.arange(int(math.log(max(3.0 * most, 30.0) / _LEAST) / step) + 4))

    @cached_property
    def misfit(self) -> float:
        """Chi-squared of the means without any term, in the noise that was stated."""
        return self._without_terms(None)[1]

    @property
    def step(self) -> float:
        """Step of the logarithm of a size of noise: cubic interpolation of the likelihood of n rows, whose derivatives
        are about n, errs by n step^4 / 100 or so."""
        return min((10.0 / self.rows) ** 0.25, 0.6)

    def shapes_of(self, kind: Part) -> Floats:
        """Covariances (D, 3, 3) of scatter ("common"; "first" ... of one accelerometer) or of a setting error, of unit
        size where it equals the noise that was stated in its mean."""
        covariances = FREE[kind].shapes(self.means, self.linearised.state).sum(axis=0)
        shapes = self._root @ covariances @ np.swapaxes(self._root, 1, 2)
        return shapes / max(float(np.einsum("dii->di", shapes).max(axis=1).mean()), 1e-300)


def _directions(columns: Floats) -> Floats:
    """Return an orthonormal basis (r, f) of columns (r, q), without what is none but for rounding."""
    lengths = np.linalg.norm(columns, axis=0)
    left, singular, _ = np.linalg.svd(columns / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    return np.asarray(left[:, singular > _SEEN], float)


def _changing(values: Floats, ends: Indices) -> Mask:
    """Tell of each column (pieces, K, 3, C) whether it changes within dwells by more than noise of the angles makes."""
    starts, largest = ends[:-1], np.maximum(np.abs(values).max(axis=(0, 1, 2)), 1e-300)
    highest = np.maximum.reduceat(values.max(axis=1), starts, axis=0)
    lowest = np.minimum.reduceat(values.min(axis=1), starts, axis=0)
    return np.asarray((highest - lowest).max(axis=(0, 1)) > _CHANGES * largest, bool)


def log_bayes(gram: Floats, along: Floats, squares: Floats, log_weights: Floats, centres: Floats) -> Floats:
    """Log Bayes factors (n,) of n terms of q columns: gram (n, q, q), along (n, q) = G^T z, each averaged over its
    sizes, of which the squares (n, m), the logs (n, m) of their probabilities and the centres (n,) are given."""
    scales = np.sqrt(np.maximum(np.einsum("nqq->nq", gram).max(axis=1), 1e-300))
    values, vectors = np.linalg.eigh(gram / scales[:, None, None] ** 2)
    values = np.where(values > 1e-13, values, 0.0)
    shifted = along - (gram @ np.ones(gram.shape[1])) * centres[:, None] if centres.any() else along
    shift = along.sum(axis=1) * centres - 0.5 * gram.sum(axis=(1, 2)) * centres**2 if centres.any() else 0.0
    turned = np.einsum("nqk,nq->nk", vectors, shifted / scales[:, None]) ** 2 * (values > 0.0)
    squares = (squares * scales[:, None] ** 2)[:, :, None]
    spread = squares * values[:, None]
    logs = 0.5 * np.sum(squares * turned[:, None] / (1.0 + spread) - np.log1p(spread), axis=2)
    return np.logaddexp.reduce(logs + log_weights, axis=1) + shift


def log_bayes_together(parts: Sequence[Floats], readings: Floats, sizes: Sequence[Sizes]) -> float:
    """Log Bayes factor of terms together: columns (r, q) of each, readings (r,), each averaged over its sizes."""
    columns = np.hstack(parts)
    groups = np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
    centre = np.array([each.centre for each in sizes])[groups]
    shifted = readings - columns @ centre
    gram, along = columns.T @ columns, columns.T @ shifted
    mesh = np.stack([each.ravel() for each in np.meshgrid(*(s.values for s in sizes), indexing="ij")], axis=1)
    logs = np.sum([each.ravel() for each in np.meshgrid(*(s.logs for s in sizes), indexing="ij")], axis=0)
    scaled = mesh[:, groups]
    spread = np.eye(len(gram)) + scaled[:, :, None] * gram * scaled[:, None]
    right = scaled * along
    solved = np.linalg.solve(spread, right[..., None])[..., 0]
    terms = logs + 0.5 * np.sum(right * solved, axis=1) - 0.5 * np.linalg.slogdet(spread)[1]
    return float(np.logaddexp.reduce(terms)) + 0.5 * float(readings @ readings - shifted @ shifted)


def integrated(logs: Floats, step: float) -> Floats:
    """Log of the integral (n,) of exp(logs) over the logarithm of a size, from its values (n, k) at equal steps,
    between which it is cubic (Lagrange's polynomials through four neighbours)."""
    count = logs.shape[1]
    at = np.arange((count - 1) * _FINE + 1) / _FINE
    first = np.clip(np.floor(at).astype(int) - 1, 0, count - 4)
    u = at - first
    weights = np.stack([
        -(u - 1) * (u - 2) * (u - 3) / 6, u * (u - 2) * (u - 3) / 2, -u * (u - 1) * (u - 3) / 2,
        u * (u - 1) * (u - 2) / 6,
    ])  # fmt: skip
    fine = sum(weights[k] * logs[:, first + k] for k in range(4))
    return np.logaddexp.reduce(fine, axis=1) + math.log(step / _FINE)
