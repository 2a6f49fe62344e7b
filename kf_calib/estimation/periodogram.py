"""The decrease of chi-squared by an oscillation at each of many frequencies, each added alone to a model.

For a dwell whose middle is at t_d, the whitened columns of an oscillation of frequency f, as cosine + i sine for each
accelerometer, are e^(2 pi i f t_d) times columns Gamma_d(f). These vary slowly with f, the more slowly the shorter the
dwell. They are therefore computed at a few Chebyshev points of the band and interpolated between, and sums over the
dwells become matrix products with e^(2 pi i f t_d). The result generalises the Lomb-Scargle periodogram to any linear
model and to noise that is neither white nor equal in all dwells. What a random walk of the biases explains is removed
by means of its banded precision matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import IN_CACHE, ROUNDING, Floats
from kf_calib.bench.paper_parameters import BIASES, STATE_COUNT
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.effects import Effect
from kf_calib.estimation import whitened_rows
from kf_calib.estimation.candidate_scan import SEEN
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns, few_at_a_time, stimulus_of
from kf_calib.noise.noise_model import Noise, steps

_SPARE = 18  # points beyond the phase, rad, that passes during a dwell; the error is then 1e-10 of a column

Waves = NDArray[np.complex128]


class Periodogram:
    """The periodogram of an oscillating ``effect`` at frequencies ``values_hz`` (N,), for given dwells and noise."""

    def __init__(self, linearised: LinearisedDwells, noise: Noise, effect: Effect, values_hz: Floats) -> None:
        self.values_hz, dwells = values_hz, linearised.dwells
        self._middles_s = dwells.folded.ends_s.mean(axis=1)
        self._same_hz = ROUNDING / (2.0 * np.pi * float(np.abs(self._middles_s).max(initial=1e-9)))
        points_hz, self._shares = _points(values_hz, float(np.diff(dwells.folded.ends_s).max()))
        kinds, self._path = [effect.at(hz) for hz in points_hz], None
        self._waves, self._ends, twelve = _waves(linearised, noise, kinds)
        if noise.walk.steps:
            self._path = _Path(twelve, self._ends, steps(dwells, noise))
        middles_s = np.repeat(self._middles_s, np.diff(self._ends))[:, None]
        for k, hz in enumerate(points_hz):
            self._waves[:, k] *= np.exp(-2j * np.pi * hz * middles_s)
        self._squares = self._products_of_waves()

    def delta_chi2(self, rows: Floats, of_dwells: Floats) -> Floats:
        """Decrease of chi-squared (N,) if the oscillation at each frequency is added to a model.

        - rows (r, c): whitened rows [H | z].
        - of_dwells (m, c): the same columns in the rows of the dwells alone, before they are whitened with respect to
          the walk.
        """
        basis, left = _basis_and_rest(rows, of_dwells)
        along = self._along(np.column_stack([basis, left]))
        return self._lowered(along[:, :, :-1], along[:, :, -1])

    def _along(self, columns: Floats) -> Floats:
        """Return the products (N, 6, c) of the cosines and then the sines of the three accelerometers with columns (m,
        c) in the dwells' rows."""
        count, points = columns.shape[1], self._shares.shape[1]
        if not count:
            return np.zeros((len(self.values_hz), 6, 0))
        if self._path is not None:
            columns = self._path.freed(columns)
        waves = self._waves.reshape(len(columns), -1)
        sums = np.array([waves[part].T @ columns[part] for part in _parts(self._ends)])  # (D, 3 points, c)
        products: Waves = np.empty((len(self.values_hz), 3, count), np.complex128)
        for part, turning in self._turning():
            turned_sums = (turning @ sums.reshape(len(sums), -1)).reshape(len(turning), points, 3, count)
            products[part] = np.einsum("np,npic->nic", self._shares[part], turned_sums)
        return np.concatenate([products.real, products.imag], axis=1)

    def _lowered(self, along_model: Floats, along_left: Floats) -> Floats:
        """Return the decrease of chi-squared (N,).

        - along_model (N, 6, p): products of the waves with an orthonormal basis of the model's columns.
        - along_left (N, 6): products of the waves with the residual of the readings.
        """
        sizes = np.sqrt(np.maximum(np.einsum("nii->ni", self._squares), 0.0))
        sizes[sizes <= ROUNDING * sizes.max(initial=0.0)] = np.inf  # a sine that is zero at all (equidistant) dwells
        gram = self._squares - along_model @ np.swapaxes(along_model, 1, 2)
        gram, along = gram / (sizes[:, :, None] * sizes[:, None, :]), along_left / sizes
        inverse = np.linalg.pinv(gram, rcond=SEEN, hermitian=True)
        return np.einsum("ni,nij,nj->n", along, inverse, along)

    def _products_of_waves(self) -> Floats:
        """Return the products (N, 6, 6) of the cosines and sines with each other.

        conj(Gamma_i) Gamma_j contains no phase of the dwell, so that its sum over the dwells is a smooth function of f;
        Gamma_i Gamma_j contains twice the phase of its dwell.
        """
        points, same, twice = self._shares.shape[1], 0.0, list[Waves]()
        for part in _parts(self._ends):
            waves = np.ascontiguousarray(np.moveaxis(self._waves[part], 0, 2))  # (points, 3, r)
            same = same + waves.conj() @ np.swapaxes(waves, 1, 2)
            twice.append(waves @ np.swapaxes(waves, 1, 2))
        sums, products = np.array(twice).reshape(len(twice), -1), np.empty((len(self.values_hz), 6, 6))
        for part, turning in self._turning():
            double = np.einsum("np,npij->nij", self._shares[part], (turning**2 @ sums).reshape(-1, points, 3, 3))
            single = np.einsum("np,pij->nij", self._shares[part], same)
            plus, minus = 0.5 * (single + double), 0.5 * (single - double)
            products[part, :3, :3], products[part, 3:, 3:] = plus.real, minus.real
            products[part, :3, 3:], products[part, 3:, :3] = plus.imag, np.swapaxes(plus.imag, 1, 2)
            if self._path is not None:
                products[part] -= self._explained_by_path(self._path, part, turning)
        return products

    def _explained_by_path(self, path: _Path, part: slice, turning: Waves) -> Floats:
        """Return the part of the products (n, 6, 6) that the random walk of the biases explains, for some
        frequencies."""
        points, count = self._shares.shape[1], len(self._middles_s)
        sums = path.products(self._waves.reshape(len(self._waves), -1)).reshape(count, 6, points, 3)
        found = np.einsum("np,dqpi->dqni", self._shares[part], sums, optimize=True) * turning.T[:, None, :, None]
        sides = np.concatenate([found.real, found.imag], axis=3)  # (D, 6, n, 6)
        solved = np.moveaxis(path.whitened(sides.reshape(6 * count, -1)).reshape(6 * count, -1, 6), 1, 0)
        return np.swapaxes(solved, 1, 2) @ solved

    def _turning(self) -> Iterator[tuple[slice, Waves]]:
        """Yield slices of the frequencies and e^(2 pi i f t_d) (n, D) for each."""
        turns_s, apart_hz, apart = 2j * np.pi * self._middles_s, np.zeros(0), np.zeros((0, 0))
        numbers = len(turns_s) + 3 * self._shares.shape[1] * STATE_COUNT  # turns, and sums of the three accelerometers
        for first in range(0, len(self.values_hz), most := -(-IN_CACHE // numbers)):
            part = slice(first, first + most)
            own_hz = self.values_hz[part] - self.values_hz[first]
            if len(own_hz) > len(apart_hz) or np.abs(own_hz - apart_hz[: len(own_hz)]).max() > self._same_hz:
                apart_hz, apart = own_hz, np.exp(own_hz[:, None] * turns_s)  # once, if the frequencies are equidistant
            yield part, np.exp(self.values_hz[first] * turns_s) * apart[: len(own_hz)]


def _basis_and_rest(rows: Floats, of_dwells: Floats) -> tuple[Floats, Floats]:
    """Return, in the rows of the dwells alone, the columns (m, p) of a model that are orthonormal in all whitened rows
    [H | z], and the residual (m,) of the readings."""
    scale = np.linalg.norm(rows, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    left, left_of_dwells = rows[:, -1], of_dwells[:, -1]
    basis, singular, right = np.linalg.svd(rows[:, :-1] / scale[:-1], full_matrices=False)
    seen = singular > ROUNDING
    basis, of_basis = basis[:, seen], (of_dwells[:, :-1] / scale[:-1]) @ (right[seen].T / singular[seen])
    for _ in range(2):  # projecting twice removes the rounding errors of large components
        share = basis.T @ left
        left, left_of_dwells = left - basis @ share, left_of_dwells - of_basis @ share
    return of_basis, left_of_dwells


class _Path:
    """The random walk of the biases as unknowns of each dwell (D, 6): the path a from the beginning of the run to that
    of the dwell, and the step s within it.

    ``rows`` and the walk's own variances determine their precision matrix, which is kept as a banded Cholesky factor.
    """

    def __init__(self, rows: Floats, ends: list[int], steps: Floats) -> None:
        from scipy.linalg import cholesky_banded

        self._unit, self._ends = float(np.sqrt(steps.max())), ends
        inside, biases = rows[:, :3], rows[:, 3:][:, BIASES]
        self._columns = self._unit * np.concatenate([biases, inside + biases], axis=1)
        self._columns[: ends[1], :3] = 0.0  # the path begins with the first dwell
        self._root = cholesky_banded(self._bands(steps / self._unit**2), lower=True)

    def products(self, columns: NDArray[Any]) -> NDArray[Any]:
        """Products (6 D, c) of the path's columns with columns (m, c)."""
        return np.concatenate([self._columns[part].T @ columns[part] for part in _parts(self._ends)])

    def whitened(self, sides: Floats) -> Floats:
        """Products (6 D, c) multiplied by the inverse of the Cholesky factor."""
        from scipy.linalg import get_lapack_funcs

        solve: Any = get_lapack_funcs("tbtrs", dtype=np.float64)  # solve_banded ignores triangularity
        return solve(self._root, np.asfortranarray(sides), uplo="L")[0]

    def freed(self, columns: Floats) -> Floats:
        """Columns (m, c) with the part that the path explains removed."""
        from scipy.linalg import cho_solve_banded

        paths = np.asarray(cho_solve_banded((self._root, True), self.products(columns)), float).reshape(
            len(self._ends) - 1, 6, -1
        )
        rest = columns.copy()
        for part, way in zip(_parts(self._ends), paths, strict=True):
            rest[part] -= self._columns[part] @ way
        return rest

    def _bands(self, steps: Floats) -> Floats:
        """Return the precision as bands (7, 6 D).

        The step s within a dwell has the variances ``steps[:, 1]``. The next a is a + s plus the step in the pause, of
        variances ``steps[:, 0]``.
        """
        count = len(steps)
        bands = np.zeros((7, count, 6))
        for k, part in enumerate(_parts(self._ends)):
            own = self._columns[part].T @ self._columns[part]
            for apart in range(6):
                bands[apart, k, : 6 - apart] = np.diag(own, -apart)
        within, pauses = 1.0 / steps[:, 1], 1.0 / np.maximum(steps[1:, 0], SEEN)
        bands[0, :, 3:] += within
        bands[0, 0, :3] += 1.0  # the first a is fixed at zero; 1 keeps the matrix regular
        bands[0, 1:, :3] += pauses
        bands[0, 1:-1, :3] += pauses[1:]
        bands[0, :-1, 3:] += pauses
        bands[3, 1:-1, :3] += pauses[1:]  # a and s of one dwell, whose sum leads to the next a
        bands[3, :-1, 3:] -= pauses  # s and the next a
        bands[6, 1:-1, :3] -= pauses[1:]  # a and the next a
        return bands.reshape(7, -1)


def _waves(linearised: LinearisedDwells, noise: Noise, kinds: Sequence[Effect]) -> tuple[Waves, list[int], Floats]:
    """Return the whitened columns (m, points, 3) of oscillations, where the rows of each dwell begin and end, and the
    rows [S | H] (m, s + 12) of the twelve, in which the biases walk if they do."""
    dwells, state, bench = linearised.dwells_at_state, linearised.state, linearised.model.bench
    twelve, judging = of_all_pieces(linearised.columns)[..., :STATE_COUNT], noise.with_scatter_as_flicker(len(dwells))
    width, rows = noise.walk.steps + STATE_COUNT, list[Floats]()
    for _, some, pieces, nodes in few_at_a_time(dwells, stimulus_of(dwells, bench, state), 6 * len(kinds)):
        values = candidate_columns(some, kinds, bench, state, nodes).values
        columns = OfPieces(np.concatenate([twelve[pieces], values], axis=3), some.folded.ends)
        rows += whitened_rows.whiten(some, columns, judging, state, reduced=False)
    stacked = np.concatenate(rows)
    parts = stacked[:, width:-1].reshape(len(stacked), len(kinds), 3, 2)
    return parts[..., 1] + 1j * parts[..., 0], np.cumsum([0, *map(len, rows)]).tolist(), stacked[:, :width]


def _parts(ends: list[int]) -> list[slice]:
    """Return the slice of rows of each dwell."""
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def _points(values_hz: Floats, longest_s: float) -> tuple[Floats, Floats]:
    """Return Chebyshev points (k,) of a band and the weights (N, k) that interpolate from them to ``values_hz``.

    If there are no more values than points, the points are the values. Products of two columns pass through twice the
    phase that a dwell of ``longest_s`` does, which determines the number of points.
    """
    low, high = float(values_hz.min()), float(values_hz.max())
    count = int(np.ceil(np.pi * (high - low) * longest_s)) + _SPARE
    if count >= len(values_hz):
        return values_hz, np.eye(len(values_hz))
    angles = (np.arange(count) + 0.5) * np.pi / count
    at = np.arccos(np.clip((2.0 * values_hz - low - high) / (high - low), -1.0, 1.0))
    orders = np.arange(count)
    values, points = np.cos(np.outer(at, orders)), np.cos(np.outer(orders, angles))
    shares = 2.0 / count * values @ points - 1.0 / count
    return 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angles), shares
