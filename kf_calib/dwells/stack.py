"""Dwells as arrays: what a fit does with thousands of dwells, it does with all of them at once.

A fit turns the specific force of each dwell, allows for its setting error and subtracts what is known from its
readings, again and again. A ``DwellStack`` holds the dwells as they were folded and these changes as arrays over
dwells; a single dwell is made from them only where it is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench.arrays import ComputedSequence, Floats, Mask
from kf_calib.bench.bench import turned
from kf_calib.dwells.pieces import OfPieces, PieceIndices
from kf_calib.dwells.rows import parabola
from kf_calib.dwells.sufficient_statistics import (
    LEAST_FREEDOM,
    AttitudeError,
    Autocovariance,
    DwellFactor,
    rate_or_zero,
)


@dataclass(frozen=True, eq=False, repr=False)
class AlikeDwells:
    """Dwells with equally many pieces P and basis functions K: indices (d,) of the dwells, and (d, P) of their
    pieces."""

    dwells: PieceIndices
    pieces: PieceIndices
    width: int


class Folded:
    """What of some dwells depends neither on the force that is felt nor on what is subtracted from their readings."""

    def __init__(self, dwells: Sequence[DwellFactor]) -> None:
        self.dwells: Sequence[DwellFactor] = tuple(dwells)
        self.piece_numbers = np.fromiter((len(dwell.pieces) for dwell in self.dwells), np.intp, len(self.dwells))
        self.ends = np.append(0, np.cumsum(self.piece_numbers))
        """The first piece of each dwell, and at last the number of pieces."""

    @cached_property
    def widths(self) -> PieceIndices:
        """The number K of basis functions of the pieces of each dwell, (D,)."""
        return np.fromiter((dwell.width for dwell in self.dwells), np.intp, len(self.dwells))

    @cached_property
    def moving(self) -> Mask:
        """Which are slews, (D,)."""
        return np.fromiter((dwell.moving for dwell in self.dwells), bool, len(self.dwells))

    @cached_property
    def pose_sigmas_rad(self) -> Floats:
        """Uncertainty (D,) of the pose of each dwell due to noise of the angles."""
        return np.fromiter((dwell.pose_sigma_rad for dwell in self.dwells), float, len(self.dwells))

    @cached_property
    def autocovariance(self) -> Autocovariance:
        """The sums of lagged products of all dwells, by the weights of their readings."""
        total = self.dwells[0].autocovariance.times(self.dwells[0].weights)
        for dwell in self.dwells[1:]:
            total = total + dwell.autocovariance.times(dwell.weights) if dwell.autocovariance.count else total
        return total

    @cached_property
    def shapes(self) -> list[AlikeDwells]:
        """The dwells grouped by shape."""
        kinds = dict[tuple[int, int], list[int]]()
        for k, kind in enumerate(zip(self.piece_numbers.tolist(), self.widths.tolist(), strict=True)):
            kinds.setdefault(kind, []).append(k)
        return [
            AlikeDwells(np.array(places), self.ends[places][:, None] + np.arange(pieces), width)
            for (pieces, width), places in kinds.items()
        ]

    @cached_property
    def triangles(self) -> list[Floats]:
        """The triangles (d, P, K + 3, K + 3) of the dwells of each shape."""
        return [np.array([[piece.triangle for piece in self.dwells[k].pieces] for k in shape.dwells.tolist()])
                for shape in self.shapes]  # fmt: skip

    @cached_property
    def shows_means_only(self) -> bool:
        """Whether nothing but the mean of each dwell is known, so that columns count at the middle of it alone."""
        return all(
            triangles.shape[1] == 1 and not triangles[:, 0, 1 : shape.width].any()
            for shape, triangles in zip(self.shapes, self.triangles, strict=True)
        )

    @cached_property
    def piece_counts(self) -> Floats:
        """Number of readings of each piece, (pieces,)."""
        return np.array([piece.count for dwell in self.dwells for piece in dwell.pieces], float)

    @cached_property
    def reading_counts(self) -> Floats:
        """Number of readings of each piece, of which averages may have been folded, (pieces,)."""
        return np.array([piece.reading_count for dwell in self.dwells for piece in dwell.pieces], float)

    @cached_property
    def counts(self) -> Floats:
        """Number of readings of each dwell, (D,)."""
        return np.add.reduceat(self.piece_counts, self.ends[:-1])

    @cached_property
    def weights(self) -> Floats:
        """Weights (D, 3) of the readings of each channel in each dwell."""
        return np.array([dwell.weights for dwell in self.dwells])

    @cached_property
    def squares(self) -> Floats:
        """Sums of squares (pieces, 3) of the readings about their fit by the basis functions."""
        squares = np.zeros((int(self.ends[-1]), 3))
        for shape, triangles in zip(self.shapes, self.triangles, strict=True):
            squares[shape.pieces] = (triangles[:, :, shape.width :, shape.width :] ** 2).sum(axis=2)
        return squares

    def squares_along(self, along: Floats) -> Floats:
        """Sums of squares (D,) of the readings about their fit by the basis functions, combined over the channels by
        ``along`` (D, 3)."""
        squares = np.empty(len(self.dwells))
        for shape, triangles in zip(self.shapes, self.triangles, strict=True):
            left = triangles[:, :, shape.width :, shape.width :] @ along[shape.dwells][:, None, :, None]
            squares[shape.dwells] = (left**2).sum(axis=(1, 2, 3))
        return squares

    @cached_property
    def shaking(self) -> tuple[Floats, Floats]:
        """Variance of the readings at the nodes of all pieces, (pieces, 3, 3), and the number of readings behind it,
        (pieces,)."""
        if all(dwell.averaged for dwell in self.dwells):  # a slew may be shorter than a window
            pieces = [piece for dwell in self.dwells for piece in dwell.pieces]
            return np.array([piece.nodes.variance_mps2_2 for piece in pieces], float), self.reading_counts
        freedom = np.maximum(self.piece_counts - np.repeat(self.widths, self.piece_numbers), 0.0)[:, None]
        squares, firsts = self.squares, self.ends[:-1]
        pooled = np.add.reduceat(squares, firsts) / np.maximum(np.add.reduceat(freedom, firsts), 1.0)
        of_pieces = squares / np.maximum(freedom, 1.0)
        variances = np.where(freedom >= LEAST_FREEDOM, of_pieces, np.repeat(pooled, self.piece_numbers, axis=0))
        return np.repeat(variances[:, None], 3, axis=1), self.reading_counts

    @cached_property
    def spreads(self) -> Floats:
        """Covariances (D, 3, 3) of the readings about their mean, courses and noise within a dwell alike."""
        return np.array([dwell.spread for dwell in self.dwells])

    def of_nodes(self, name: str) -> Floats:
        """One of the conditions at the nodes of all pieces, (m, ...)."""
        return np.concatenate([getattr(piece.nodes, name) for dwell in self.dwells for piece in dwell.pieces])

    def rates(self, name: str) -> Floats:
        """Angular rate, or its derivative, at the nodes of all pieces, (m, 3); zeros where the platform stands."""
        return np.concatenate([rate_or_zero(getattr(p.nodes, name)) for dwell in self.dwells for p in dwell.pieces])

    @cached_property
    def elapsed_s(self) -> Floats:
        """Time at the nodes of all pieces, (m,)."""
        return self.of_nodes("elapsed_s")

    @cached_property
    def ends_s(self) -> Floats:
        """When each dwell begins and ends, (D, 2)."""
        return np.column_stack([self.elapsed_s[3 * self.ends[:-1]], self.elapsed_s[3 * self.ends[1:] - 1]])

    @cached_property
    def force_mps2(self) -> Floats:
        """Specific force at the nodes of all pieces by their poses, (m, 3)."""
        return self.of_nodes("force_mps2")

    @cached_property
    def pose(self) -> Floats:
        """Pose at the nodes of all pieces, (m, k)."""
        return self.of_nodes("pose")

    @cached_property
    def before(self) -> PieceIndices:
        """Index (D,) of the dwell before each dwell; of the first, its own; of a slew, of the dwell that it left."""
        last = np.maximum.accumulate(np.where(self.moving, 0, np.arange(len(self.dwells))))
        return np.append(0, last[:-1])

    @cached_property
    def came_from(self) -> dict[int, DwellFactor]:
        """The dwell before, by index, where that one has been left out of the fit."""
        return {k: dwell.came_from for k, dwell in enumerate(self.dwells) if dwell.came_from is not None}

    def at_nodes(self, values: Floats) -> OfPieces:
        """Columns (pieces, K nodes, 3, c) of all dwells from values (m, 3, c) at their nodes; zeros on a carrier."""
        columns = np.zeros((self.ends[-1], self.dwells[0].width, *values.shape[1:]))
        columns[:, :3] = values.reshape(-1, 3, *values.shape[1:])
        return OfPieces(columns, self.ends)

    def weighted(self, of_pieces: Floats) -> Floats:
        """Means (D, ...) over each dwell of values of its pieces, (pieces, ...)."""
        counts = self.piece_counts.reshape(-1, *[1] * (of_pieces.ndim - 1))
        sums = np.add.reduceat(counts * of_pieces, self.ends[:-1], axis=0)
        return sums / self.counts.reshape(-1, *[1] * (of_pieces.ndim - 1))

    @cached_property
    def known(self) -> dict[str, Any]:
        """What others have computed from these dwells, by name."""
        return {}


@dataclass(frozen=True, eq=False, repr=False)
class Attitudes:
    """What is known of the setting errors of all dwells (``AttitudeError``): rotation_rad (D, 3), variance_rad2 (D,),
    bending (D, 3, 3)."""

    rotation_rad: Floats
    variance_rad2: Floats
    bending: Floats

    @property
    def length(self) -> Floats:
        """Length (D,) of the mean force over that of the force."""
        return 1.0 - 0.5 * self.variance_rad2

    def of(self, k: int) -> AttitudeError:
        """That of one dwell."""
        return AttitudeError(self.rotation_rad[k], float(self.variance_rad2[k]), self.bending[k])


@dataclass(frozen=True, eq=False, repr=False)
class Facing:
    """Dwells with one force (D, 3) and one pose (D, k) each at all nodes, in place of those that were folded; and the
    dwells before, by index, where these were left out."""

    force_mps2: Floats
    pose: Floats
    came_from: dict[int, DwellFactor]


@dataclass(frozen=True, eq=False, repr=False)
class DwellStack(ComputedSequence[DwellFactor]):
    """Dwells in order of time, with what is the same for all of them in arrays.

    - folded: the dwells as they were folded.
    - turned_rad (D, 3), attitudes: as of ``DwellFactor``; None if none is turned, or no setting error allowed for.
    - facing: forces and poses in place of those that were folded; None for those.
    - added (pieces, K, 3): what has been added to the readings, by coefficients on the basis functions; None for
      nothing.
    """

    folded: Folded
    turned_rad: Floats | None = None
    attitudes: Attitudes | None = None
    facing: Facing | None = None
    added: Floats | None = None
    _made: dict[int, DwellFactor] = field(default_factory=dict[int, DwellFactor])

    @classmethod
    def of(cls, dwells: Sequence[DwellFactor], like: DwellStack | None = None) -> DwellStack:
        """Any dwells as a stack; a stack as it is.

        like: a stack that may be of the same dwells, the same objects; what has been computed from them is then not
        computed again.
        """
        if isinstance(dwells, DwellStack):
            return dwells
        folded = like.folded if like is not None and like.folded.dwells == tuple(dwells) else Folded(dwells)
        still, turned_rad, attitudes = np.zeros(3), None, None
        if any(dwell.turned_rad is not None for dwell in dwells):
            turned_rad = np.array([still if dwell.turned_rad is None else dwell.turned_rad for dwell in dwells])
        if any(dwell.attitude is not None for dwell in dwells):
            errors = [dwell.attitude or AttitudeError(still) for dwell in dwells]
            none = np.zeros((3, 3))
            attitudes = Attitudes(
                np.array([error.rotation_rad for error in errors]),
                np.array([error.variance_rad2 for error in errors]),
                np.array([none if error.bending is None else error.bending for error in errors]),
            )
        return cls(folded, turned_rad, attitudes, _made=dict(enumerate(folded.dwells)))

    def __len__(self) -> int:
        return len(self.folded.dwells)

    def item(self, k: int) -> DwellFactor:
        """The dwell at an index, made once."""
        if k not in self._made:
            self._made[k] = self._dwell(k)
        return self._made[k]

    def _dwell(self, k: int) -> DwellFactor:
        dwell, facing = self.folded.dwells[k], self.facing
        turned_rad = None if self.turned_rad is None or not self.turned_rad[k].any() else self.turned_rad[k]
        attitude = None if self.attitudes is None else self.attitudes.of(k)
        if facing is not None:
            dwell = dwell.with_force(facing.force_mps2[k], facing.pose[k], attitude, facing.came_from.get(k))
        dwell = dwell.linearised(turned_rad, attitude)
        if self.added is not None:
            first, end = self.folded.ends[k : k + 2]
            dwell = dwell.subtract(-self.added[first:end, : dwell.width])
        return dwell

    def linearised(self, turned_rad: Floats | None, attitudes: Attitudes | None) -> DwellStack:
        """The same dwells about forces that are turned otherwise."""
        return DwellStack(self.folded, turned_rad, attitudes, self.facing, self.added)

    def facing_forces(
        self, force_mps2: Floats, pose: Floats, attitudes: Attitudes | None, came_from: dict[int, DwellFactor]
    ) -> DwellStack:
        """The same dwells, of no known attitude, with one force (D, 3) and one pose (D, k) each."""
        return DwellStack(self.folded, self.turned_rad, attitudes, Facing(force_mps2, pose, came_from), self.added)

    def plus(self, coefficients: Floats) -> DwellStack:
        """The same dwells with readings plus what has these coefficients on their basis functions, (pieces, K, 3)."""
        added = coefficients if self.added is None else self.added + coefficients
        return DwellStack(self.folded, self.turned_rad, self.attitudes, self.facing, added)

    @cached_property
    def triangles(self) -> list[Floats]:
        """The triangles (d, P, K + 3, K + 3) of the dwells of each shape."""
        if self.added is None:
            return self.folded.triangles
        changed = list[Floats]()
        for shape, triangles in zip(self.folded.shapes, self.folded.triangles, strict=True):
            width, triangles = shape.width, triangles.copy()
            coefficients = self.added[shape.pieces][:, :, :width]
            triangles[:, :, :width, width:] += triangles[:, :, :width, :width] @ coefficients
            changed.append(triangles)
        return changed

    @cached_property
    def force_mps2(self) -> Floats:
        """Specific force at the nodes of all pieces that the poses show, (m, 3)."""
        return self._at_nodes(self.folded.force_mps2 if self.facing is None else self.facing.force_mps2)

    @cached_property
    def pose(self) -> Floats:
        """Pose at the nodes of all pieces, (m, k)."""
        return self._at_nodes(self.folded.pose if self.facing is None else self.facing.pose)

    def _at_nodes(self, values: Floats) -> Floats:
        return values if self.facing is None else np.repeat(values, 3 * self.folded.piece_numbers, axis=0)

    @cached_property
    def poses(self) -> Floats:
        """Mean pose of each dwell, (D, k)."""
        if self.facing is not None:
            return self.facing.pose
        return self.folded.weighted(self.pose.reshape(-1, 3, self.pose.shape[1]).mean(axis=1))

    @cached_property
    def felt_force_mps2(self) -> Floats:
        """Specific force that is felt at the nodes of all pieces, (m, 3)."""
        return self.felt(self.force_mps2, 3 * self.folded.piece_numbers)

    @cached_property
    def felt_means_mps2(self) -> Floats:
        """Mean specific force that is felt in each dwell, (D, 3)."""
        return self.felt(self.means[:, 1:4])

    def felt(self, force_mps2: Floats, times: PieceIndices | int = 1) -> Floats:
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
        forces = parabola(self.force_mps2.reshape(-1, 3, 3))
        of_pieces = np.ones((len(forces), 7))
        for shape, triangles in zip(self.folded.shapes, self.triangles, strict=True):
            functions = triangles[:, :, 0] / triangles[:, :, :1, 0]  # means of the basis, then of the readings
            of_pieces[shape.pieces, 1:4] = (functions[:, :, None, :3] @ forces[shape.pieces])[:, :, 0]
            of_pieces[shape.pieces, 4:] = functions[:, :, shape.width :]
        means = self.folded.weighted(of_pieces)
        if self.facing is not None:
            means[:, 1:4] = self.facing.force_mps2
        return means

    @cached_property
    def before(self) -> tuple[Floats, Floats]:
        """Mean force (D, 3), by its pose, and mean pose (D, k) of the dwell before each dwell."""
        forces, poses = self.means[self.folded.before, 1:4], self.poses[self.folded.before]
        came_from = self.folded.came_from if self.facing is None else self.facing.came_from
        if came_from:
            places, left_out = list(came_from), DwellStack.of(list(came_from.values()))
            forces[places], poses[places] = left_out.means[:, 1:4], left_out.poses
        return forces, poses

    @cached_property
    def bendings(self) -> Floats:
        """By how much effects change the mean readings of each dwell per unit of force, (D, 3, 3)."""
        return np.zeros((len(self), 3, 3)) if self.attitudes is None else self.attitudes.bending

    def is_same(self, other: DwellStack) -> bool:
        """Whether the other stack has the same dwells with the same changes."""
        same = self.folded is other.folded or self.folded.dwells == other.folded.dwells  # the same objects
        changes = ("turned_rad", "attitudes", "facing", "added")
        return same and all(getattr(self, name) is getattr(other, name) for name in changes)
