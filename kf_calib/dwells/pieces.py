"""The pieces of a dwell. In a dwell of hours neighbouring pieces are merged, and in a run of days those of its closed
dwells, so that memory is bounded.

The parabola over two pieces together is, on either piece, a linear combination of that piece's basis. Two triangles are
therefore merged exactly. Only the model's columns become coarser: each was one parabola per piece and is one over both.
Pieces shortly after the arrival stay short, since a merged piece is never longer than the time since the arrival.

``OfPieces`` has the values at the nodes of all pieces of all dwells in one array, which is also a sequence by dwell.

A random walk of the biases moves all pieces of a dwell. The bias is b(t) = b(t_0) + W(t), where W is a Brownian
path of intensity q (m/s^2 per sqrt(s)) that steps from reading to reading. Of each piece, the coefficients of a
parabola are kept; the covariance of those of W is known in closed form. The filter's bias is the one at the end of a
dwell. Therefore the rows of a dwell begin with columns for the step s that the biases take within it; given s, the path
within the dwell is independent of all other dwells. The deviation of W from the parabolas is not used and is subtracted
from the noise of a reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import ComputedSequence, Floats
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.rows import Nodes, basis, on_basis, parabola

MOST_PIECES = 256
"""Pieces of a dwell, at most; at 3 kHz as many last almost six minutes."""
_MERGED_PIECES = MOST_PIECES // 4  # pieces after merging; at most twice as many
MOST_RUN_PIECES = 2048
"""Pieces of all dwells of a run, beyond which those of long dwells are merged; dwells of an hour have 70 each."""
FEWEST_PIECES = 16
"""Dwells of no more pieces are left as they are: so many have lengths that double from 1 s to hours."""


@dataclass(frozen=True)
class Piece:
    """One piece of a dwell.

    - triangle (K + 3, K + 3): the triangular factor of [1 u u^2 ... | z1 z2 z3].
    - nodes: the conditions at its three nodes.
    - count: number of readings, or of averages of them, that were folded.
    - carrier_hz: frequency of the carrier; 0 for none.
    - reading_count: number of readings that ``count`` stands for.
    """

    triangle: Floats
    nodes: Nodes
    count: int
    carrier_hz: float = 0.0
    reading_count: int = 0


def coarsened(pieces: Sequence[Piece], count: int = _MERGED_PIECES) -> tuple[Piece, ...]:
    """Pieces in order of time, merged to at most twice ``count`` and those shortly after the arrival."""
    begin, end = pieces[0].nodes.elapsed_s[0], pieces[-1].nodes.elapsed_s[-1]
    return tuple(merged_piece(group) for group in _groups(pieces, float(end - begin) / count))


def _groups(pieces: Sequence[Piece], longest_s: float) -> Iterator[list[Piece]]:
    """Yield neighbours that together last no longer than ``longest_s``, nor than it is since the arrival."""
    group = [pieces[0]]
    for piece in pieces[1:]:
        first = group[0].nodes
        length_s = piece.nodes.elapsed_s[-1] - first.elapsed_s[0]
        if length_s > min(longest_s, first.since_arrival_s[0]):
            yield group
            group = []
        group.append(piece)
    yield group


def merged_piece(pieces: Sequence[Piece]) -> Piece:
    """One piece of consecutive ones."""
    if len(pieces) == 1:
        return pieces[0]
    begin, end = pieces[0].nodes.elapsed_s[0], pieces[-1].nodes.elapsed_s[-1]
    middle, half = 0.5 * (begin + end), max(0.5 * float(end - begin), 1e-9)
    width = pieces[0].triangle.shape[1] - 3
    stacked = np.vstack([_on_longer_basis(piece, middle, half, width) for piece in pieces])
    return replace(
        pieces[0], triangle=triangle(stacked), nodes=_nodes(pieces, np.array([begin, middle, end])),
        count=sum(piece.count for piece in pieces), reading_count=sum(piece.reading_count for piece in pieces),
    )  # fmt: skip


def _centre(nodes: Nodes) -> tuple[float, float]:
    """The middle of a piece, and half of its length."""
    return float(nodes.elapsed_s[1]), max(0.5 * float(nodes.elapsed_s[-1] - nodes.elapsed_s[0]), 1e-9)


def _on_longer_basis(piece: Piece, middle: float, half: float, width: int) -> Floats:
    """The triangle of a piece on the basis of a longer one: U = shift + share u, so 1, U, U^2 follow from 1, u, u^2."""
    piece_middle, piece_half = _centre(piece.nodes)
    shift, share = (piece_middle - middle) / half, piece_half / half
    change_of_basis = np.array([[1.0, shift, shift**2], [0.0, share, 2.0 * shift * share], [0.0, 0.0, share**2]])
    lengthened = piece.triangle.copy()
    for first in range(0, width, 3):  # on a carrier its cosine and sine have the same three
        lengthened[:, first : first + 3] = piece.triangle[:, first : first + 3] @ change_of_basis
    return lengthened


def _nodes(pieces: Sequence[Piece], at_s: Floats) -> Nodes:
    """The conditions at the beginning, the middle and the end of consecutive pieces."""
    first, last = pieces[0].nodes, pieces[-1].nodes
    amid = next(piece.nodes for piece in pieces if piece.nodes.elapsed_s[-1] >= at_s[1])
    centre, half = _centre(amid)
    functions = basis(np.array([max((at_s[1] - centre) / half, -1.0)]))[:, 0]  # -1: in a gap, the piece after it

    def node_values(name: str) -> Floats | None:
        values = getattr(amid, name)
        if values is None:
            return None
        between = functions @ parabola(values.reshape(3, -1))
        return np.array([getattr(first, name)[0], between.reshape(values.shape[1:]), getattr(last, name)[-1]])

    since_s = at_s - first.elapsed_s[0] + first.since_arrival_s[0]
    force, pose, warmth = node_values("force_mps2"), node_values("pose"), node_values("temperature_c")
    assert force is not None and pose is not None and warmth is not None
    return Nodes(at_s, since_s, force, pose, warmth, node_values("rate_radps"), node_values("rate_change_radps2"),
                 node_values("variance_mps2_2"))  # fmt: skip


PieceIndices = NDArray[np.intp]


class OfPieces(ComputedSequence[Floats]):
    """Values of the pieces of all dwells, or whitened rows, in one array (pieces, ...), as a sequence of those of each
    dwell; objects a dwell would take as much memory as the numbers."""

    def __init__(self, values: Floats, ends: PieceIndices) -> None:
        self.values, self._ends = values, ends

    def __len__(self) -> int:
        return len(self._ends) - 1

    def item(self, k: int) -> Floats:
        """The values of the pieces of one dwell."""
        return self.values[self._ends[k] : self._ends[k + 1]]

    def beside(self, *others: Sequence[Floats]) -> OfPieces:
        """The same columns (pieces, K, 3, c) with others behind them."""
        return OfPieces(np.concatenate([self.values, *map(of_all_pieces, others)], axis=3), self._ends)

    def first(self, count: int) -> OfPieces:
        """The first columns alone."""
        return OfPieces(self.values[..., :count], self._ends)


def of_all_pieces(columns: Sequence[Floats]) -> Floats:
    """The values of the pieces, or the rows, of all dwells in one array (pieces, ...)."""
    return columns.values if isinstance(columns, OfPieces) else np.concatenate(columns)


def basis_values(columns: Floats) -> Floats:
    """Coefficients (..., K, 3 c) on the basis functions of columns (..., K, 3, c) given at the nodes."""
    return on_basis(columns.reshape(*columns.shape[:-2], -1))


_LEAST = 1e-12  # relative to the largest variance; smaller modes are rounding


@dataclass(frozen=True)
class WalkPath:
    """The effect of a random walk of intensity q = 1 on the r rows of a dwell's triangles.

    - step (r,): the change of the rows per unit of the bias's step s over the dwell, for a given bias at its end.
    - modes (r, k), variances (k,): principal axes of the remaining covariance, given s.
    - about_parabola (pieces,): the contribution of W to the sums of squares about the parabolas.
    """

    step: Floats
    modes: Floats
    variances: Floats
    about_parabola: Floats

    def whiten(self, rows: Floats, ratio: float) -> Floats:
        """Rows (r, c) of unit noise multiplied by V^(-1/2), where V = I + ``ratio``^2 sum of variances times modes
        modes^T."""
        shrink = 1.0 - 1.0 / np.sqrt(1.0 + ratio**2 * self.variances)
        return rows - self.modes @ (shrink[:, None] * (self.modes.T @ rows))


def walk_path_of(begins_s: Floats, ends_s: Floats, counts: Sequence[int], triangles: Floats) -> WalkPath:
    """The effect for a dwell with the given pieces.

    - begins_s, ends_s (pieces,): first and last time of each piece; counts: their numbers of readings.
    - triangles (pieces, K, K): triangular factors over the basis [1 u u^2 ...].
    """
    root, end = _root(begins_s, ends_s, counts)
    onto = (triangles[:, :, :3] @ root).reshape(-1, root.shape[2])
    total = float(end @ end)
    share = onto @ end / total if total > 0 else np.zeros(len(onto))
    axes, sizes, _ = np.linalg.svd(onto - np.outer(share, end), full_matrices=False)
    significant = sizes**2 > _LEAST * max(float(sizes[0]) ** 2, 1e-300)
    spans = np.maximum(ends_s - begins_s, 0.0)
    about_parabola = spans * np.array([_moments(count)[1] / max(count - 1, 1) for count in counts])
    return WalkPath(share - triangles[:, :, 0].ravel(), axes[:, significant], sizes[significant] ** 2, about_parabola)


def _root(begins_s: Floats, ends_s: Floats, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Return W as a linear function of n independent unit normals: its parabolas' coefficients (pieces, 3, n) and its
    last value (n,).

    There are four normals for each piece: three for the coefficients of its parabola and one for the value of W when
    the next piece begins.
    """
    size = len(counts)
    pauses = np.maximum(np.append(begins_s[1:] - ends_s[:-1], 0.0), 0.0)
    coefficients, level = np.zeros((size, 3, 4 * size)), np.zeros(4 * size)
    for k, count in enumerate(counts):
        normals = slice(4 * k, 4 * k + 4)
        joint = _moments(count)[0] * max(ends_s[k] - begins_s[k], 0.0) / max(count - 1, 1)
        joint[3, 3] += pauses[k]
        values, vectors = np.linalg.eigh(joint)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        coefficients[k, 0] = level
        coefficients[k, :, normals] = root[:3]
        level[normals] = root[3]
    return coefficients, level


