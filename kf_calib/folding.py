"""Dwells folded into small triangles: all that is kept of the samples.

A dwell is cut into pieces, short after the arrival and longer later (1, 1, 2, 4 ... 60 s). Over a piece every model
column is smooth: it is taken as a parabola through its values at the piece's beginning, middle and end (its *nodes*).
The readings are folded by QR against the parabola's basis, [1 u u^2 | z1 z2 z3] -> 6 x 6, unwhitened. Any column known
at the nodes, of any model, then has its exact rows from the triangles: noise model, filter and diagnosis need no second
pass over the data, and a column that changes (another tau, another E) is evaluated anew at a few hundred nodes.

A column that oscillates within a piece is no parabola. For it the dwells are folded on a *carrier* f0 near its
frequency: the basis is 1, u, u^2 and these times cos 2 pi f0 t and sin 2 pi f0 t, the triangle 12 x 12, and a column is
known by nine nodes, three of its plain part and three of each envelope. K is 3 below, or 9 on a carrier.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import Bench
from kf_calib.effects import Effect, Stimulus
from kf_calib.model import Model, Nodes, Rows, basis, effect_columns, on_basis, parabola
from kf_calib.samples import Floats, Mask
from kf_calib.spectrum import Spectrum
from kf_calib.triangle import triangle

WIDTH = 4
"""Regressors of the twelve parameters: 1, f_x, f_y, f_z."""

_LAGS = 64
_CORRELATED_SAMPLES = 8192  # readings of a dwell whose autocovariance is accumulated


@dataclass(frozen=True)
class Autocovariance:
    """Sums of lagged products within blocks of readings less their parabola: products (L + 1, 3), pairs (L + 1,).

    Without the parabola a drift would count as noise, and the test that should find it would be silenced.
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

    @classmethod
    def of(cls, innovation: Floats, elapsed_s: Floats | None = None, carrier_hz: float = 0.0) -> Autocovariance:
        """Of innovations (3, n); what goes with a carrier is no noise either."""
        count = innovation.shape[1]
        curve = np.linalg.qr(basis(np.linspace(-1.0, 1.0, count), elapsed_s, carrier_hz).T)[0]
        innovation = innovation - (innovation @ curve) @ curve.T
        padded = 1 << (count + _LAGS).bit_length()
        spectrum = np.fft.rfft(innovation, padded, axis=1)
        products = np.zeros((_LAGS + 1, 3))
        lags = min(_LAGS, count - 1) + 1
        products[:lags] = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, :lags].T
        return cls(products, np.maximum(count - np.arange(_LAGS + 1), 0).astype(float), count, 1)


@dataclass(frozen=True)
class Piece:
    """A stretch of a dwell, folded: triangle (K + 3, K + 3) over [1 u u^2 ... | z1 z2 z3], and its nodes (3)."""

    triangle: Floats
    nodes: Nodes
    count: int
    carrier_hz: float = 0.0


@dataclass(frozen=True)
class DwellFactor:
    """One dwell: its pieces in order of time, and the autocovariance of its first readings."""

    number: int
    pieces: tuple[Piece, ...]
    autocovariance: Autocovariance

    @property
    def carrier_hz(self) -> float:
        """What it was folded on; 0: no carrier."""
        return self.pieces[0].carrier_hz

    @property
    def width(self) -> int:
        """K, functions in the basis of a piece."""
        return self.pieces[0].triangle.shape[1] - 3

    @cached_property
    def squares(self) -> Floats:
        """Sums of squares of the readings about the functions of the basis, (pieces, 3)."""
        return np.array([(piece.triangle[self.width :, self.width :] ** 2).sum(axis=0) for piece in self.pieces])

    @cached_property
    def counts(self) -> Floats:
        """Readings of each piece, (pieces,)."""
        return np.array([piece.count for piece in self.pieces], float)

    @cached_property
    def variances(self) -> Floats:
        """Variance of the readings within each piece (pieces, 3), about a parabola; short pieces have their dwell's."""
        squares, spare = self.squares, np.maximum(self.counts - float(self.width), 0.0)[:, None]
        pooled = squares.sum(axis=0) / max(spare.sum(), 1)
        return np.where(spare >= 8, squares / np.maximum(spare, 1), pooled)

    @property
    def start_s(self) -> float:
        return float(self.pieces[0].nodes.elapsed_s[0])

    @property
    def end_s(self) -> float:
        return float(self.pieces[-1].nodes.elapsed_s[-1])

    @cached_property
    def count(self) -> int:
        return sum(piece.count for piece in self.pieces)

    @cached_property
    def pose(self) -> Floats:
        """Mean pose (k,)."""
        weights = np.array([piece.count for piece in self.pieces]) / self.count
        return weights @ np.array([piece.nodes.pose.mean(axis=0) for piece in self.pieces])

    @cached_property
    def factor(self) -> Floats:
        """Triangle (7, 7) over [1 f_x f_y f_z | z1 z2 z3]."""
        return _folded(self.rows([piece.nodes.regressors for piece in self.pieces]))

    @property
    def means(self) -> Floats:
        """Means of the regressors and readings, (7,): 1, f (3), z (3)."""
        return self.factor[0] / self.factor[0, 0]

    def rows(self, columns: Sequence[Floats]) -> Floats:
        """Rows [X | z1 z2 z3] of plain columns known at the nodes of each piece, (3, c): ((K + 3) pieces, c + 3)."""
        width = columns[0].shape[1]
        out = np.zeros((len(self.pieces), self.width + 3, width + 3))
        triangles = np.array([piece.triangle for piece in self.pieces])
        out[:, :3, :width] = triangles[:, :3, :3] @ parabola(np.array(columns))
        out[:, :, width:] = triangles[:, :, self.width :]
        return out.reshape(-1, width + 3)

    def merged(self, other: DwellFactor) -> DwellFactor:
        """The same dwell from two stretches of samples."""
        pieces = sorted((*self.pieces, *other.pieces), key=lambda piece: piece.nodes.elapsed_s[0])
        return replace(self, pieces=tuple(pieces), autocovariance=self.autocovariance + other.autocovariance)

    def prefixes(self) -> Iterator[DwellFactor]:
        """The dwell as it stood after 1, 2, 4 ... of its pieces, and in the end."""
        size = 1
        while size < len(self.pieces):
            yield replace(self, pieces=self.pieces[:size])
            size = 2 * size if size > 7 else size + 1
        yield self


