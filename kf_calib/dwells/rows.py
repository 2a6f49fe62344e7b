"""Rows of one block of readings: the regressors, the readings with outliers removed, and the nodes of its pieces.

The innovation gate rejects and counts single readings that disagree with the rest of their dwell. The innovation of a
reading is taken about the level of the dwell itself, so that an orientation in which the model fails, which is the
evidence for a missing effect, is never rejected as a whole. Innovations are stored as (3, n), one row per channel,
because reductions along contiguous memory are several times faster.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats, Indices, Mask
from kf_calib.bench.bench import Bench
from kf_calib.dwells.blocks import Block, Curve, SampleCounts
from kf_calib.dwells.limits import FEWEST_READINGS, SAMPLE, SIGMAS
from kf_calib.dwells.window_average import average
from kf_calib.support.tail_probabilities import normal_quantile

REGRESSORS = ("1", "f_x", "f_y", "f_z")


@dataclass(frozen=True, slots=True)
class Nodes:
    """The conditions of the platform at m instants; the three nodes of a piece are its beginning, middle and end.

    - elapsed_s, since_arrival_s (m,): time since the first sample and since the arrival.
    - force_mps2 (m, 3): specific force in the platform frame.
    - pose (m, k): gimbal angles, rad, or quaternion.
    - temperature_c (m,): NaN where it was not measured.
    - rate_radps, rate_change_radps2 (m, 3): angular rate of the platform in its own frame and its derivative; None if
      the platform stands.
    - variance_mps2_2 (m, 3): variance of the readings, if averages of them were folded; else None.
    """

    elapsed_s: Floats
    since_arrival_s: Floats
    force_mps2: Floats
    pose: Floats
    temperature_c: Floats
    rate_radps: Floats | None = None
    rate_change_radps2: Floats | None = None
    variance_mps2_2: Floats | None = None

    @classmethod
    def joined(cls, some: Sequence[Nodes]) -> Nodes:
        """The conditions of several pieces, or dwells, one after another; rates are zero where the platform stands, and
        variances are those of averages only if all are averages."""
        values = {each.name: [getattr(nodes, each.name) for nodes in some] for each in fields(cls)}
        for name in ("rate_radps", "rate_change_radps2"):
            if any(rate is not None for rate in values[name]):
                pairs = zip(some, values[name], strict=True)
                values[name] = [np.zeros_like(nodes.force_mps2) if rate is None else rate for nodes, rate in pairs]
        joined: dict[str, Any] = {
            name: None if any(part is None for part in parts) else np.concatenate(parts)
            for name, parts in values.items()
        }
        return cls(**joined)

    def __getitem__(self, part: slice | Indices) -> Nodes:
        known = {each.name: values for each in fields(self) if (values := getattr(self, each.name)) is not None}
        return Nodes(**{name: values[part] for name, values in known.items()})

    @property
    def regressors(self) -> Floats:
        """The regressors 1, f_x, f_y, f_z (m, 4)."""
        return np.column_stack([np.ones(len(self.force_mps2)), self.force_mps2])


def parabola(values: Floats) -> Floats:
    """Coefficients (..., 3, c) on 1, u, u^2 of the parabola through ``values`` (..., 3, c) at u = -1, 0, 1.

    Equal values give coefficients of exactly zero on u and u^2, so that a constant column contributes only to the mean.
    """
    first, middle, last = values[..., 0, :], values[..., 1, :], values[..., 2, :]
    coefficients = np.empty(values.shape)
    coefficients[..., 0, :], coefficients[..., 1, :] = middle, 0.5 * (last - first)
    coefficients[..., 2, :] = 0.5 * (first - middle) + 0.5 * (last - middle)
    return coefficients


def on_basis(values: Floats) -> Floats:
    """Coefficients (..., K, c) on ``basis`` of columns given by their values at the nodes (..., K, c); K = 3, or 9 on a
    carrier."""
    if values.shape[-2] == 3:
        return parabola(values)
    return np.concatenate([parabola(part) for part in np.split(values, values.shape[-2] // 3, axis=-2)], axis=-2)


def on_nodes(functions: Floats) -> Floats:
    """Weights (..., K) of the values at the nodes from those (..., K) of the basis functions, K = 3, or 9 on a
    carrier: ``on_basis`` the other way round."""
    weights = np.empty(functions.shape)
    one, u, square = functions[..., ::3], functions[..., 1::3], functions[..., 2::3]
    weights[..., ::3], weights[..., 2::3] = 0.5 * (square - u), 0.5 * (square + u)
    weights[..., 1::3] = one - square
    return weights


@dataclass(frozen=True, slots=True)
class Rows:
    """Regressors and readings of one block.

    - columns (n, 4): the regressors.
    - readings (n, 3): the readings, m/s^2.
    - innovation (3, n): the readings less their least-squares fit within the block.
    - static: the regressors are the same in every row, so that the innovation is the reading less the mean.
    - u (n,), nodes (3 P): from -1 to 1 within each piece, and the conditions at the nodes of all pieces.
    - cuts (P + 1,): where the pieces begin, and the number of rows.
    - moving: the block belongs to the slew after the dwell.
    - gated (3, m): for each rejected reading, the channels in which it is an outlier; None if none was rejected.
    - raw: the rows before averaging, if the readings were averaged.
    - readings_per_row: number of readings that a row stands for.
    - pose_sigma_rad: uncertainty of the pose due to noise of the angles.
    - turns: whole turns by which the pose goes beyond the angles as recorded.
    - along (3,): unit vector of the mean reading where no angles are used, which is the force but for scale factors and
      biases; else None.
    """

    dwell: int
    elapsed_s: Floats
    columns: Floats
    readings: Floats
    innovation: Floats
    static: bool
    u: Floats
    nodes: Nodes
    cuts: Indices
    moving: bool = False
    gated: Mask | None = None
    raw: Rows | None = None
    readings_per_row: int = 1
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] = ()
    along: Floats | None = None

    @property
    def pieces(self) -> list[slice]:
        """The rows of each piece."""
        return [slice(first, last) for first, last in itertools.pairwise(self.cuts.tolist())]

    @property
    def without_rotations(self) -> tuple[Floats, Floats]:
        """Innovations (3, n) and readings (n, 3) as far as no rotation changes them: all of them with angles, else
        their parts along the force. A body in the hand creeps and trembles, which is no noise of its sensors."""
        if self.along is None:
            return self.innovation, self.readings
        part = np.outer(self.along, self.along)
        return part @ self.innovation, self.readings @ part


def model_rows(
    blocks: Iterable[Block],
    bench: Bench,
    counts: SampleCounts,
    gate_sigma: float | None = SIGMAS,
    window_s: float = 0.0,
) -> Iterator[Rows]:
    """Rows of every block, without outliers; both engines and batch least squares work on the same rows.

    - gate_sigma: limit of the innovation gate in robust standard deviations; None for no gate.
    - window_s: length of the windows over which readings are averaged; 0 for no averaging. Blocks that are too short
      for the windows are left out. The gate then acts on the averages, because a vibration that comes and goes produces
      outliers of its own in the single readings.
    """
    standing: tuple[Floats, Floats] | None = None  # a pose and its specific force, which all blocks of a dwell share
    for block in blocks:
        if block.curve is not None:  # not gated, since an effect that shows in slews would be rejected
            yield _slew_rows(block, bench, block.curve)
            continue
        static = len(block.pose) == 1 and bench.reference == "base"
        if static and (standing is None or standing[0] is not block.pose):
            standing = block.pose, bench.specific_force(np.zeros(1), block.pose)
        force = standing[1] if static and standing else None
        raw = _rows(block, bench, force)
        averaged = average(block, window_s) if window_s else block
        if averaged is None:
            continue
        block, rows = averaged, _rows(averaged, bench, force) if window_s else raw
        if gate_sigma is not None and (not window_s or len(rows.readings) >= SAMPLE):
            keep = inliers(rows.columns, rows.readings, rows.innovation, static, gate_sigma)
            if keep is not None:
                counts.gated += int((~keep).sum())
                rejected = rows.innovation[:, ~keep]
                block = block[keep]
                rows = _rows(block, bench, force)
                rows = replace(rows, gated=channels(rejected, rows.innovation, gate_sigma))
        yield replace(rows, raw=raw, readings_per_row=block.readings_per_row) if window_s else rows


def _rows(block: Block, bench: Bench, force: Floats | None) -> Rows:
    """Return the rows of a block; ``force`` (1, 3) is the specific force if it is constant, else None."""
    since_s = block.elapsed_s - block.arrival_s
    edges = _EDGES_S[: int(np.searchsorted(_EDGES_S, since_s[-1]))]
    cuts = np.unique(np.concatenate([[0], np.searchsorted(since_s, edges), [len(since_s)]]))
    u, node_s = _node_times(block.elapsed_s, cuts)
    standing = len(block.pose) == 1
    pose = np.repeat(block.pose, len(node_s), axis=0) if standing else _values_at_nodes(u, block.pose, cuts)
    at_nodes = bench.specific_force(node_s, pose) if force is None else np.repeat(force, len(node_s), axis=0)
    variance = None if block.variance_mps2_2 is None else _values_at_nodes(u, block.variance_mps2_2, cuts)
    since_s = node_s - (block.arrival_s if block.arrival_felt_s is None else block.arrival_felt_s)
    temperature_c = _temperatures(u, block.temperature_c, cuts)
    nodes = Nodes(node_s, since_s, at_nodes, pose, temperature_c, variance_mps2_2=variance)
    if force is not None:
        columns = np.broadcast_to(np.append(1.0, force), (len(u), len(REGRESSORS)))
    else:
        columns = _between_nodes(u, nodes.regressors, cuts)
    innovation = innovations(columns, block.accel_mps2, force is not None)
    return Rows(
        block.dwell, block.elapsed_s, columns, block.accel_mps2, innovation, force is not None, u, nodes, cuts,
        pose_sigma_rad=block.pose_sigma_rad, turns=block.turns,
        along=None if bench.angles else _direction(block.accel_mps2.mean(axis=0)),
    )  # fmt: skip


def _direction(vector: Floats) -> Floats:
    """Return the unit vector of a vector (3,); zeros for one of no length."""
    return vector / max(float(np.linalg.norm(vector)), 1e-300)


def _slew_rows(block: Block, bench: Bench, curve: Curve) -> Rows:
    """Return the rows of a slew, in pieces of 2 deg."""
    cuts = np.array(curve.cuts(block.elapsed_s))
    u, node_s = _node_times(block.elapsed_s, cuts)
    pose = curve.angles(node_s)
    nodes = Nodes(
        node_s, node_s - block.arrival_s, bench.specific_force(node_s, pose), pose,
        _temperatures(u, block.temperature_c, cuts), curve.rate(node_s), curve.rate_change(node_s),
    )  # fmt: skip
    columns, readings = _between_nodes(u, nodes.regressors, cuts), block.accel_mps2
    return Rows(block.dwell, block.elapsed_s, columns, readings, readings.T, False, u, nodes, cuts, moving=True)


def _node_times(elapsed_s: Floats, cuts: Indices) -> tuple[Floats, Floats]:
    """Return u (n,) from -1 to 1 over the readings of each piece, and the times of the nodes (3 P,)."""
    begins_s, ends_s, counts = elapsed_s[cuts[:-1]], elapsed_s[cuts[1:] - 1], np.diff(cuts)
    middles_s, halves_s = 0.5 * (begins_s + ends_s), np.maximum(0.5 * (ends_s - begins_s), 1e-9)
    u = (elapsed_s - np.repeat(middles_s, counts)) / np.repeat(halves_s, counts)
    return u, np.column_stack([begins_s, middles_s, ends_s]).ravel()


def _between_nodes(u: Floats, values: Floats, cuts: Indices) -> Floats:
    """Return values (n, c) at all readings from those at the nodes (3 P, c)."""
    coefficients = parabola(values.reshape(-1, 3, values.shape[1]))
    return np.einsum("kn,nkc->nc", basis(u), np.repeat(coefficients, np.diff(cuts), axis=0))


_EDGES_S = np.concatenate([2.0 ** np.arange(6), 60.0 * np.arange(1, 20_000)])
"""Dwells are cut into pieces 1, 2, 4 ... 32 s after the arrival and then at every full minute."""


def _temperatures(u: Floats, measured: Floats, cuts: Indices) -> Floats:
    """Return the temperature (3 P,) at u = -1, 0, 1 of each piece from a straight-line fit; NaN where any measurement
    is missing."""
    first, counts = cuts[:-1], np.diff(cuts)
    level, middle = (np.add.reduceat(values, first) / counts for values in (measured, u))
    centred = u - np.repeat(middle, counts)
    slope = np.add.reduceat(centred * (measured - np.repeat(measured[first], counts)), first)
    slope /= np.maximum(np.add.reduceat(centred**2, first), 1e-300)
    level = np.where((measured[first] == measured[cuts[1:] - 1]) & (slope == 0.0), measured[first], level)
    return (level[:, None] + slope[:, None] * (np.array([-1.0, 0.0, 1.0]) - middle[:, None])).ravel()


def basis(u: Floats, elapsed_s: Floats | None = None, carrier_hz: float = 0.0) -> Floats:
    """Basis functions of a piece: 1, u, u^2 as rows (3, n); on a carrier also their products with its cosine and its
    sine, (9, n)."""
    if elapsed_s is not None and carrier_hz:
        plain, phase = basis(u), 2.0 * np.pi * carrier_hz * elapsed_s
        return np.concatenate([plain, plain * np.cos(phase), plain * np.sin(phase)])
    functions = np.empty((3, len(u)))
    functions[0], functions[1] = 1.0, u
    np.multiply(u, u, out=functions[2])
    return functions


def _values_at_nodes(u: Floats, values: Floats, cuts: Indices) -> Floats:
    """Return the values (3 P, k) at u = -1, 0, 1 of the least-squares parabola through the samples (n, k) of each
    piece."""
    functions, at_nodes = basis(u).T, basis(np.array([-1.0, 0.0, 1.0])).T
    parts = [slice(a, b) for a, b in itertools.pairwise(cuts.tolist())]
    return np.concatenate([at_nodes @ np.linalg.lstsq(functions[p], values[p], rcond=1e-9)[0] for p in parts])


def innovations(columns: Floats, readings: Floats, static: bool, keep: Mask | None = None) -> Floats:
    """Readings (n, 3) less their least-squares fit by the columns (n, c) within the block, as (3, n).

    In a ``static`` block (constant columns, platform at rest) the fit is the mean. ``keep`` selects the readings that
    are fitted.
    """
    channels = np.ascontiguousarray(readings.T)
    chosen = slice(None) if keep is None else keep
    if static:
        return channels - channels[:, chosen].mean(axis=1, keepdims=True)
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0, scale, 1.0)
    fitted = np.linalg.lstsq(scaled[chosen], readings[chosen], rcond=1e-10)[0]
    return channels - fitted.T @ scaled.T


def inliers(columns: Floats, readings: Floats, innovation: Floats, static: bool, threshold: float) -> Mask | None:
    """Mask (n,) of the readings that pass the gate; None if all do.

    A reading is rejected if the innovation in any channel differs from the block's median by more than ``threshold``
    robust standard deviations: the median absolute deviation over that of noise of unit variance or, where that is zero
    because of coarse quantisation, the ordinary standard deviation.
    """
    count = len(readings)
    if count < FEWEST_READINGS:
        return None
    if _plainly_clean(innovation, threshold):
        return None
    keep: Mask = np.ones(count, bool)
    kept_innovation = innovation
    for _ in range(5):
        centre = np.median(kept_innovation, axis=1, keepdims=True)
        sigma = np.median(np.abs(kept_innovation - centre), axis=1, keepdims=True) / normal_quantile(0.75)
        sigma = np.where(sigma > 0, sigma, kept_innovation.std(axis=1, keepdims=True))
        inlying: Mask = np.all(np.abs(innovation - centre) <= threshold * np.maximum(sigma, 1e-12), axis=0)
        if (inlying == keep).all():
            break
        keep = inlying
        innovation = innovations(columns, readings, static, keep)
        kept_innovation = innovation[:, keep]
    return None if keep.all() or keep.sum() < 4 else keep


def channels(rejected: Floats, kept: Floats, threshold: float) -> Mask:
    """Mask (3, m) of the channels in which rejected readings are outliers, from the innovations of rejected (3, m) and
    kept (3, n) readings.

    At least one channel is marked, the one with the largest deviation in its own sigma.
    """
    score = np.abs(rejected) / np.maximum(kept.std(axis=1, keepdims=True), 1e-12)
    return score >= np.minimum(threshold, score.max(axis=0))


def _plainly_clean(innovation: Floats, threshold: float) -> bool:
    """Tell whether a quick test already shows that there are no outliers, so that the medians need not be computed.

    No reading may stand out, and the rms must agree with a robust estimate from a sample.
    """
    rms = np.sqrt(np.einsum("ij,ij->i", innovation, innovation) / innovation.shape[1])
    if (np.maximum(innovation.max(axis=1), -innovation.min(axis=1)) > min(4.5, threshold) * rms).any():
        return False
    sample = innovation[:, :: max(1, innovation.shape[1] // 256)]
    bulk = np.median(np.abs(sample), axis=1) / normal_quantile(0.75)
    return bool((rms <= 1.5 * bulk).all())