_MANY = 1 << 14
"""Readings of a piece above which the moments of a walk are those of a continuous one, to 1e-4 of them."""


@lru_cache(maxsize=4096)
def _moments(count: int) -> tuple[Floats, float]:
    """Return moments of a walk with unit steps over ``count`` readings that begins at zero.

    They are the covariance (4, 4) of the coefficients of its parabola on 1, u, u^2 and of its last value, and the mean
    sum of squares about the parabola.
    """
    if count > _MANY:  # of so many readings, it grows with their number, and the mean square with that of its square
        covariance, squares = _moments(_MANY)
        return covariance * (count / _MANY), squares * (count / _MANY) ** 2
    u = np.linspace(-1.0, 1.0, count)
    design = np.column_stack([np.ones(count), u, u * u]) if count > 1 else np.array([[1.0, 0.0, 0.0]])
    last = np.zeros((count, 1))
    last[-1] = 1.0
    weights = np.hstack([np.linalg.pinv(design).T, last])
    later = np.cumsum(weights[::-1], axis=0)[::-1][1:]  # each step moves all later readings
    covariance = later.T @ later
    inside = float(np.trace(design.T @ design @ covariance[:3, :3]))
    return covariance, max(0.5 * count * (count - 1) - inside, 0.0)


def lagged_walk_products(period_s: float, size: int, pairs: Floats) -> Floats:
    """Contribution of a walk of intensity q = 1 to the sums of lagged products (L + 1,) about the parabolas of blocks
    of ``size`` readings.

    The residual has its mean square at lag 0 and loses half of q^2 times the lag, as the walk itself does. ``pairs`` (L
    + 1,) are the numbers of products.
    """
    return period_s * pairs * np.maximum(_moments(size)[1] / size - 0.5 * np.arange(len(pairs)), 0.0)
