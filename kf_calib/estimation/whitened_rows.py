"""Whitened rows of dwells: readings and the columns of a model, divided by the noise, so that it is of unit size.

The nuisance states of a dwell (setting error, scatter, slow waves of 1/f noise) are eliminated by QR. From such rows
the square-root information filter, the misfit and the tests of candidates are computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import DwellFactor, alike
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.noise_model import Noise, flicker_sigma, shared_noise, slow_scatter
from kf_calib.noise.nuisance_states import (
    SLOW,
    along_force,
    flicker_sigmas,
    flicker_waves,
    nuisance_map,
    nuisance_sigmas,
    sensitivities_of,
)

_USUAL = 24  # columns of candidates that are whitened together in a long run
_AT_ONCE = 1 << 17  # numbers that are processed together, so that they stay in the cache


def whiten(
    dwells: Sequence[DwellFactor],
    columns: Sequence[Floats],
    noise: Noise,
    state: Floats,
    about: Floats | None = None,
    flicker_mps2: Floats | None = None,
    reduced: bool = True,
) -> list[Floats]:
    """Whitened rows [S | H | z] (r, s + p + 1) of each dwell, with unit noise and the dwell's nuisance states
    eliminated by QR.

    S are the columns of the steps that the biases take within the dwell (s = 3 if they walk, else s = 0), and H (p
    columns) refers to the biases at the end of the dwell. The rows of channel i are divided by the sigma of white
    readings whose mean has the same variance as that of the correlated readings. The setting error (three rotations)
    and the scatter (three offsets) are states with Gaussian priors, linearised at ``state``. The residuals within a
    dwell, which do not depend on the states, are not in the result.

    - columns: the model's columns at the nodes of each dwell, (pieces, K, 3, p) each.
    - about (p,): if given, z is the readings less the model's prediction from this state, and the solution is a
      correction to it. Readings of size g exceed their sigma by a factor of 1e6 or more, so that this keeps their
      rounding from being the largest error of later computations.
    - flicker_mps2 (3,): sqrt(h) of 1/f noise with spectral density h / f; its slow components within a dwell are
      nuisance states, too.
    - reduced: reduce the rows to the rank of their columns. Without it all rows are returned, which is faster if there
      are many columns.
    """
    inside = 3 if noise.walk_mps2_per_sqrt_s else 0
    informative = np.append(np.ones(inside), _units(columns)) if reduced else None
    all_rows = list[Floats]([np.empty((0, 0))] * len(dwells))
    for places in _batches(dwells, columns[0].shape[-1]):
        batch, stacked = [dwells[k] for k in places], np.array([columns[k] for k in places])
        rows, count = _weighted(batch, stacked, noise, state, about, flicker_mps2)
        if informative is None:
            whitened = list(_less(rows, count))
        else:
            whitened = _informative(triangle(rows)[:, count:, count:], informative)
        for k, of_dwell in zip(places, whitened, strict=True):
            all_rows[k] = of_dwell
    return all_rows


def _batches(dwells: Sequence[DwellFactor], width: int) -> Iterator[list[int]]:
    """Group the indices of dwells whose rows have one shape, limited so that their ``width`` columns fit into the
    cache."""
    for places in alike(dwells):
        first = dwells[places[0]]
        most = max(_AT_ONCE // (3 * len(first.pieces) * first.width * (width + 1)), 1)
        yield from (places[k : k + most] for k in range(0, len(places), most))


@dataclass(frozen=True)
class _Blocks:
    """The columns of whitened rows: [rotations and offsets | slow waves | steps S | model H | readings z].

    - states, waves, steps, model: their numbers of columns; waves and steps are a third for each accelerometer.
    """

    states: int
    waves: int
    steps: int
    model: int

    @property
    def nuisances(self) -> int:
        """Number of columns that are eliminated."""
        return self.states + self.waves

    @property
    def width(self) -> int:
        """Number of all columns, readings included."""
        return self.nuisances + self.steps + self.model + 1

    def waves_of(self, channel: int) -> slice:
        """The slow waves of one accelerometer."""
        first = self.states + self.waves // 3 * channel
        return slice(first, first + self.waves // 3)

    def steps_of(self, channel: int) -> slice:
        """The step of the bias of one accelerometer."""
        first = self.nuisances + self.steps // 3 * channel
        return slice(first, first + self.steps // 3)


def _weighted(
    dwells: Sequence[DwellFactor],
    columns: Floats,
    noise: Noise,
    state: Floats,
    about: Floats | None,
    flicker_mps2: Floats | None,
) -> tuple[Floats, int]:
    """Return the whitened rows [nuisances | S | H | z] (d, r, n) of dwells of one shape, and the number of nuisance
    columns.

    ``columns`` is (d, pieces, K, 3, p). The rows of the three channels follow one another; the rows of the priors come
    last.
    """
    priors, slow = nuisance_sigmas(noise), np.zeros(0) if flicker_mps2 is None else flicker_sigmas(flicker_mps2)
    blocks = _Blocks(len(priors), len(slow), 3 if noise.walk_mps2_per_sqrt_s else 0, columns.shape[-1])
    parts = _channels(dwells, columns, blocks, nuisance_map(dwells, noise, state), about)
    sigma, roots = noise.effective_sigma_mps2, np.sqrt([dwell.weight for dwell in dwells])
    parts *= roots[:, None, None, None] / sigma[:, None, None]
    walks = roots[:, None] * (noise.walk_mps2_per_sqrt_s / sigma)
    if noise.attitude_unknown:
        along = _unit_along(dwells, noise, state)
        parts, walks = _combined(parts, along), np.sqrt((along**2)[:, None] @ (walks**2)[:, :, None])[:, :, 0]
    if blocks.steps:
        for dwell_parts, dwell, ratios in zip(parts, dwells, walks, strict=True):
            for part, ratio in zip(dwell_parts, ratios.tolist(), strict=True):
                part[:] = dwell.walk.whiten(part, ratio)
    measured, count = parts.reshape(len(dwells), -1, blocks.width), blocks.nuisances
    prior = np.zeros((len(dwells), count, blocks.width))
    prior[:, :, :count] = np.diag(1.0 / np.append(priors, slow))
    return np.concatenate([measured, prior], axis=1), count


def _channels(
    dwells: Sequence[DwellFactor], columns: Floats, blocks: _Blocks, nuisances: Floats, about: Floats | None
) -> Floats:
    """Return the rows (d, 3, r, n) of the three channels before they are divided by their sigma."""
    many, pieces, functions, _, _ = columns.shape
    shape = many, pieces * functions, -1
    triangles = np.array([dwell.triangles for dwell in dwells])
    basis, readings = triangles[:, :, :functions, :functions], triangles[:, :, :functions, functions:]
    regressors = np.array([dwell.regressors for dwell in dwells])
    parts = np.zeros((many, 3, pieces * functions, blocks.width))
    for i in range(3):
        part, design = parts[:, i], on_basis(columns[..., i, :])
        part[..., : blocks.states] = (regressors @ nuisances[:, i, None]).reshape(shape)
        if blocks.steps:
            part[..., blocks.steps_of(i)] = np.array([dwell.walk.step for dwell in dwells])[..., None]
        part[..., blocks.nuisances + blocks.steps : -1] = (basis @ design).reshape(shape)
        measured = readings[..., i, None]
        if about is not None:
            measured = measured - basis @ on_basis((columns[..., i, :] @ about)[..., None])
        part[..., -1:] = measured.reshape(shape)
    if blocks.waves:
        waves = (basis[..., :3] @ on_basis(np.array([flicker_waves(dwell) for dwell in dwells]))).reshape(shape)
        for i in range(3):
            parts[:, i, :, blocks.waves_of(i)] = waves
    return parts


def _unit_along(dwells: Sequence[DwellFactor], noise: Noise, state: Floats) -> Floats:
    """Return the unit vectors (d, 3) by which whitened channels are combined to the size of the force."""
    along = along_force(dwells, sensitivities_of(dwells, state)) * noise.effective_sigma_mps2
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def _combined(parts: Floats, along: Floats) -> Floats:
    """Return the rows (d, 1, r, n) of whitened channels (d, 3, r, n) along unit vectors (d, 3)."""
    return np.einsum("di,dirn->drn", along, parts)[:, None]


def _less(rows: Floats, count: int) -> Floats:
    """Project rows (d, r, n) off their first ``count`` columns and drop these columns."""
    nuisances = np.linalg.qr(rows[..., :count])[0]
    return rows[..., count:] - nuisances @ (np.swapaxes(nuisances, 1, 2) @ rows[..., count:])


def misfit_rows(
    dwells: Sequence[DwellFactor],
    columns: Sequence[Floats],
    noise: Noise,
    state: Floats,
    width: int,
    reduced: bool = True,
) -> tuple[list[Floats], int]:
    """Rows [H | W | G | z] by which the misfit is judged, and the number of columns before G; H is the first ``width``
    columns.

    W are columns for noise that dwells have in common (``noise_model.shared_noise``): the slow part of a stated scatter
    and the error of the temperature. Their coefficients have a prior, whose rows come first in the list. Within a dwell
    the slow components of 1/f noise are nuisance states.
    """
    shared, sigma = shared_noise(dwells, noise)
    flicker = flicker_of_scatter(dwells, noise)
    if not sigma.size:
        return whiten(dwells, columns, noise, state, reduced=reduced), width
    count, places = columns[0].shape[3] + len(sigma) + 1, width + np.arange(len(sigma))
    prior = np.zeros((len(sigma), count))
    prior[np.arange(len(sigma)), places] = 1.0 / sigma
    both = [
        np.concatenate([own[..., :width], more, own[..., width:]], axis=3)
        for own, more in zip(columns, shared, strict=True)
    ]
    return [prior, *whiten(dwells, both, noise, state, flicker_mps2=flicker, reduced=reduced)], width + len(sigma)


def flicker_of_scatter(dwells: Sequence[DwellFactor], noise: Noise) -> Floats | None:
    """sqrt(h) (3,) of the 1/f noise that a stated scatter may be; None where it has no slow part."""
    return flicker_sigma(noise, len(dwells)) if slow_scatter(dwells, noise)[1].size else None


@dataclass(frozen=True)
class _Alike:
    """Dwells of one shape in ``MisfitColumns``.

    - pieces (d, pieces), rows (d, r): which of all pieces and rows are theirs.
    - triangles (d, pieces, K, K): of the basis functions. nuisances (d, r, n): orthonormal basis of nuisance states.
    - along (d, 3): by which whitened channels are combined where attitudes are not known; else None.
    - roots (d,): of the weights of their readings.
    """

    pieces: NDArray[np.intp]
    rows: NDArray[np.intp]
    triangles: Floats
    nuisances: Floats
    along: Floats | None
    roots: Floats


class MisfitColumns:
    """The columns G alone of ``misfit_rows``, all their rows, for a noise in which the biases do not walk.

    Whatever does not depend on the columns is computed once.
    """

    def __init__(self, dwells: Sequence[DwellFactor], noise: Noise, state: Floats) -> None:
        self._sigma, shared = noise.effective_sigma_mps2, len(shared_noise(dwells, noise)[1])
        flicker = flicker_of_scatter(dwells, noise)
        priors = len(nuisance_sigmas(noise)) + (0 if flicker is None else 3 * len(SLOW))
        counts = np.array([len(dwell.pieces) for dwell in dwells])
        channels = 1 if noise.attitude_unknown else 3
        lengths = channels * counts * [dwell.width for dwell in dwells] + priors
        self._groups, self.ends = list[_Alike](), shared + np.cumsum([0, *lengths])
        """The first row of each dwell, and at last the number of rows."""
        first_piece, first_row = np.cumsum(counts) - counts, self.ends[:-1]
        for places in _batches(dwells, _USUAL):
            some, pieces, width = [dwells[k] for k in places], int(counts[places[0]]), dwells[places[0]].width
            none = np.zeros((len(some), pieces, width, 3, 0))
            rows, count = _weighted(some, none, noise, state, None, flicker)
            group = _Alike(
                first_piece[places, None] + np.arange(pieces),
                first_row[places, None] + np.arange(rows.shape[1]),
                np.array([dwell.triangles[:, :width, :width] for dwell in some]),
                np.linalg.qr(rows[..., :count])[0],
                _unit_along(some, noise, state) if noise.attitude_unknown else None,
                np.sqrt([dwell.weight for dwell in some]),
            )
            self._groups.append(group)

    def of(self, columns: Floats) -> Floats:
        """G (m, q) of columns at the nodes of all pieces (pieces, K, 3, q)."""
        whitened = np.zeros((self.ends[-1], columns.shape[3]))
        for group in self._groups:
            stacked = columns[group.pieces]  # (d, pieces, K, 3, q)
            many, pieces, width, _, count = stacked.shape
            on_triangles = group.triangles @ on_basis(stacked.reshape(many, pieces, width, 3 * count))
            scale = group.roots[:, None, None, None, None] / self._sigma[:, None]
            parts = np.moveaxis(on_triangles.reshape(stacked.shape) * scale, 3, 1)
            parts = parts.reshape(many, 3, pieces * width, count)
            if group.along is not None:
                parts = _combined(parts, group.along)
            size = parts.shape[1] * parts.shape[2]
            rows = np.zeros((many, group.rows.shape[1], count))
            rows[:, :size] = parts.reshape(many, size, count)
            whitened[group.rows] = rows - group.nuisances @ (
                np.swapaxes(group.nuisances[:, :size], 1, 2) @ rows[:, :size]
            )
        return whitened


def with_frame(rows: list[Floats], model: Model, noise: Noise, first: int = 0) -> list[Floats]:
    """The rows [S | H | W | z] with one more for each state that the model fixes at zero, which has no column: a
    reading of that state times g. They join the rows at index ``first``."""
    if not model.fixed:
        return rows
    fixing, inside = np.zeros((len(model.fixed), rows[first].shape[1])), 3 if noise.walk_mps2_per_sqrt_s else 0
    for k, place in enumerate(model.fixed):
        fixing[k, inside + place] = model.bench.gravity_mps2 / noise.effective_sigma_mps2[0]
    return [*rows[:first], np.vstack([fixing, rows[first]]), *rows[first + 1 :]]


def _units(columns: Sequence[Floats]) -> Floats:
    """Return the largest absolute value (p,) of each column in the run, with one common value for all sensitivities and
    1 for the biases."""
    largest = np.max([np.abs(own).max(axis=(0, 1, 2)) for own in columns], axis=0)
    largest[:STATE_COUNT] = np.tile([*[largest[:STATE_COUNT].max()] * 3, 1.0], 3)
    return np.where(largest > 0, largest, 1.0)


def _informative(rows: Floats, units: Floats) -> list[Floats]:
    """Reduce rows [H | z] of dwells (d, r, n) to as many rows as H has rank, and drop the residuals.

    A dwell without motion has rank 3. An SVD is used because QR would spread the residuals over rows in which only
    columns of rounding size are nonzero.
    """
    left, singular, _ = np.linalg.svd(rows[..., :-1] / units, full_matrices=False)
    ranks = (singular > 1e-9 * singular[:, :1]).sum(axis=1)
    most = int(ranks.max())
    turned = np.swapaxes(left[..., :most], 1, 2) @ rows
    return [own[:rank].copy() for own, rank in zip(turned, ranks, strict=True)]
