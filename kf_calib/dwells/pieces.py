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

import numpy as np

from kf_calib.bench.arrays import LAST_DIGITS, ComputedSequence, Floats, Indices, Ints
from kf_calib.dwells.limits import CURVE
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.rows import Nodes, basis, on_basis, parabola

MOST_PIECES = 256
"""Pieces of a dwell, at most; at 3 kHz as many last almost six minutes."""
_MERGED_PIECES = MOST_PIECES // 4  # pieces after merging; at most twice as many
MOST_RUN_PIECES = 2048
"""Pieces of all dwells of a run, beyond which those of long dwells are merged; dwells of an hour have 70 each."""
MOST_SLEW_PIECES = 1 << 15
"""Pieces of all slews of a run, beyond which every second slew is left out: 300 slews of 20 s have as many."""
FEWEST_PIECES = 16
"""Dwells of no more pieces are left as they are: so many have lengths that double from 1 s to hours."""
_NODES = np.arange(CURVE)  # of a piece


@dataclass(frozen=True, eq=False, repr=False)
class Pieces:
    """Pieces in order of time.

    - triangles (P, K + 3, K + 3): the triangular factors of [1 u u^2 ... | z1 z2 z3].
    - nodes: the conditions at the 3 P nodes, three of each piece.
    - counts (P,): numbers of readings, or of averages of them, that were folded.
    - reading_counts (P,): numbers of readings that these stand for.
    - carrier_hz: frequency of the carrier; 0 for none.
    """

    triangles: Floats
    nodes: Nodes
    counts: Ints
    reading_counts: Ints
    carrier_hz: float = 0.0

    @classmethod
    def joined(cls, some: Sequence[Pieces]) -> Pieces:
        """The pieces of several dwells, or blocks, one after another."""
        return cls(
            np.concatenate([each.triangles for each in some]), Nodes.joined([each.nodes for each in some]),
            np.concatenate([each.counts for each in some]), np.concatenate([each.reading_counts for each in some]),
            some[0].carrier_hz,
        )  # fmt: skip

    @property
    def averaged(self) -> bool:
        """Whether averages of readings were folded instead of the readings themselves."""
        return self.nodes.variance_mps2_2 is not None

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, part: slice | Indices) -> Pieces:
        at = np.arange(len(self))[part]
        nodes = (3 * at[:, None] + _NODES).ravel()
        return replace(
            self, triangles=self.triangles[part], nodes=self.nodes[nodes], counts=self.counts[part],
            reading_counts=self.reading_counts[part],
        )  # fmt: skip

    @property
    def width(self) -> int:
        """The number K of basis functions."""
        return self.triangles.shape[1] - 3

    @property
    def spans_s(self) -> Floats:
        """When each piece begins and ends, (P, 2)."""
        return self.nodes.elapsed_s.reshape(-1, 3)[:, [0, 2]]

    @property
    def means(self) -> Floats:
        """Means (P, 7) of the regressors 1, f_x, f_y, f_z and of the three readings over each piece."""
        functions = self.triangles[:, 0] / self.triangles[:, :1, 0]  # means of the basis, then of the readings
        means = np.ones((len(self), 7))
        means[:, 1:4] = (functions[:, None, :3] @ parabola(self.nodes.force_mps2.reshape(-1, 3, 3)))[:, 0]
        means[:, 4:] = functions[:, self.width :]
        return means

    def plus(self, coefficients: Floats) -> Floats:
        """The triangles with readings plus what has these coefficients (P, K, 3) on the basis functions."""
        width, triangles = self.width, self.triangles.copy()
        triangles[:, :width, width:] += triangles[:, :width, :width] @ coefficients
        return triangles


def coarsened(pieces: Pieces, count: int = _MERGED_PIECES) -> Pieces:
    """Pieces in order of time, merged to at most twice ``count`` and those shortly after the arrival."""
    spans_s = pieces.spans_s
    longest_s = float(spans_s[-1, 1] - spans_s[0, 0]) / count
    return Pieces.joined([merged_piece(pieces[part]) for part in _groups(pieces, longest_s)])


def _groups(pieces: Pieces, longest_s: float) -> Iterator[slice]:
    """Yield neighbours that together last no longer than ``longest_s``, nor than it is since the arrival."""
    (begins_s, ends_s), since_s = pieces.spans_s.T.tolist(), pieces.nodes.since_arrival_s[::3].tolist()
    first = 0
    for k in range(1, len(pieces)):
        if ends_s[k] - begins_s[first] > min(longest_s, since_s[first]):
            yield slice(first, k)
            first = k
    yield slice(first, len(pieces))


def merged_piece(pieces: Pieces) -> Pieces:
    """One piece of consecutive ones."""
    if len(pieces) == 1:
        return pieces
    begin, end = pieces.nodes.elapsed_s[[0, -1]]
    middle, half = 0.5 * (begin + end), max(0.5 * float(end - begin), 1e-9)
    stacked = np.vstack([_on_longer_basis(pieces[k : k + 1], middle, half) for k in range(len(pieces))])
    return replace(
        pieces, triangles=triangle(stacked)[None], nodes=_nodes(pieces, np.array([begin, middle, end])),
        counts=pieces.counts.sum(keepdims=True), reading_counts=pieces.reading_counts.sum(keepdims=True),
    )  # fmt: skip


