"""Whitened rows of dwells: readings and the columns of a model, divided by the noise, so that it is of unit size.

The errors that the noise draws for each dwell (a setting error, scatter, slow waves of 1/f noise) are eliminated by QR.
From such rows the square-root information filter, the misfit and the tests of candidates are computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import IN_CACHE, ROUNDING, Floats, portions
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.qr import inverse_of_lower, triangle
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import AlikeDwells, DwellTable
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.rotations import along_force, sensitivities_of

_LARGE = 1e3  # errors, in sigmas of a mean, whose squares may be added to its variance


def whiten(
    dwells: Sequence[Dwell],
    columns: Sequence[Floats],
    noise: Noise,
    state: Floats,
    about: Floats | None = None,
    reduced: bool = True,
) -> Sequence[Floats]:
    """Whitened rows [S | H | z] (r, s + p + 1) of each dwell, with unit noise and the errors that are drawn for each
    dwell eliminated by QR.

    S are the columns of the steps that the biases take within the dwell (s = 3 if they walk, else s = 0), and H (p
    columns) refers to the biases at the end of the dwell. The rows of channel i are divided by the sigma of white
    readings whose mean has the same variance as that of the correlated readings. The errors of the terms of the noise
    are states with Gaussian priors, linearised at ``state``. The residuals within a dwell, which do not depend on the
    states, are not in the result.

    - columns: the model's columns at the nodes of each dwell, (pieces, K, 3, p) each.
    - about (p,): if given, z is the readings less the model's prediction from this state, and the solution is a
      correction to it. Readings of size g exceed their sigma by a factor of 1e6 or more, so that this keeps their
      rounding from being the largest error of later computations.
    - reduced: reduce the rows to the rank of their columns. Without it all rows are returned, which is faster if there
      are many columns.
    """
    values = of_all_pieces(columns)
    table = DwellTable.of(dwells)
    noise_about = _About.of(table, noise, state, about)
    batches = list(_batches(table, values.shape[-1]))
    by_means = [reduced and batch.tells_means_only(values, noise_about) for batch in batches]
    if all(by_means):
        rows_of_means = np.empty((len(table), 3, values.shape[-1] + 1))
        for batch in batches:
            rows_of_means[batch.dwells] = _of_means(batch, values[batch.pieces], noise_about)
        return OfPieces(rows_of_means.reshape(-1, rows_of_means.shape[2]), 3 * np.arange(len(table) + 1))
    informative = np.append(np.ones(noise.walk.steps), _units(values)) if reduced else None
    all_rows = list[Floats]([np.empty((0, 0))] * len(table))
    for batch, is_by_means in zip(batches, by_means, strict=True):
        of_batch = values[batch.pieces]
        if is_by_means:
            whitened = _of_means(batch, of_batch, noise_about)
        else:
            rows, count = _weighted(batch, of_batch, noise_about)
            if informative is None:
                # rows (d, r, n) off their first ``count`` columns, without these columns
                errors = np.linalg.qr(rows[..., :count])[0]
                whitened = rows[..., count:] - errors @ (np.swapaxes(errors, 1, 2) @ rows[..., count:])
            else:
                whitened = _informative(triangle(rows)[:, count:, count:], informative)
        for k, of_dwell in zip(batch.dwells.tolist(), whitened, strict=True):
            all_rows[k] = of_dwell
    return all_rows


def log_of_errors(dwells: DwellTable, noise: Noise, state: Floats) -> float:
    """Log of the density of readings that were whitened, but for chi-squared: -1/2 log det(1 + E^T E) of all dwells,
    with E the changes of the readings by 1 sigma of each error that is drawn for a dwell."""
    about, log, width = _About.of(dwells, noise, state), 0.0, dwells.folded.width
    for batch in _batches(dwells, about.errors):
        rows, count = _weighted(batch, np.zeros((*batch.pieces.shape, width, 3, 0)), about)
        upper = np.linalg.qr(rows[..., :count], mode="r")
        log -= float(np.log(np.abs(np.einsum("dkk->dk", upper))).sum())
    return log


@dataclass(frozen=True)
class _About:
    """The noise by which rows are divided, the changes (pieces, nodes, 3, q) of the readings by 1 sigma of each error
    that is drawn for a dwell, linearised at a state, and what ``whiten`` is told."""

    noise: Noise
    changes: Floats
    state: Floats
    about: Floats | None

    @classmethod
    def of(cls, table: DwellTable, noise: Noise, state: Floats, about: Floats | None = None) -> _About:
        """That of some dwells."""
        return cls(noise, noise.columns("dwell", table, state), state, about)

    @property
    def errors(self) -> int:
        """Number of errors that are eliminated."""
        return self.changes.shape[3]


@dataclass(frozen=True)
class _Batch:
    """Dwells of one shape, few enough for their rows to stay in the cache: the number of the shape, and which of its
    dwells they are."""

    table: DwellTable
    number: int
    part: slice

    @property
    def shape(self) -> AlikeDwells:
        """The shape."""
        return self.table.folded.shapes[self.number]

    @property
    def dwells(self) -> NDArray[np.intp]:
        """Indices (d,) of the dwells."""
        return self.shape.dwells[self.part]

    @property
    def pieces(self) -> NDArray[np.intp]:
        """Indices (d, P) of their pieces."""
        return self.shape.pieces[self.part]

    @cached_property
    def triangles(self) -> Floats:
        """Their triangles (d, P, K + 3, K + 3)."""
        return self.table.triangles[self.pieces]

    def rows_of(self, values: Floats, height: int) -> Floats:
        """The first ``height`` rows (d, P, height, c) of columns given at the nodes (d, P, K, c). If it is one, only
        the means of dwells tell something, which are the values at the middle."""
        if height == 1:
            return self.triangles[:, :, :1, :1] * values[:, :, 1:2]
        return self.triangles[:, :, :height, : values.shape[2]] @ on_basis(values)

    def tells_means_only(self, columns: Floats, about: _About) -> bool:
        """Whether only the mean of each dwell tells something of the states, so that whitened rows have full rank:
        nothing else is known, or the columns (pieces, K, 3, p) and what errors change are constant within each."""
        if about.noise.walk.steps or about.noise.attitude_unknown:
            return False
        if self.pieces.shape[1] == 1 and not self.triangles[:, 0, 1 : self.table.folded.width].any():
            return True
        return _is_constant(columns[self.pieces]) and _is_constant(about.changes[self.pieces])


def _batches(table: DwellTable, width: int) -> Iterator[_Batch]:
    """Group dwells whose rows have one shape, limited so that their ``width`` columns fit into the cache."""
    for number, shape in enumerate(table.folded.shapes):
        most = max(IN_CACHE // (3 * shape.pieces.shape[1] * table.folded.width * (width + 1)), 1)
        yield from (_Batch(table, number, part) for part in portions(len(shape.dwells), most))


def _weighted(batch: _Batch, columns: Floats, about: _About) -> tuple[Floats, int]:
    """Return the whitened rows [errors | S | H | z] (d, r, n) of dwells of one shape, and the number of errors.

    ``columns`` is (d, pieces, K, 3, p). The rows of the three channels follow one another; the rows of the priors come
    last.
    """
    noise, many, count = about.noise, len(columns), about.errors
    parts = _channels(batch, columns, about, columns.shape[2])
    sigma = noise.effective_sigma_mps2
    roots = np.sqrt(batch.table.folded.weights[batch.dwells])
    parts /= (sigma / roots)[:, :, None, None]
    walks = roots * (noise.walk_mps2_per_sqrt_s / sigma)
    if noise.attitude_unknown:
        along = _unit_along(batch, noise, about.state)
        parts, walks = _combined(parts, along), np.sqrt((along**2)[:, None] @ (walks**2)[:, :, None])[:, :, 0]
    elif batch.table.folded.correlated:
        parts, walks = _independent(parts, walks, batch.table.folded.correlations[batch.dwells])
    if noise.walk.steps:
        paths = batch.table.folded.walks
        for dwell_parts, k, ratios in zip(parts, batch.dwells.tolist(), walks, strict=True):
            for part, ratio in zip(dwell_parts, ratios.tolist(), strict=True):
                part[:] = paths[k].whiten(part, ratio)
    measured = parts.reshape(many, -1, parts.shape[-1])
    prior = np.broadcast_to(np.eye(count, parts.shape[-1]), (many, count, parts.shape[-1]))
    return np.concatenate([measured, prior], axis=1), count


def _of_means(batch: _Batch, columns: Floats, about: _About) -> Floats:
    """Return the whitened rows [H | z] (d, 3, p + 1) of dwells of which only the means tell something.

    The mean over all pieces is the combination of the first rows of their triangles by the roots of their numbers of
    readings, which are on the diagonals. Errors of unit variance that change the three means by N, in units of their
    own noise, give them the covariance I + N N^T; the rows are divided by its Cholesky factor.
    """
    count = about.errors
    roots = batch.triangles[:, :, 0, 0]
    sigmas = about.noise.effective_sigma_mps2 / np.sqrt(batch.table.folded.weights[batch.dwells])
    along = (roots / np.linalg.norm(roots, axis=1, keepdims=True))[:, None, None, :]
    rows = (along @ _channels(batch, columns, about, 1))[:, :, 0] / sigmas[:, :, None]
    if batch.table.folded.correlated:
        root = cast("Floats", np.linalg.cholesky(batch.table.folded.correlations[batch.dwells]))
        rows = inverse_of_lower(root) @ rows
    changes = rows[..., :count]
    if np.abs(changes).max(initial=0.0) > _LARGE:  # squares would lose digits: eliminate by QR
        prior = np.broadcast_to(np.eye(count, rows.shape[2]), (len(rows), count, rows.shape[2]))
        return triangle(np.concatenate([rows, prior], axis=1))[:, count:, count:]
    lower = cast("Floats", np.linalg.cholesky(np.eye(3) + changes @ np.swapaxes(changes, 1, 2)))
    return inverse_of_lower(lower) @ rows[..., count:]


def _channels(batch: _Batch, columns: Floats, about: _About, height: int) -> Floats:
    """Return the first ``height`` rows [errors | S | H | z] of each piece (d, 3, P height, n) of the three channels
    before they are divided by their sigma."""
    many, pieces, functions, _, _ = columns.shape
    shape, readings = (many, pieces * height, -1), batch.triangles[:, :, :height, functions:]
    changes, first, last = about.changes[batch.pieces], about.errors, about.errors + about.noise.walk.steps
    parts = np.zeros((many, 3, pieces * height, last + columns.shape[-1] + 1))
    for i in range(3):
        part = parts[:, i]
        if first:
            part[..., :first] = batch.rows_of(changes[..., i, :], height).reshape(shape)
        if about.noise.walk.steps:
            steps = [batch.table.folded.walks[k].step for k in batch.dwells.tolist()]
            part[..., first + i : first + i + 1] = np.array(steps)[..., None]
        part[..., last:-1] = batch.rows_of(columns[..., i, :], height).reshape(shape)
        measured = readings[..., i, None]
        if about.about is not None:
            measured = measured - batch.rows_of((columns[..., i, :] @ about.about)[..., None], height)
        part[..., -1:] = measured.reshape(shape)
    return parts


def _unit_along(batch: _Batch, noise: Noise, state: Floats) -> Floats:
    """Return the unit vectors (d, 3) by which whitened channels are combined to the size of the force."""
    sensitivities = sensitivities_of(batch.table, state, batch.dwells)
    along = along_force(batch.table, sensitivities, batch.dwells) * noise.effective_sigma_mps2
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def _independent(parts: Floats, walks: Floats, correlations: Floats) -> tuple[Floats, Floats]:
    """Return three combinations (d, 3, r, n) of whitened channels whose noise has these correlations (d, 3, 3), such
    that neither noise nor walks of these intensities (d, 3) are common to two, and the intensities (d, 3) of these.

    With the Cholesky factor L of the correlation and the eigenvectors V of L^-1 diag(q^2) L^-T they are V^T L^-1.
    """
    inverse = inverse_of_lower(cast("Floats", np.linalg.cholesky(correlations)))
    squares, turns = np.linalg.eigh(inverse * walks[:, None] ** 2 @ np.swapaxes(inverse, 1, 2))
    mixing = np.swapaxes(turns, 1, 2) @ inverse if walks.any() else inverse
    return np.einsum("dij,djrn->dirn", mixing, parts), np.sqrt(np.maximum(squares, 0.0))


def _combined(parts: Floats, along: Floats) -> Floats:
    """Return the rows (d, 1, r, n) of whitened channels (d, 3, r, n) along unit vectors (d, 3)."""
    return np.einsum("di,dirn->drn", along, parts)[:, None]


def misfit_rows(
    dwells: Sequence[Dwell], columns: Sequence[Floats], noise: Noise, state: Floats, width: int, reduced: bool = True
) -> tuple[Sequence[Floats], int]:
    """Rows [H | W | G | z] by which the misfit is judged, and the number of columns before G; H is the first ``width``
    columns.

    W are columns for noise that dwells have in common, the terms of the run; scatter that is stated may be 1/f noise,
    which is one of them. Their coefficients have a prior, whose rows come first in the list.
    """
    dwells, values = DwellTable.of(dwells), of_all_pieces(columns)
    judging = noise.with_scatter_as_flicker(len(dwells))
    shared = judging.columns("run", dwells, state)
    count = shared.shape[3]
    if not count:
        return whiten(dwells, columns, judging, state, reduced=reduced), width
    prior = np.eye(count, values.shape[3] + count + 1, width)
    both = np.concatenate([values[..., :width], shared, values[..., width:]], axis=3)
    rows = whiten(dwells, OfPieces(both, dwells.folded.ends), judging, state, reduced=reduced)
    return [prior, *rows], width + count


def with_frame(rows: Sequence[Floats], model: Model, noise: Noise, first: int = 0) -> Sequence[Floats]:
    """The rows [S | H | W | z] with one more for each state that the model fixes at zero, which has no column: a
    reading of that state times g. They join the rows at index ``first``."""
    if not model.fixed:
        return rows
    fixing = np.zeros((len(model.fixed), rows[first].shape[1]))
    for k, place in enumerate(model.fixed):
        fixing[k, noise.walk.steps + place] = model.bench.gravity_mps2 / noise.effective_sigma_mps2[0]
    return [*rows[:first], np.vstack([fixing, rows[first]]), *rows[first + 1 :]]


def _is_constant(values: Floats) -> bool:
    """Tell whether values (d, P, K, ...) are the same at all nodes of each dwell."""
    return bool((values == values[:, :1, :1]).all())


def _units(columns: Floats) -> Floats:
    """Return the largest absolute value (p,) of each column in the run, with one common value for all sensitivities and
    1 for the biases."""
    largest = np.maximum(columns.max(axis=(0, 1, 2)), -columns.min(axis=(0, 1, 2)))
    largest[:STATE_COUNT] = np.tile([*[largest[:STATE_COUNT].max()] * 3, 1.0], 3)
    return np.where(largest > 0, largest, 1.0)


def _informative(rows: Floats, units: Floats) -> list[Floats]:
    """Reduce rows [H | z] of dwells (d, r, n) to as many rows as H has rank, and drop the residuals.

    A dwell without motion has rank 3. An SVD is used because QR would spread the residuals over rows in which only
    columns of rounding size are nonzero.
    """
    left, singular, _ = np.linalg.svd(rows[..., :-1] / units, full_matrices=False)
    ranks = (singular > ROUNDING * singular[:, :1]).sum(axis=1)
    most = int(ranks.max())
    turned = np.swapaxes(left[..., :most], 1, 2) @ rows
    return [own[:rank].copy() for own, rank in zip(turned, ranks, strict=True)]
