"""Square-root sufficient statistics of dwells: small triangular matrices, which are all that is kept of the samples.

A dwell is cut into pieces, short ones after the arrival and longer ones later (1, 1, 2, 4 ... 60 s). Over a piece every
column of a model is smooth and is approximated by the parabola through its values at the beginning, middle and end of
the piece, its *nodes*. The readings are reduced by QR together with the basis of the parabola, [1 u u^2 | z1 z2 z3] ->
6 x 6, without whitening. From this triangle, the rows of any column that is known at the nodes follow without further
approximation, whatever the model. Noise model, filter and diagnosis therefore need no second pass over the data, and a
column that changes (with a time constant or a sensitivity) is evaluated again at a few hundred nodes only.

A column that oscillates within a piece is not a parabola. For such columns the dwells are folded on a *carrier* of a
frequency f0 near that of the oscillation: the basis is 1, u, u^2 and the products of these with cos 2 pi f0 t and sin 2
pi f0 t, the triangle is 12 x 12, and a column is known by nine values, three of its plain part and three of each
envelope. The number of basis functions is called K below; it is 3, or 9 on a carrier.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import turn_by
from kf_calib.dwells.coherent_tone import Trace, tone
from kf_calib.dwells.line_spectrum import SpectralLine, Spectrum, lines
from kf_calib.dwells.pieces import Piece, WalkPath, walk_path_of
from kf_calib.dwells.qr import square_triangle
from kf_calib.dwells.rows import Nodes, parabola


@dataclass(frozen=True)
class AttitudeError:
    """What the readings show of a dwell's setting error: the small rotation alpha from its recorded pose to its true
    one.

    - rotation_rad (3,): the rotation vector across the force at which the dwell is linearised.
    - variance_rad2: sum of the variances of its two components across the force, which shorten the mean of the force:
      E[R(alpha) f] = (1 - variance / 2) R(mode) f.
    - bending (3, 3): derivative of the mean readings by the force that is due to the model's effects, m/s^2 per m/s^2;
      it adds to the sensitivities through which a small rotation changes the readings.
    """

    rotation_rad: Floats
    variance_rad2: float = 0.0
    bending: Floats | None = None

    @property
    def length(self) -> float:
        """Length of the mean force over that of the force."""
        return 1.0 - 0.5 * self.variance_rad2


LEAST_FREEDOM = 8
"""Degrees of freedom of a piece, with fewer of which its variance is that of its whole dwell."""

_LAGS = 64


@dataclass(frozen=True)
class Autocovariance:
    """Sums of lagged products (L + 1, 3) within blocks of readings less their parabola, and the numbers of pairs (L +
    1,).

    The parabola is removed because a drift would otherwise count as noise, and the test for the drift would lose its
    power.
    """

    products: Floats = field(default_factory=lambda: np.zeros((_LAGS + 1, 3)))
    pairs: Floats = field(default_factory=lambda: np.zeros(_LAGS + 1))
    count: int = 0
    blocks: int = 0

    def __add__(self, other: Autocovariance) -> Autocovariance:
        return Autocovariance(
            self.products + other.products,
            self.pairs + other.pairs,
            self.count + other.count,
            self.blocks + other.blocks,
        )

    def times(self, weights: tuple[float, ...]) -> Autocovariance:
        """The sums with the products of each channel times its weight."""
        return self if set(weights) == {1.0} else replace(self, products=weights * self.products)

    @classmethod
    def of(cls, residuals: Floats) -> Autocovariance:
        """The sums for one block of readings (3, n) from which the parabola has been removed."""
        count = residuals.shape[1]
        padded = 1 << (count + _LAGS).bit_length()
        spectrum = np.fft.rfft(residuals, padded, axis=1)
        products = np.zeros((_LAGS + 1, 3))
        lags = min(_LAGS, count - 1) + 1
        products[:lags] = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, :lags].T
        return cls(products, np.maximum(count - np.arange(_LAGS + 1), 0).astype(float), count, 1)


_OF_CONDITIONS = ("nodes", "squares", "counts", "variances", "walk", "shaking", "count", "pose")
"""Cached properties of a dwell that stay if the means of its readings change."""
_OF_READINGS = (*_OF_CONDITIONS, "triangles", "factor", "means")
"""Cached properties of a dwell that stay if its force is turned."""
_OF_ALL = (*_OF_READINGS, "spread", "regressors")
"""Cached properties of a dwell that stay if nothing but its weights change."""
_OF_TRIANGLES = ("triangles", "squares", "counts", "variances", "walk", "shaking", "count", "spread")
"""Cached properties of a dwell that stay if the force and the pose at its nodes are others."""


@dataclass(frozen=True, repr=False, eq=False)
class DwellFactor:
    """The sufficient statistics of one dwell.

    - number: its number, counted from 1.
    - pieces: its pieces in order of time.
    - autocovariance, spectrum: of its first readings.
    - trace: sums of its readings in cells of the run's clock.
    - moving: True for the slew after the dwell of that number, which is folded like a dwell.
    - came_from: the dwell before it, if that one has been left out of the fit; else None.
    - pose_sigma_rad: uncertainty of its pose due to noise of the angles.
    - turns: whole turns of each gimbal by which its pose goes beyond the angles as recorded.
    - turned_rad: rotation vector (3,) by which effects of a model turn the specific force that its pose shows; None
      where they do not.
    - attitude: what is known of its setting error beyond the prior; None where none is allowed for.
    - weights (3,): of the readings of each channel, the variance of one of the run over that of one of this dwell.
    """

    number: int
    pieces: tuple[Piece, ...]
    autocovariance: Autocovariance = field(default_factory=Autocovariance)
    spectrum: Spectrum = field(default_factory=Spectrum)
    trace: Trace = field(default_factory=Trace)
    moving: bool = False
    came_from: DwellFactor | None = None
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] = ()
    turned_rad: Floats | None = None
    attitude: AttitudeError | None = None
    weights: tuple[float, ...] = (1.0, 1.0, 1.0)

    @property
    def carrier_hz(self) -> float:
        """Frequency of the carrier on which the dwell was folded; 0 for none."""
        return self.pieces[0].carrier_hz

    @property
    def width(self) -> int:
        """The number K of basis functions of a piece."""
        return self.pieces[0].triangle.shape[1] - 3

    def subtract(self, coefficients_of_pieces: Floats) -> DwellFactor:
        """The same dwell with readings less what was added to them, by its coefficients on the basis functions of each
        piece, (pieces, K, 3)."""
        pieces = list[Piece]()
        for piece, coefficients in zip(self.pieces, coefficients_of_pieces, strict=True):
            upper = piece.triangle.copy()
            upper[: self.width, self.width :] -= upper[: self.width, : self.width] @ coefficients
            pieces.append(replace(piece, triangle=upper))
        return self._replaced(_OF_CONDITIONS, pieces=tuple(pieces))

    def linearised(self, turned_rad: Floats | None, attitude: AttitudeError | None) -> DwellFactor:
        """The same dwell about a force that is turned otherwise."""
        return self._replaced(_OF_READINGS, turned_rad=turned_rad, attitude=attitude)

    def weighted(self, weights: Sequence[float]) -> DwellFactor:
        """The same dwell with other weights of its readings."""
        return self._replaced(_OF_ALL, weights=tuple(weights))

    def with_force(
        self, force_mps2: Floats, pose: Floats, attitude: AttitudeError | None, came_from: DwellFactor | None
    ) -> DwellFactor:
        """The same dwell with one specific force (3,) and one pose (k,) at all its nodes."""
        changes = {"force_mps2": np.tile(force_mps2, (3, 1)), "pose": np.tile(pose, (3, 1))}
        pieces = tuple(replace(piece, nodes=replace(piece.nodes, **changes)) for piece in self.pieces)
        changed = self._replaced(_OF_TRIANGLES, pieces=pieces, attitude=attitude, came_from=came_from)
        changes = {name: np.tile(values, (len(pieces), 1)) for name, values in changes.items()}
        means = np.concatenate([self.means[:1], force_mps2, self.means[4:]])
        changed.__dict__.update(nodes=replace(self.nodes, **changes), means=means)
        return changed

    def _replaced(self, unchanged: Collection[str], **changes: Any) -> DwellFactor:
        """Return the dwell with changes that leave these cached properties as they are."""
        changed = replace(self, **changes)
        changed.__dict__.update({name: self.__dict__[name] for name in unchanged if name in self.__dict__})
        return changed

    @cached_property
    def triangles(self) -> Floats:
        """The triangles of the pieces, (pieces, K + 3, K + 3)."""
        return np.array([piece.triangle for piece in self.pieces])

    @cached_property
    def nodes(self) -> Nodes:
        """The nodes of all pieces, in order of time."""
        of_pieces = [piece.nodes for piece in self.pieces]
        return Nodes(
            elapsed_s=np.concatenate([nodes.elapsed_s for nodes in of_pieces]),
            since_arrival_s=np.concatenate([nodes.since_arrival_s for nodes in of_pieces]),
            force_mps2=np.concatenate([nodes.force_mps2 for nodes in of_pieces]),
            pose=np.concatenate([nodes.pose for nodes in of_pieces]),
            temperature_c=np.concatenate([nodes.temperature_c for nodes in of_pieces]),
            rate_radps=np.concatenate([rate_or_zero(nodes.rate_radps) for nodes in of_pieces]),
            rate_change_radps2=np.concatenate([rate_or_zero(nodes.rate_change_radps2) for nodes in of_pieces]),
        )

    def felt_force(self, force_mps2: Floats) -> Floats:
        """The specific force (n, 3) that is felt where the angles show this one."""
        if self.turned_rad is not None:
            force_mps2 = turn_by(force_mps2, self.turned_rad)
        if self.attitude is not None:
            force_mps2 = self.attitude.length * turn_by(force_mps2, self.attitude.rotation_rad)
        return force_mps2

    @cached_property
    def squares(self) -> Floats:
        """Sums of squares (pieces, 3) of the readings about their fit by the basis functions."""
        return (self.triangles[:, self.width :, self.width :] ** 2).sum(axis=1)

    @cached_property
    def spread(self) -> Floats:
        """Covariance (3, 3) of the readings about their mean, courses and noise within the dwell alike."""
        parts = self.triangles[:, :, self.width :]
        mean = self.means[4:]
        return np.asarray(np.einsum("pri,prj->ij", parts, parts) / self.counts.sum() - np.outer(mean, mean), float)

    @cached_property
    def counts(self) -> Floats:
        """Number of readings of each piece, (pieces,)."""
        return np.array([piece.count for piece in self.pieces], float)

    @cached_property
    def variances(self) -> Floats:
        """Variance of the readings about their fit within each piece, (pieces, 3); short pieces have the value pooled
        over the dwell."""
        squares, freedom = self.squares, np.maximum(self.counts - float(self.width), 0.0)[:, None]
        pooled = squares.sum(axis=0) / max(freedom.sum(), 1)
        return np.where(freedom >= LEAST_FREEDOM, squares / np.maximum(freedom, 1), pooled)

    @cached_property
    def walk(self) -> WalkPath:
        """The effect of a random walk of the biases on the rows of this dwell."""
        ends = np.array([piece.nodes.elapsed_s[[0, -1]] for piece in self.pieces])
        triangles = self.triangles[:, : self.width, : self.width]
        return walk_path_of(ends[:, 0], ends[:, 1], [piece.count for piece in self.pieces], triangles)

    @property
    def averaged(self) -> bool:
        """Whether averages of readings were folded instead of the readings themselves."""
        return self.pieces[0].nodes.variance_mps2_2 is not None

    @cached_property
    def shaking(self) -> tuple[Floats, Floats]:
        """Variance of the readings at the nodes of each piece, (pieces, 3, 3), and the number of readings behind it,
        (pieces,)."""
        reading_counts = np.array([piece.reading_count for piece in self.pieces], float)
        if not self.averaged:
            return np.repeat(self.variances[:, None], 3, axis=1), reading_counts
        return np.array([piece.nodes.variance_mps2_2 for piece in self.pieces], float), reading_counts

    @property
    def start_s(self) -> float:
        """Time of the first reading since the first sample, s."""
        return float(self.pieces[0].nodes.elapsed_s[0])

    @property
    def end_s(self) -> float:
        """Time of the last reading since the first sample, s."""
        return float(self.pieces[-1].nodes.elapsed_s[-1])

    @cached_property
    def count(self) -> int:
        """Number of readings, or of averages of them, that were folded."""
        return sum(piece.count for piece in self.pieces)

    @cached_property
    def pose(self) -> Floats:
        """Mean pose (k,)."""
        weights = np.array([piece.count for piece in self.pieces]) / self.count
        return weights @ np.array([piece.nodes.pose.mean(axis=0) for piece in self.pieces])

    @cached_property
    def recorded_pose(self) -> Floats:
        """Mean pose (k,) with the angles as they were recorded, without the whole turns added to make them
        continuous."""
        return self.pose - 2.0 * np.pi * np.array(self.turns) if self.turns else self.pose

    @cached_property
    def factor(self) -> Floats:
        """Triangular factor (7, 7) of [1 f_x f_y f_z | z1 z2 z3] over the whole dwell."""
        return square_triangle(self.rows([piece.nodes.regressors for piece in self.pieces]))

    @cached_property
    def means(self) -> Floats:
        """Means (7,) of the regressors 1, f_x, f_y, f_z and of the three readings."""
        functions = self.triangles[:, 0] / self.triangles[:, :1, 0]  # means of the basis, then of the readings
        forces = np.array([piece.nodes.force_mps2 for piece in self.pieces])  # ``nodes`` would be kept: 25 kB an hour
        regressors = np.einsum("pk,pkc->pc", functions[:, :3], parabola(forces))
        piece_means = np.column_stack([np.ones(len(forces)), regressors, functions[:, self.width :]])
        return np.asarray(self.counts @ piece_means / self.counts.sum(), float)

    def rows(self, columns: Sequence[Floats]) -> Floats:
        """Rows [X | z1 z2 z3], ((K + 3) pieces, c + 3), of columns without an oscillating part, given as (3, c) at the
        nodes of each piece."""
        width = columns[0].shape[1]
        rows = np.zeros((len(self.pieces), self.width + 3, width + 3))
        rows[:, :3, :width] = self.triangles[:, :3, :3] @ parabola(np.array(columns))
        rows[:, :, width:] = self.triangles[:, :, self.width :]
        return rows.reshape(-1, width + 3)

    def merge(self, blocks: Sequence[DwellFactor]) -> DwellFactor:
        """This dwell merged with further blocks of its samples."""
        pieces = (piece for block in (self, *blocks) for piece in block.pieces)
        return replace(
            self,
            pieces=tuple(sorted(pieces, key=lambda piece: piece.nodes.elapsed_s[0])),
            autocovariance=sum((block.autocovariance for block in blocks), self.autocovariance),
            spectrum=sum((block.spectrum for block in blocks), self.spectrum),
            trace=sum((block.trace for block in blocks), self.trace),
        )

    def repeat(self, times: float) -> DwellFactor:
        """This dwell as if each of its readings had been taken ``times`` times."""
        pieces = (
            replace(piece, triangle=piece.triangle * times**0.5, count=round(piece.count * times))
            for piece in self.pieces
        )
        return replace(self, pieces=tuple(pieces))

    def prefixes(self) -> Iterator[DwellFactor]:
        """Yield the dwell as it was after its first pieces, for a growing number of pieces, and finally the whole
        dwell."""
        size = 1
        while size < len(self.pieces):
            yield replace(self, pieces=self.pieces[:size])
            size = 2 * size if size > 7 else size + 1
        yield self


def rate_or_zero(rate: Floats | None) -> Floats:
    """Angular rate at the nodes of a piece; zeros if the platform stands."""
    return np.zeros((3, 3)) if rate is None else rate


def dwells_before(dwells: Sequence[DwellFactor]) -> list[DwellFactor]:
    """The dwell before each dwell; for the first, that dwell itself; for a slew, the dwell that it left."""
    before, last = list[DwellFactor](), dwells[0]
    for dwell in dwells:
        before.append(dwell.came_from or last)
        last = last if dwell.moving else dwell
    return before


def dwells_without(dwells: Sequence[DwellFactor], left_out: Collection[int]) -> list[DwellFactor]:
    """The dwells without those at the indices ``left_out``; each keeps the dwell from which it was reached."""
    linked = [replace(dwell, came_from=last) for dwell, last in zip(dwells, dwells_before(dwells), strict=True)]
    return [dwell for k, dwell in enumerate(linked) if k not in left_out]


def lines_of(dwells: Sequence[DwellFactor], level: float = 0.01) -> tuple[SpectralLine, ...]:
    """Oscillations in the readings of dwells at the significance ``level``.

    These are the lines of the averaged spectrum or, if there are none, a single oscillation that is too weak to appear
    there but keeps its phase from dwell to dwell. The p-values account for both tests. In the averaged spectrum dwells
    count by their weights: the power of one that is louder than the others would have few degrees of freedom.
    """
    spectral_lines = lines((dwell.spectrum.times(dwell.weights) for dwell in dwells), 0.5 * level)
    steady = None if spectral_lines else tone([dwell.trace for dwell in dwells], 0.5 * level)
    oscillations = spectral_lines or ((steady,) if steady else ())
    return tuple(replace(line, p_value=min(1.0, 2.0 * line.p_value)) for line in oscillations)
