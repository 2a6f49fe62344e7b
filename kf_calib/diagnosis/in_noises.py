"""All columns of a run in noise of one kind and of all its sizes at once.

Noise of size s beyond what was stated has the covariance I + s^2 S in a dwell, S = U diag(l) U^T. With the rows of the
dwell turned by U^T, each has the weight w = 1 / (1 + s^2 l), so that the products of two columns g and h in K sizes are
(g h) W, with the products (r,) of their rows and the weights W (r, K). What the model explains is subtracted,

  G^T W G - G^T W Q (Q^T W Q)^-1 Q^T W G

with Q, what the model spans. Columns and readings have nothing of it in the noise that was stated, so that what is
subtracted in any other is little, and rounding does not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import IN_CACHE, Floats, Indices, Singles, portions
from kf_calib.estimation.candidate_scan import SEEN

ROUNDING = 1e-10
"""Share of the square of a column below which what the model, or other columns, leave of it is rounding."""

_OF_CHI_SQUARED = 1e-13  # the same for each unit of chi-squared, of which a direction would gain what is rounding
_LOST = 1e-3  # share of what all dwells determine of the model, below which some of them determine nothing


@dataclass(frozen=True)
class Spanned:
    """Rows of all dwells, whitened by what was stated: basis (D, 3, k) of what the model spans, columns (D, 3, C) and
    readings (D, 3) off it; the same of rows that are the same in all noise, (r, k), (r, C) and (r,). log: of the
    density, with the model integrated out, but for chi-squared. Columns have seven digits where that is enough, as
    they are most of the memory; their products have sixteen."""

    basis: Floats
    columns: Floats | Singles
    readings: Floats
    more_basis: Floats
    more_columns: Floats
    more_readings: Floats
    log: float

    def __len__(self) -> int:
        return len(self.basis)

    def beside(self, places: Indices, lengths: Floats) -> Spanned:
        """The rows with some of the columns in the model, without any others; lengths (C,): of the columns before what
        the model spans was subtracted from them."""
        columns, more, lengths = self.columns[..., places], self.more_columns[:, places], lengths[places]
        count = columns.shape[0] * columns.shape[1]
        scaled = np.vstack([columns.reshape(count, len(places)), more]) / np.where(lengths > 0.0, lengths, 1.0)
        left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
        left = left[:, singular > SEEN]
        of_means, of_more = left[:count].reshape(*columns.shape[:2], left.shape[1]), left[count:]
        along = np.tensordot(of_means, self.readings, axes=((0, 1), (0, 1))) + of_more.T @ self.more_readings
        return Spanned(
            np.concatenate([self.basis, of_means], axis=2), columns[..., :0], self.readings - of_means @ along,
            np.hstack([self.more_basis, of_more]), more[:, :0], self.more_readings - of_more @ along, self.log,
        )  # fmt: skip

    def turned(self, dwells: slice, turns: Floats) -> Floats:
        """Rows [Q G z] (r, k + C + 1) of some dwells, turned by U^T, U (D, 3, 3)."""
        parts = [self.basis[dwells], self.columns[dwells], self.readings[dwells, :, None]]
        rows = np.swapaxes(turns[dwells], 1, 2) @ np.concatenate(parts, axis=2)
        return rows.reshape(-1, rows.shape[2])

    @property
    def more(self) -> Floats:
        """Rows [Q G z] (r, k + C + 1) that are the same in all noise."""
        return np.column_stack([self.more_basis, self.more_columns, self.more_readings])


class InNoises:
    """The products of columns in noise of one kind and K sizes.

    rows: of the run. shapes (D, 3, 3): covariances of unit size, in units of what was stated. squares (K,): of sizes.
    groups: columns (n, q) of the terms of each group.

    - logs (K,): log of the restricted likelihood without any term.
    - along (K, C): G^T W z, projected off the model.
    - rounding (K,): share of the square of a column below which what other columns leave of it is rounding.
    - lengths: of each group, the largest squares (K, n) of columns that were not projected.
    """

    def __init__(self, rows: Spanned, shapes: Floats, squares: Floats, groups: Sequence[Indices] = ()) -> None:
        values, self._turns = np.linalg.eigh(shapes)
        self._rows, self._weights = rows, 1.0 / (1.0 + squares[:, None, None] * np.maximum(values, 0.0))
        self._spanned = rows.basis.shape[2]
        left = [*range(self._spanned), -1]
        sums = [np.zeros((len(squares), len(group), group.shape[1] * (group.shape[1] + 1) // 2)) for group in groups]
        count, width = len(squares), self._spanned + rows.columns.shape[2] + 1
        products = np.zeros((count, self._spanned + 1, width))
        for part in self._parts():
            turned, weights = rows.turned(part, self._turns), self._of_rows(part)
            products += _products(turned[:, left], turned, weights)
            columns = np.ascontiguousarray(turned[:, self._spanned : -1].T)
            for group, summed in zip(groups, sums, strict=True):
                _add_products(columns, group, weights, summed)
        more = rows.more
        products += more[:, left].T @ more
        self._inverse = np.linalg.inv(np.linalg.cholesky(products[:, :-1, : self._spanned]))
        self._off = self._inverse @ products[:, :-1, self._spanned :]  # (K, k, C + 1)
        rest = products[:, -1, self._spanned :] - np.einsum("kpc,kp->kc", self._off, self._off[:, :, -1])
        self.along, chi2 = rest[:, :-1], rest[:, -1]
        self.rounding = np.maximum(ROUNDING, _OF_CHI_SQUARED * chi2)
        log_model = np.log(np.einsum("kpp->kp", self._inverse)).sum(axis=1)
        self.logs = rows.log + 0.5 * np.log(self._weights).sum(axis=(1, 2)) + log_model - 0.5 * chi2
        self._groups, self._products = groups, sums
        self.lengths = [self._project(group, summed) for group, summed in zip(groups, sums, strict=True)]

    def _project(self, group: Indices, sums: Floats) -> Floats:
        """Project the sums (K, n, pairs) of the products of a group, and return the largest squares (K, n) before."""
        first, second = np.triu_indices(group.shape[1])
        most = max(8 * IN_CACHE // max(len(self._rows.more_columns) * group.shape[1], 1), 1)
        for few in portions(len(group), most):
            more = np.swapaxes(self._rows.more_columns.T[group[few]], 1, 2)
            sums[:, few] += (np.swapaxes(more, 1, 2) @ more)[:, first, second]
        lengths = sums[..., first == second].max(axis=2)
        for of_size, off in zip(sums, self._off, strict=True):
            along = np.swapaxes(off.T[group], 1, 2)  # (n, k, q)
            of_size -= (np.swapaxes(along, 1, 2) @ along)[:, first, second]
        return lengths

    def gram(self, number: int, sizes: Indices, which: Indices) -> Floats:
        """G^T W G (K, n, q, q) of some of a group's terms, projected off the model, in some of the sizes."""
        width = self._groups[number].shape[1]
        first, second = np.triu_indices(width)
        gram = np.empty((len(sizes), len(which), width, width))
        gram[..., first, second] = gram[..., second, first] = self._products[number][sizes[:, None], which]
        return gram

    def __len__(self) -> int:
        return len(self.logs)

    def dwells(self, rows: Spanned, without: Sequence[int], sizes: slice) -> tuple[Floats, Floats, Floats]:
        """G^T W G (K, D, 3, 3) and G^T W z (K, D, 3) of offsets of the three accelerometers in one dwell, as the others
        tell, without some of them, in some of the sizes; and the largest squares (K, D) of what was not projected.

        rows: of the run, with or without columns that are in the model. Raises LinAlgError where the other dwells do
        not determine it.
        """
        kept = np.ones((len(rows), 1, 1))
        kept[list(without)] = 0.0
        weights = self._turns @ (self._weights[sizes, ..., None] * np.swapaxes(self._turns, 1, 2))
        weighted, more = weights @ rows.basis, rows.more_basis.T @ rows.more_basis
        lower = np.linalg.cholesky(_summed(rows.basis * kept, weighted) + more)
        whole = np.linalg.cholesky(_summed(rows.basis, weighted) + more) if len(without) else lower
        if np.min(np.einsum("kpp->kp", lower) / np.einsum("kpp->kp", whole)) < _LOST:
            raise np.linalg.LinAlgError("the others do not determine the model")
        inverse = np.linalg.inv(lower)
        along = _summed(rows.readings[..., None] * kept, weighted)[:, 0] + rows.more_basis.T @ rows.more_readings
        states = np.swapaxes(inverse, 1, 2) @ (inverse @ along[..., None])
        left = (rows.readings[..., None] - rows.basis @ states[:, None]) * kept
        off = inverse[:, None] @ np.swapaxes(weighted * kept, 2, 3)
        gram, largest = weights - np.swapaxes(off, 2, 3) @ off, np.einsum("kdii->kdi", weights).max(axis=2)
        return gram, (weights @ left)[..., 0], largest

    def explained_by(self, groups: Sequence[Indices], sizes: Sequence[int]) -> list[Floats]:
        """What the columns (q,) of each group explain of all columns and of the readings, (K, q, C + 1) in K of the
        sizes: products with an orthonormal basis of those columns that the model leaves, filled up with zeros. It has
        more directions than ``rounding`` leaves to a term: none of them is gained beside the group once more."""
        places, chosen = np.concatenate(groups), np.array(sizes, np.intp)
        columns = self._spanned + places
        products = np.zeros((len(chosen), len(places), self._rows.columns.shape[2] + 1))
        for part in self._parts():
            turned, weights = self._rows.turned(part, self._turns), self._of_rows(part)[chosen]
            products += _products(turned[:, columns], turned[:, self._spanned :], weights)
        more = self._rows.more
        products += more[:, columns].T @ more[:, self._spanned :]
        lengths = np.diagonal(products[:, :, places], axis1=1, axis2=2).copy()
        products -= np.swapaxes(self._off[chosen][:, :, places], 1, 2) @ self._off[chosen]
        ends = np.cumsum([0, *map(len, groups)])
        parts = zip(groups, ends[:-1].tolist(), ends[1:].tolist(), strict=True)
        return [_explained(products[:, a:b], group, lengths[:, a:b]) for group, a, b in parts]

    def _parts(self) -> Iterator[slice]:
        """Return few dwells at a time."""
        widest = max(self._rows.columns.shape[2], len(self._weights) * self._spanned) + 1
        most = max(8 * IN_CACHE // (3 * widest), 1)
        return portions(len(self._rows), most)

    def _of_rows(self, part: slice) -> Floats:
        """Return the weights (K, r) of the rows of some dwells."""
        return self._weights[:, part].reshape(len(self._weights), -1)


def _summed(some: Floats, others: Floats) -> Floats:
    """Return the products (K, m, n), summed over all rows, of columns (D, 3, m) with others (K, D, 3, n)."""
    return some.reshape(-1, some.shape[2]).T @ others.reshape(len(others), -1, others.shape[3])


def _products(some: Floats, others: Floats, weights: Floats) -> Floats:
    """Return the products (K, m, n) of columns (r, m) with others (r, n) in all weights (K, r)."""
    weighted = (weights[:, None] * some.T).reshape(-1, len(some))
    return (weighted @ others).reshape(len(weights), some.shape[1], -1)


def _add_products(columns: Floats, group: Indices, weights: Floats, sums: Floats) -> None:
    """Add to sums (K, n, pairs) the products of columns (C, r) of a group in all weights (K, r)."""
    first, second = np.triu_indices(group.shape[1])
    most = max(8 * IN_CACHE // (len(first) * columns.shape[1]), 1)
    for part in portions(len(group), most):
        few = columns[group[part]]
        products = few[:, first] * few[:, second]
        summed = products.reshape(-1, columns.shape[1]) @ weights.T
        sums[:, part] += np.moveaxis(summed.reshape(*products.shape[:2], -1), 2, 0)


def _explained(products: Floats, group: Indices, lengths: Floats) -> Floats:
    """Return what columns explain, (K, q, C + 1), from their products (K, q, C + 1) with all, and with themselves
    (K, q) before the model's part was subtracted."""
    scales = 1.0 / np.sqrt(np.maximum(lengths, 1e-300))
    values, vectors = np.linalg.eigh(scales[..., None] * products[..., group] * scales[:, None])
    inverse = np.where(values > ROUNDING, 1.0 / np.sqrt(np.maximum(values, ROUNDING)), 0.0)
    return np.swapaxes(vectors * inverse[:, None], 1, 2) @ (scales[..., None] * products)