def fold(rows: Rows, carrier_hz: float = 0.0) -> tuple[Piece, ...]:
    """The pieces of one block of rows."""
    width = 9 if carrier_hz else 3
    channels = rows.innovation if rows.static else rows.readings.T
    level = rows.readings[0] - channels[:, 0]  # what the innovation of a standing platform lacks of the readings
    pieces = list[Piece]()
    for part, u, nodes in rows.pieces:
        stacked = np.empty((width + 3, len(u)))  # rows along memory: what LAPACK wants, and faster to fill
        stacked[:width], stacked[width:] = basis(u, rows.elapsed_s[part], carrier_hz), channels[:, part]
        folded = _folded(stacked.T)
        folded[0, width:] += folded[0, 0] * level
        pieces.append(Piece(folded, nodes, len(u), carrier_hz))
    return tuple(pieces)


def _folded(stacked: Floats) -> Floats:
    """The square triangle of rows (n, c), padded with zeros where there are fewer rows than columns."""
    width = stacked.shape[1]
    if len(stacked) < width:
        stacked = np.vstack([stacked, np.zeros((width - len(stacked), width))])
    return triangle(stacked)


def stimulus_of(dwells: Sequence[DwellFactor], bench: Bench, state: Floats) -> Stimulus:
    """The nodes of all pieces of all dwells, in order; rotations are linearised at the affine ``state``."""
    nodes = [piece.nodes for dwell in dwells for piece in dwell.pieces]
    forces = [dwell.means[1:4] for dwell in dwells]
    before = [forces[max(d - 1, 0)] for d, dwell in enumerate(dwells) for _ in dwell.pieces]
    return Stimulus(
        bench=bench,
        elapsed_s=np.concatenate([each.elapsed_s for each in nodes]),
        since_arrival_s=np.concatenate([each.since_arrival_s for each in nodes]),
        force_mps2=np.concatenate([each.force_mps2 for each in nodes]),
        previous_force_mps2=np.repeat(before, 3, axis=0),
        pose=np.concatenate([each.pose for each in nodes]),
        temperature_c=np.concatenate([each.temperature_c for each in nodes]),
        sensitivity=state[:12].reshape(3, 4)[:, :3],
        variance_mps2_2=np.repeat(np.concatenate([dwell.variances for dwell in dwells]), 3, axis=0),
        carrier_hz=dwells[0].carrier_hz,
    )


def columns_of(dwells: Sequence[DwellFactor], model: Model, state: Floats) -> list[Floats]:
    """The model's columns at the nodes of each dwell, (pieces, K nodes, 3 channels, p)."""
    return _by_dwell(dwells, lambda s: model.columns(s, state), stimulus_of(dwells, model.bench, state))


def candidate_columns(
    dwells: Sequence[DwellFactor], effects: Sequence[Effect], bench: Bench, state: Floats
) -> list[Floats]:
    """Columns of effects that are in no model yet, like ``columns_of``."""
    return _by_dwell(dwells, lambda s: effect_columns(effects, s), stimulus_of(dwells, bench, state))


def _by_dwell(dwells: Sequence[DwellFactor], columns: Callable[[Stimulus], Floats], stimulus: Stimulus) -> list[Floats]:
    """Columns of a stimulus (m, 3, p) by dwell; on a carrier the plain part's nodes, then those of the envelopes."""
    parts = [columns(stimulus)]
    if stimulus.carrier_hz:
        parts += [columns(replace(stimulus, part=part)) for part in (1, 2)]
    shaped = np.concatenate([part.reshape(-1, 3, *part.shape[1:]) for part in parts], axis=1)
    return np.split(shaped, np.cumsum([len(dwell.pieces) for dwell in dwells])[:-1])


