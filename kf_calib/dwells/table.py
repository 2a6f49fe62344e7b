"""A table of dwells: what a fit does with thousands of dwells, it does with arrays over all of them at once.

A fit turns the specific force of each dwell, allows for its setting error and subtracts what is known from its
readings, again and again. A ``DwellTable`` holds the dwells as they were folded, which all these tables share, and the
changes as arrays over dwells. A ``Dwell`` is one row of it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, wraps
from typing import Any, TypeVar, overload
from weakref import WeakKeyDictionary

import numpy as np

from kf_calib.bench.arrays import ComputedSequence, Floats, Indices, Ints, Mask
from kf_calib.bench.bench import turned
from kf_calib.dwells.coherent_tone import Trace
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.pieces import OfPieces, Pieces, WalkPath, walk_path_of
from kf_calib.dwells.rows import Nodes
from kf_calib.dwells.sufficient_statistics import Autocovariance, Dwell


@dataclass(frozen=True, eq=False, repr=False)
class AlikeDwells:
    """Dwells with equally many pieces P: indices (d,) of the dwells, and (d, P) of their pieces."""

    dwells: Indices
    pieces: Indices


@dataclass(frozen=True, eq=False, repr=False)
class FoldedDwells:
    """What of D dwells depends neither on the force that is felt nor on what is subtracted from their readings.

    - pieces: those of all dwells, in order.
    - ends (D + 1,): the first piece of each dwell, and at last the number of pieces.
    - the others: for each dwell what ``Dwell`` has under the name in singular.
    """

    pieces: Pieces
    ends: Indices
    numbers: Ints
    moving: Mask
    pose_sigmas_rad: Floats
    weights: Floats
    correlations: Floats
    turns: Sequence[tuple[int, ...]]
    autocovariances: Sequence[Autocovariance]
    spectra: Sequence[Spectrum]
    traces: Sequence[Trace]

    @classmethod
    def of(cls, dwells: Sequence[Dwell]) -> FoldedDwells:
        """Dwells side by side."""
        return cls(
            Pieces.joined([dwell.pieces for dwell in dwells]) if dwells else _NO_PIECES,
            np.cumsum([0, *(len(dwell.pieces) for dwell in dwells)]),
            np.array([dwell.number for dwell in dwells], int),
            np.array([dwell.moving for dwell in dwells], bool),
            np.array([dwell.pose_sigma_rad for dwell in dwells]),
            np.array([dwell.weights for dwell in dwells]).reshape(-1, 3),
            np.array([dwell.correlation for dwell in dwells]).reshape(-1, 3, 3),
            [dwell.turns for dwell in dwells],
            [dwell.autocovariance for dwell in dwells],
            [dwell.spectrum for dwell in dwells],
            [dwell.trace for dwell in dwells],
        )

    def beside(self, other: FoldedDwells) -> FoldedDwells:
        """These dwells, then others."""
        both: list[Any] = [
            np.concatenate([one, more]) if isinstance(one, np.ndarray) else [*one, *more]
            for one, more in ((getattr(self, name), getattr(other, name)) for name in _OF_DWELLS)
        ]
        ends = np.append(self.ends, self.ends[-1] + other.ends[1:])
        return FoldedDwells(Pieces.joined([self.pieces, other.pieces]), ends, *both)

    def take(self, dwells: Indices, at_most: int | None = None) -> tuple[FoldedDwells, Indices]:
        """Some of the dwells, and the indices of their pieces; at_most: of each, the first pieces alone."""
        numbers = self.piece_numbers[dwells] if at_most is None else np.minimum(self.piece_numbers[dwells], at_most)
        ends = np.append(0, np.cumsum(numbers))
        pieces = np.arange(ends[-1]) + np.repeat(self.ends[dwells] - ends[:-1], numbers)
        some: list[Any] = [
            values[dwells] if isinstance(values, np.ndarray) else [values[k] for k in dwells.tolist()]
            for values in (getattr(self, name) for name in _OF_DWELLS)
        ]
        return FoldedDwells(self.pieces[pieces], ends, *some), pieces

    def equals(self, other: FoldedDwells) -> bool:
        """Whether these are the same dwells."""
        pairs = ((self.pieces.triangles, other.pieces.triangles), (self.elapsed_s, other.elapsed_s),
                 (self.ends, other.ends), (self.weights, other.weights),
                 (self.correlations, other.correlations))  # fmt: skip
        return all(np.array_equal(one, another) for one, another in pairs)

    @property
    def width(self) -> int:
        """The number K of basis functions of a piece."""
        return self.pieces.width

    @property
    def carrier_hz(self) -> float:
        """Frequency of the carrier on which the dwells were folded; 0 for none."""
        return self.pieces.carrier_hz

    @cached_property
    def correlated(self) -> bool:
        """Whether channels share noise in any of the dwells."""
        return bool((self.correlations != np.eye(3)).any())

    @property
    def averaged(self) -> bool:
        """Whether averages of readings were folded instead of the readings themselves."""
        return self.pieces.averaged

    @cached_property
    def piece_numbers(self) -> Indices:
        """The number of pieces of each dwell, (D,)."""
        return np.diff(self.ends)

    @cached_property
    def shapes(self) -> list[AlikeDwells]:
        """The dwells grouped by their number of pieces."""
        kinds = dict[int, list[int]]()
        for k, pieces in enumerate(self.piece_numbers.tolist()):
            kinds.setdefault(pieces, []).append(k)
        return [
            AlikeDwells(np.array(places), self.ends[places][:, None] + np.arange(pieces))
            for pieces, places in kinds.items()
        ]

    @cached_property
    def shows_means_only(self) -> bool:
        """Whether nothing but the mean of each dwell is known, so that columns count at the middle of it alone."""
        return len(self.pieces) == len(self.numbers) and not self.pieces.triangles[:, 1 : self.width].any()

    @cached_property
    def piece_counts(self) -> Floats:
        """Number of readings of each piece, (pieces,)."""
        return self.pieces.counts.astype(float)

    @cached_property
    def counts(self) -> Floats:
        """Number of readings of each dwell, (D,)."""
        return np.add.reduceat(self.piece_counts, self.ends[:-1])

    @cached_property
    def squares(self) -> Floats:
        """Sums of squares (pieces, 3) of the readings about their fit by the basis functions."""
        return (self.pieces.triangles[:, self.width :, self.width :] ** 2).sum(axis=1)

    def squares_along(self, along: Floats) -> Floats:
        """Sums of squares (D,) of the readings about their fit by the basis functions, combined over the channels by
        ``along`` (D, 3)."""
        squares = np.empty(len(self.numbers))
        for shape in self.shapes:
            triangles = self.pieces.triangles[shape.pieces, self.width :, self.width :]
            squares[shape.dwells] = ((triangles @ along[shape.dwells][:, None, :, None]) ** 2).sum(axis=(1, 2, 3))
        return squares

    @cached_property
    def variances(self) -> Floats:
        """Variance of the readings about their fit within each piece, (pieces, 3); those of few degrees of freedom have
        the value pooled over the dwell."""
        freedom = np.maximum(self.piece_counts - self.width, 0.0)[:, None]
        squares, firsts = self.squares, self.ends[:-1]
        pooled = np.add.reduceat(squares, firsts) / np.maximum(np.add.reduceat(freedom, firsts), 1.0)
        of_pieces = squares / np.maximum(freedom, 1.0)
        return np.where(freedom >= FEWEST_READINGS, of_pieces, np.repeat(pooled, self.piece_numbers, axis=0))

    @property
    def shaking(self) -> tuple[Floats, Floats]:
        """Variance of the readings at the nodes of all pieces, (pieces, 3, 3), and the number of readings behind it,
        (pieces,)."""
        averaged = self.pieces.nodes.variance_mps2_2  # None with slews, which may be shorter than a window
        at_nodes = np.repeat(self.variances[:, None], 3, axis=1) if averaged is None else averaged.reshape(-1, 3, 3)
        return at_nodes, self.pieces.reading_counts.astype(float)

    @cached_property
    def spreads(self) -> Floats:
        """Covariances (D, 3, 3) of the readings about their mean, courses and noise within a dwell alike."""
        parts, means = self.pieces.triangles[:, :, self.width :], self.pieces.means
        if self.shows_means_only:  # the first row has the mean
            return np.einsum("dri,drj->dij", parts[:, 1:], parts[:, 1:]) / self.counts[:, None, None]
        spreads = np.empty((len(self.numbers), 3, 3))
        for k, part in enumerate(map(slice, self.ends[:-1], self.ends[1:])):
            mean = (self.piece_counts[part] @ means[part] / self.counts[k])[4:]
            spreads[k] = np.einsum("pri,prj->ij", parts[part], parts[part]) / self.counts[k] - np.outer(mean, mean)
        return spreads

    @cached_property
    def walks(self) -> list[WalkPath]:
        """The effect of a random walk of the biases on the rows of each dwell."""
        spans_s, triangles = self.pieces.spans_s, self.pieces.triangles[:, : self.width, : self.width]
        return [
            walk_path_of(spans_s[part, 0], spans_s[part, 1], self.pieces.counts[part].tolist(), triangles[part])
            for part in map(slice, self.ends[:-1], self.ends[1:])
        ]

    def rates(self, name: str) -> Floats:
        """Angular rate, or its derivative, at the nodes of all pieces, (m, 3); zeros where the platform stands."""
        rates = getattr(self.pieces.nodes, name)
        return np.broadcast_to(0.0, self.pieces.nodes.force_mps2.shape) if rates is None else rates

    @property
    def elapsed_s(self) -> Floats:
        """Time at the nodes of all pieces, (m,)."""
        return self.pieces.nodes.elapsed_s

    @cached_property
    def ends_s(self) -> Floats:
        """When each dwell begins and ends, (D, 2)."""
        return np.column_stack([self.elapsed_s[3 * self.ends[:-1]], self.elapsed_s[3 * self.ends[1:] - 1]])

    @cached_property
    def before(self) -> Indices:
        """Index (D,) of the dwell before each dwell; of the first, its own; of a slew, of the dwell that it left."""
        last = np.maximum.accumulate(np.where(self.moving, 0, np.arange(len(self.moving))))
        return np.append(0, last[:-1])

    def at_nodes(self, values: Floats) -> OfPieces:
        """Columns (pieces, K nodes, 3, c) of all dwells from values (m, 3, c) at their nodes; zeros on a carrier."""
        columns = np.zeros((self.ends[-1], self.width, *values.shape[1:]))
        columns[:, :3] = values.reshape(len(columns), 3, *values.shape[1:])
        return OfPieces(columns, self.ends)

    def weighted(self, of_pieces: Floats) -> Floats:
        """Means (D, ...) over each dwell of values of its pieces, (pieces, ...)."""
        counts = self.piece_counts.reshape(-1, *[1] * (of_pieces.ndim - 1))
        sums = np.add.reduceat(counts * of_pieces, self.ends[:-1], axis=0)
        return sums / self.counts.reshape(-1, *[1] * (of_pieces.ndim - 1))


_OF_DWELLS = [each.name for each in fields(FoldedDwells)][2:]
_Result = TypeVar("_Result")


def computed_once(function: Callable[[FoldedDwells], _Result]) -> Callable[[FoldedDwells], _Result]:
    """A function of dwells as they were folded that is computed once for these, and kept as long as they are."""
    known = WeakKeyDictionary[FoldedDwells, _Result]()

    @wraps(function)
    def result_of(folded: FoldedDwells) -> _Result:
        if folded not in known:
            known[folded] = function(folded)
        return known[folded]

    return result_of


_NONE = np.zeros(0)
_NO_PIECES = Pieces(
    np.zeros((0, 6, 6)), Nodes(_NONE, _NONE, np.zeros((0, 3)), np.zeros((0, 0)), _NONE), _NONE.astype(int),
    _NONE.astype(int),
)  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Attitudes:
    """What the readings show of the setting error of each dwell: the small rotation alpha from its recorded pose to its
    true one.

    - rotation_rad (D, 3): the rotation vectors across the force at which dwells are linearised.
    - variance_rad2 (D,): sums of the variances of their two components across the force, which shorten the mean of the
      force: E[R(alpha) f] = (1 - variance / 2) R(mode) f.
    - bending (D, 3, 3): derivative of the mean readings by the force that is due to the model's effects, m/s^2 per
      m/s^2; it adds to the sensitivities through which a small rotation changes the readings.
    """

    rotation_rad: Floats
    variance_rad2: Floats
    bending: Floats

    @classmethod
    def none(cls, count: int) -> Attitudes:
        """Those of dwells of which no setting error is allowed for."""
        return cls(np.zeros((count, 3)), np.zeros(count), np.zeros((count, 3, 3)))

    @property
    def length(self) -> Floats:
        """Length (D,) of the mean force over that of the force."""
        return 1.0 - 0.5 * self.variance_rad2

    def take(self, dwells: Indices) -> Attitudes:
        """Those of some dwells."""
        return Attitudes(self.rotation_rad[dwells], self.variance_rad2[dwells], self.bending[dwells])

    def beside(self, other: Attitudes) -> Attitudes:
        """These, then those of other dwells."""
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return Attitudes(*map(np.concatenate, pairs))


@dataclass(frozen=True, eq=False, repr=False)
class DwellTable(ComputedSequence[Dwell]):
    """Dwells in order of time, in arrays.

    - folded: the dwells as they were folded.
    - turned_rad (D, 3): rotation vectors by which effects of a model turn the specific force that poses show; None
      where they do not.
    - attitudes: what is known of setting errors beyond the prior; None where none is allowed for.
    - facing: one force (D, 3) and one pose (D, k) each at all nodes, in place of those that were folded; else None.
    - added (pieces, K, 3): what has been added to the readings, by coefficients on the basis functions; None for
      nothing.
    - came_from: the dwell before each dwell, where some have been left out of the fit; None where none has.
    """

    folded: FoldedDwells
    turned_rad: Floats | None = None
    attitudes: Attitudes | None = None
    facing: tuple[Floats, Floats] | None = None
    added: Floats | None = None
    came_from: DwellTable | None = None

    @classmethod
    def of(cls, dwells: Dwell | Sequence[Dwell]) -> DwellTable:
        """A dwell, or any dwells, as a table; a table as it is."""
        if isinstance(dwells, DwellTable):
            return dwells
        return cls(FoldedDwells.of([dwells] if isinstance(dwells, Dwell) else dwells))

    def __len__(self) -> int:
        return len(self.folded.numbers)

    @overload
    def __getitem__(self, index: int) -> Dwell: ...
    @overload
    def __getitem__(self, index: slice) -> DwellTable: ...
    def __getitem__(self, index: int | slice) -> Dwell | DwellTable:
        if isinstance(index, slice):
            return self.take(np.arange(len(self))[index])
        return self.item(range(len(self))[index])

    def item(self, k: int) -> Dwell:
        """The dwell at an index, with the changes of its force and of its readings."""
        folded = self.folded
        return Dwell(
            int(folded.numbers[k]), self.pieces[folded.ends[k] : folded.ends[k + 1]], folded.autocovariances[k],
            folded.spectra[k], folded.traces[k], bool(folded.moving[k]), float(folded.pose_sigmas_rad[k]),
            folded.turns[k], tuple(folded.weights[k].tolist()), folded.correlations[k],
        )  # fmt: skip

    def take(self, dwells: Sequence[int] | Indices, at_most: int | None = None) -> DwellTable:
        """Some of the dwells, by their indices; at_most: of each, the first pieces alone."""
        rows = np.arange(len(self))[np.asarray(dwells, np.intp)]
        folded, pieces = self.folded.take(rows, at_most)
        return DwellTable(
            folded,
            None if self.turned_rad is None else self.turned_rad[rows],
            None if self.attitudes is None else self.attitudes.take(rows),
            None if self.facing is None else (self.facing[0][rows], self.facing[1][rows]),
            None if self.added is None else self.added[pieces],
            None if self.came_from is None else self.came_from.take(rows),
        )

    def beside(self, other: DwellTable) -> DwellTable:
        """These dwells, then others, each with its changes."""
        attitudes = facing = None
        if self.attitudes is not None or other.attitudes is not None:
            one, more = (each.attitudes or Attitudes.none(len(each)) for each in (self, other))
            attitudes = one.beside(more)
        if self.facing is not None or other.facing is not None:
            facing = (
                np.concatenate([self.means[:, 1:4], other.means[:, 1:4]]), np.concatenate([self.poses, other.poses])
            )  # fmt: skip
        pieces = len(self.folded.pieces), len(other.folded.pieces)
        both = DwellTable(
            self.folded.beside(other.folded),
            _both(self.turned_rad, other.turned_rad, (len(self), 3), (len(other), 3)),
            attitudes,
            facing,
            _both(self.added, other.added, *((count, self.folded.width, 3) for count in pieces)),
        )
        if self.came_from is None and other.came_from is None:
            return both
        before = both.take(both.folded.before)
        came_from = (self.came_from or before[: len(self)]).beside(other.came_from or before[len(self) :])
        return replace(both, came_from=came_from)

    def without(self, left_out: Collection[int]) -> DwellTable:
        """The dwells without those at the indices ``left_out``; each keeps the dwell from which it was reached."""
        linked = replace(self, came_from=self.came_from or self.take(self.folded.before))
        return linked.take([k for k in range(len(self)) if k not in left_out])

    def prefixes(self, k: int) -> Iterator[DwellTable]:
        """Yield the dwell at an index as it was after its first pieces, for a growing number of pieces, and finally the
        whole dwell."""
        size = 1
        while size < self.folded.piece_numbers[k]:
            yield self.take([k], size)
            size = 2 * size if size > 7 else size + 1
        yield self.take([k])

    def weighted(self, weights: Floats, correlations: Floats | None = None) -> DwellTable:
        """The same dwells with other weights (D, 3) of their readings, and other correlations (D, 3, 3) of their means
        if given."""
        kept = self.folded.correlations if correlations is None else correlations
        return replace(self, folded=replace(self.folded, weights=weights, correlations=kept))

    def linearised(self, turned_rad: Floats | None, attitudes: Attitudes | None) -> DwellTable:
        """The same dwells about forces that are turned otherwise."""
        return replace(self, turned_rad=turned_rad, attitudes=attitudes)

    def plus(self, coefficients: Floats) -> DwellTable:
        """The same dwells with readings plus what has these coefficients on their basis functions, (pieces, K, 3)."""
        return replace(self, added=coefficients if self.added is None else self.added + coefficients)

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces of all dwells, with the changes of their forces and of their readings."""
        pieces, nodes = self.folded.pieces, self.folded.pieces.nodes
        if self.facing is not None:
            force_mps2, pose = (np.repeat(each, 3 * self.folded.piece_numbers, axis=0) for each in self.facing)
            pieces = replace(pieces, nodes=replace(nodes, force_mps2=force_mps2, pose=pose))
        return pieces if self.added is None else replace(pieces, triangles=pieces.plus(self.added))

    @property
    def triangles(self) -> Floats:
        """The triangles (pieces, K + 3, K + 3)."""
        return self.pieces.triangles

    @property
    def force_mps2(self) -> Floats:
        """Specific force at the nodes of all pieces that the poses show, (m, 3)."""
        return self.pieces.nodes.force_mps2

    @property
    def pose(self) -> Floats:
        """Pose at the nodes of all pieces, (m, k)."""
        return self.pieces.nodes.pose

    @cached_property
    def poses(self) -> Floats:
        """Mean pose of each dwell, (D, k)."""
        if self.facing is not None:
            return self.facing[1]
        return self.folded.weighted(self.pose.reshape(-1, 3, self.pose.shape[1]).mean(axis=1))

    @cached_property
    def felt_force_mps2(self) -> Floats:
        """Specific force that is felt at the nodes of all pieces, (m, 3)."""
        return self.felt(self.force_mps2, 3 * self.folded.piece_numbers)

    @cached_property
    def felt_means_mps2(self) -> Floats:
        """Mean specific force that is felt in each dwell, (D, 3)."""
        return self.felt(self.means[:, 1:4])

    def felt(self, force_mps2: Floats, times: Indices | int = 1) -> Floats:
        """The specific force that is felt where the angles show this one, (m, 3); ``times`` of it are of each
        dwell."""
        if self.turned_rad is not None:
            force_mps2 = turned(force_mps2, np.repeat(self.turned_rad, times, axis=0))
        if self.attitudes is not None:
            force_mps2 = turned(force_mps2, np.repeat(self.attitudes.rotation_rad, times, axis=0))
            force_mps2 = np.repeat(self.attitudes.length, times)[:, None] * force_mps2
        return force_mps2

    @cached_property
    def means(self) -> Floats:
        """Means (D, 7) of the regressors 1, f_x, f_y, f_z and of the three readings."""
        means = self.folded.weighted(self.pieces.means)
        if self.facing is not None:
            means[:, 1:4] = self.facing[0]
        return means

    @cached_property
    def before(self) -> tuple[Floats, Floats]:
        """Mean force (D, 3), by its pose, and mean pose (D, k) of the dwell before each dwell."""
        if self.came_from is not None:
            return self.came_from.means[:, 1:4], self.came_from.poses
        return self.means[self.folded.before, 1:4], self.poses[self.folded.before]

    @cached_property
    def bendings(self) -> Floats:
        """By how much effects change the mean readings of each dwell per unit of force, (D, 3, 3)."""
        return np.zeros((len(self), 3, 3)) if self.attitudes is None else self.attitudes.bending

    def sharing(self, other: DwellTable | None) -> DwellTable:
        """The same dwells as they are folded in another table, where they are the same there, so that what has been
        computed from them is not computed again."""
        if other is None or len(other) != len(self) or not self.folded.equals(other.folded):
            return self
        return replace(self, folded=other.folded)


def _both(one: Floats | None, more: Floats | None, *shapes: tuple[int, ...]) -> Floats | None:
    """Return an array and then another, zeros of its shape in place of one that is None; None if both are."""
    if one is None and more is None:
        return None
    pairs = zip((one, more), shapes, strict=True)
    return np.concatenate([np.zeros(shape) if values is None else values for values, shape in pairs])