def _centre(nodes: Nodes) -> tuple[float, float]:
    """The middle of a piece, and half of its length."""
    return float(nodes.elapsed_s[1]), max(0.5 * float(nodes.elapsed_s[-1] - nodes.elapsed_s[0]), 1e-9)


def _on_longer_basis(piece: Pieces, middle: float, half: float) -> Floats:
    """The triangle of a piece on the basis of a longer one: U = shift + share u, so 1, U, U^2 follow from 1, u, u^2."""
    piece_middle, piece_half = _centre(piece.nodes)
    shift, share = (piece_middle - middle) / half, piece_half / half
    change_of_basis = np.array([[1.0, shift, shift**2], [0.0, share, 2.0 * shift * share], [0.0, 0.0, share**2]])
    lengthened = piece.triangles[0].copy()
    for first in range(0, piece.width, 3):  # on a carrier its cosine and sine have the same three
        lengthened[:, first : first + 3] = lengthened[:, first : first + 3] @ change_of_basis
    return lengthened


def _nodes(pieces: Pieces, at_s: Floats) -> Nodes:
    """The conditions at the beginning, the middle and the end of consecutive pieces."""
    k, nodes = int(np.argmax(pieces.spans_s[:, 1] >= at_s[1])), pieces.nodes
    amid = nodes[3 * k : 3 * k + 3]
    centre, half = _centre(amid)
    functions = basis(np.array([max((at_s[1] - centre) / half, -1.0)]))[:, 0]  # -1: in a gap, the piece after it

    def node_values(name: str) -> Floats | None:
        values = getattr(amid, name)
        if values is None:
            return None
        between = functions @ parabola(values.reshape(3, -1))
        at_all = getattr(nodes, name)
        return np.array([at_all[0], between.reshape(values.shape[1:]), at_all[-1]])

    since_s = at_s - nodes.elapsed_s[0] + nodes.since_arrival_s[0]
    force, pose, warmth = node_values("force_mps2"), node_values("pose"), node_values("temperature_c")
    assert force is not None and pose is not None and warmth is not None
    return Nodes(at_s, since_s, force, pose, warmth, node_values("rate_radps"), node_values("rate_change_radps2"),
                 node_values("variance_mps2_2"))  # fmt: skip


class OfPieces(ComputedSequence[Floats]):
    """Values of the pieces of all dwells, or whitened rows, in one array (pieces, ...), as a sequence of those of each
    dwell; objects a dwell would take as much memory as the numbers."""

    def __init__(self, values: Floats, ends: Indices) -> None:
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


def basis_coefficients(columns: Floats) -> Floats:
    """Coefficients (..., K, 3 c) on the basis functions of columns (..., K, 3, c) given at the nodes."""
    return on_basis(columns.reshape(*columns.shape[:-2], -1))


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
    significant = sizes**2 > LAST_DIGITS * max(float(sizes[0]) ** 2, 1e-300)
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


def _moments(count: int) -> tuple[Floats, float]:
    """Return moments of a walk with unit steps over ``count`` readings that begins at zero.

    They are the covariance (4, 4) of the coefficients of its least-squares parabola on 1, u, u^2 and of its last value,
    and the sum of squares about the parabola, 3 (n^2 - 9) / 70: sums over the covariance min(i, j) of the values.
    """
    n = float(count)
    if count < CURVE:  # one reading, or the line through two
        line = np.array([0.5, 0.5, 0.0, 1.0])
        return (n - 1.0) * np.outer(line, line), 0.0
    whole = 56.0 * n * (n**2 - 4.0)
    level, bend = (25.0 * n**3 - 3.0 * n**2 - 85.0 * n + 27.0) / whole, -3.0 * (n - 1.0) * (4.0 * n**2 - 1.0) / whole
    slope, square = 0.3 * (n**2 + 1.0) / (n * (n + 1.0)), 15.0 * (n - 1.0) ** 2 * (n**2 + 5.0) / (whole * (n + 1.0))
    covariance = [[level, 0.25, bend, 0.5], [0.25, slope, 0.0, 0.5], [bend, 0.0, square, 0.0], [0.5, 0.5, 0.0, 1.0]]
    return (n - 1.0) * np.array(covariance), 3.0 * (n**2 - 9.0) / 70.0


def lagged_walk_products(period_s: float, size: int, pairs: Floats) -> Floats:
    """Contribution of a walk of intensity q = 1 to the sums of lagged products (L + 1,) about the parabolas of blocks
    of ``size`` readings.

    The residual has its mean square at lag 0 and loses half of q^2 times the lag, as the walk itself does. ``pairs`` (L
    + 1,) are the numbers of products.
    """
    return period_s * pairs * np.maximum(_moments(size)[1] / size - 0.5 * np.arange(len(pairs)), 0.0)