@dataclass(frozen=True)
class Means:
    """Of D dwells: mean model columns (D, 3, p), readings (D, 3), specific force (D, 3); counts of readings (D,)."""

    design: Floats
    readings: Floats
    force_mps2: Floats
    counts: Floats

    def __getitem__(self, part: int | list[int]) -> Means:
        return Means(self.design[part], self.readings[part], self.force_mps2[part], self.counts[part])


def means_of(dwells: Sequence[DwellFactor], columns: Sequence[Floats]) -> Means:
    design = []
    for dwell, own in zip(dwells, columns, strict=True):
        width = dwell.width
        first = np.array([piece.triangle[0, :width] / piece.triangle[0, 0] for piece in dwell.pieces])  # means of basis
        weights = np.array([piece.count for piece in dwell.pieces]) / dwell.count
        coefficients = on_basis(own.reshape(*own.shape[:2], -1))
        design.append(np.einsum("b,bk,bkc->c", weights, first, coefficients).reshape(own.shape[2:]))
    means = np.array([dwell.means for dwell in dwells])
    counts = np.array([dwell.count for dwell in dwells], float)
    return Means(np.array(design), means[:, 4:], means[:, 1:4], counts)


class Carried:
    """Dwells with the columns of a model: all that noise model, filter and diagnosis work on.

    ``state`` (p,): where small rotations and input axes are linearised.
    """

    def __init__(self, dwells: Sequence[DwellFactor], model: Model, state: Floats) -> None:
        self.dwells, self.model, self.state = list(dwells), model, state
        self.columns = columns_of(self.dwells, model, state)
        self.means = means_of(self.dwells, self.columns)

    @property
    def carrier_hz(self) -> float:
        """What the dwells were folded on; 0: no carrier."""
        return self.dwells[0].carrier_hz

    @property
    def sizes(self) -> Floats:
        """What a unit of each state makes in a reading, about, (p,); 1 where nothing."""
        largest = np.abs(self.means.design).max(axis=(0, 1))
        for own in self.columns if self.carrier_hz else ():
            largest = np.maximum(largest, np.abs(own[:, 3:]).max(axis=(0, 1, 2)))
        return np.where(largest > 0, largest, 1.0)


@dataclass(frozen=True)
class Samples:
    """Rows of one piece, sample by sample: H (n, 3, p), regressors of the dwell states (n, 4), readings (n, 3)."""

    dwell: int
    start_s: float
    observation: Floats
    regressors: Floats
    readings: Floats


def samples_of(rows: Iterable[Rows], carried: Carried) -> Iterator[Samples]:
    """A second pass over the rows with the columns of the first: what filterpy and batch least squares work on."""
    known = {dwell.number: iter(own) for dwell, own in zip(carried.dwells, carried.columns, strict=True)}
    starts = {dwell.number: dwell.start_s for dwell in carried.dwells}
    for block in rows:
        if block.dwell not in known:
            continue
        for part, u, _ in block.pieces:
            own = next(known[block.dwell])
            functions = basis(u, block.elapsed_s[part], carried.carrier_hz)
            observation = (functions.T @ on_basis(own.reshape(len(own), -1))).reshape(len(u), *own.shape[1:])
            yield Samples(block.dwell, starts[block.dwell], observation, block.columns[part], block.readings[part])


class Folder:
    """Folds rows into the list of dwell factors, dwell after dwell, on a carrier where one is given."""

    def __init__(self, carrier_hz: float = 0.0) -> None:
        self.dwells: list[DwellFactor] = []
        self.carrier_hz = carrier_hz
        self.spectrum = Spectrum()

    def add(self, rows: Rows) -> None:
        current = self.dwells[-1] if self.dwells and self.dwells[-1].number == rows.dwell else None
        fresh = current is None or current.autocovariance.count < _CORRELATED_SAMPLES
        own = Autocovariance.of(rows.innovation, rows.elapsed_s, self.carrier_hz) if fresh else Autocovariance()
        block = DwellFactor(rows.dwell, fold(rows, self.carrier_hz), own)
        if fresh:
            self.spectrum.add(rows.innovation, rows.elapsed_s)
        if current is None:
            self.dwells.append(block)
        else:
            self.dwells[-1] = current.merged(block)


def informative(factors: Floats) -> Mask:
    """Which of the first 4 rows of factors (D, 7, 7) carry model columns, (D, 4) bool.

    A still platform has one: the mean. The others then hold columns of rounding size and are noise.
    """
    size = np.linalg.norm(factors[:, :WIDTH, :WIDTH], axis=2)
    return size > 1e-9 * size[:, :1]
