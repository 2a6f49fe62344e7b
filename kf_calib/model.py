"""The model of the readings: the exact affine one, and effects added to it.

``reading_i(t) = s_i . f(t) + b_i + sum of effects``, with the state x = (s1, b1, s2, b2, s3, b3, effects): linear
for any scale factor, bias and misalignment. ``model + effect`` is a model with one effect more.
A small rotation alpha of the platform (setting error) adds ``s_i . (alpha x f) = alpha . (f x s_i)``, linear in the
same regressors once the s_i are known to first order.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib import gate, paper
from kf_calib.averaging import averaged
from kf_calib.bench import Bench
from kf_calib.dwells import Block, Tally
from kf_calib.effects import Coefficient, Effect, Stimulus, effect_named
from kf_calib.errors import InputError, check_number
from kf_calib.samples import Floats, Mask
from kf_calib.slews import Curve

STATE_COUNT = 12
_ROUNDING_MPS2 = 1e-13
REGRESSORS = ("1", "f_x", "f_y", "f_z")
DWELL_STATES = 6
"""Nuisance states of a dwell: three small rotations (setting error), three offsets (sensor scatter)."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """What the block feels at m instants.

    elapsed_s, since_arrival_s, temperature_c (m,); force_mps2 (m, 3); pose (m, k). The three nodes of a
    piece are its beginning, middle and end. temperature_c is NaN where it is not measured. rate_radps,
    rate_change_radps2 (m, 3): the platform's omega in its own frame, and its derivative; None where it stands.
    variance_mps2_2 (m, 3): of the readings, where averages of them were folded; else None.
    """

    elapsed_s: Floats
    since_arrival_s: Floats
    force_mps2: Floats
    pose: Floats
    temperature_c: Floats
    rate_radps: Floats | None = None
    rate_change_radps2: Floats | None = None
    variance_mps2_2: Floats | None = None

    @property
    def regressors(self) -> Floats:
        """1, f_x, f_y, f_z (m, 4)."""
        return np.column_stack([np.ones(len(self.force_mps2)), self.force_mps2])


def parabola(values: Floats) -> Floats:
    """Coefficients (..., 3, c) on 1, u, u^2 of the parabola with ``values`` (..., 3, c) at u = -1, 0, 1.

    Equal values give exact zeros: a column that stands still has no rows but its mean's.
    """
    first, middle, last = values[..., 0, :], values[..., 1, :], values[..., 2, :]
    out = np.empty(values.shape)
    out[..., 0, :], out[..., 1, :] = middle, 0.5 * (last - first)
    out[..., 2, :] = 0.5 * (first - middle) + 0.5 * (last - middle)
    return out


def on_basis(values: Floats) -> Floats:
    """Coefficients (..., K, c) on ``basis`` of columns known at their nodes (..., K, c), K = 3, or 9 on a carrier."""
    if values.shape[-2] == 3:
        return parabola(values)
    return np.concatenate([parabola(part) for part in np.split(values, values.shape[-2] // 3, axis=-2)], axis=-2)


@dataclass(frozen=True, slots=True)
class Rows:
    """Model columns and readings of one block: columns (n, 4), readings (n, 3), innovation within the block (3, n).

    static: the columns are the same in every row, and the innovation is the readings less their mean.
    pieces: parts of the rows, u (n',) from -1 to 1 over each, and its nodes. moving: of the slew after the dwell.
    gated: in which channels each reading lay out that is not among them, (3, m) bool; None: there were none.
    raw: the rows before they were averaged, where they were; taken: how many readings a row then stands for.
    pose_sigma_rad: of the pose, by the noise of the angles. turns: by which it goes beyond the angles as recorded.
    """

    dwell: int
    elapsed_s: Floats
    columns: Floats
    readings: Floats
    innovation: Floats
    static: bool
    pieces: tuple[tuple[slice, Floats, Nodes], ...]
    moving: bool = False
    gated: Mask | None = None
    raw: Rows | None = None
    taken: int = 1
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] = ()


@dataclass(frozen=True)
class Model:
    """The twelve parameters and any effects; immutable, composed by + and -."""

    bench: Bench
    effects: tuple[Effect, ...] = ()

    @classmethod
    def of(cls, bench: Bench, names: Iterable[str] = ()) -> Model:
        model = cls(bench)
        for name in names:
            model += effect_named(name, bench)
        return model

    def __add__(self, effect: Effect) -> Model:
        taken = {c.symbol: each for each in self.effects for c in _states_of(each)}
        if any(str(each) == str(effect) for each in self.effects):
            raise InputError(f"{effect} is in the model already: name it once, or take it out first.")
        for coefficient in _states_of(effect):
            if coefficient.symbol in taken:
                raise InputError(
                    f"{effect} cannot be added: {taken[coefficient.symbol]} in the model already has the coefficient "
                    f"{coefficient.symbol}; take one of the two out."
                )
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, effect: Effect) -> Model:
        return replace(self, effects=tuple(each for each in self.effects if str(each) != str(effect)))

    def __str__(self) -> str:
        """A table: symbols, units, and the size a prior would call large."""
        from kf_calib.views.console import model_table, plain

        return plain(model_table(self))

    @property
    def sum(self) -> str:
        """The model as a sum of its parts, in a line."""
        return " + ".join(["twelve parameters", *map(str, self.effects)])

    @cached_property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Of all effects, in the order of the state after the twelve; an effect's unknown comes after its own."""
        return tuple(coefficient for effect in self.effects for coefficient in _states_of(effect))

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Where in the state each effect stands, by name."""
        ends = np.cumsum([STATE_COUNT, *(len(_states_of(effect)) for effect in self.effects)]).tolist()
        return {str(effect): slice(a, b) for effect, (a, b) in zip(self.effects, itertools.pairwise(ends), strict=True)}

    @property
    def walks(self) -> bool:
        """Whether an effect lets the biases walk."""
        return any(effect.walks for effect in self.effects)

    @property
    def dynamic(self) -> tuple[Effect, ...]:
        """The effects that show in slews only."""
        return tuple(effect for effect in self.effects if effect.dynamic)

    @property
    def oscillates(self) -> bool:
        """Whether an effect may be faster than a piece of a dwell, so that the dwells are folded on a carrier."""
        return any(effect.oscillates for effect in self.effects)

    @property
    def averages(self) -> bool:
        """Whether an effect needs averaged readings; an oscillation would go with the vibration."""
        return any(effect.averages for effect in self.effects) and not self.oscillates

    @property
    def unknowns(self) -> dict[int, Effect]:
        """The effects with a constant among the states, by the place of its state."""
        return {self.parts[str(each)].stop - 1: each for each in self.effects if each.unknown and each.smooth}

    @property
    def stepped(self) -> tuple[Effect, ...]:
        """The effects with a constant that has no derivative: it is no state."""
        return tuple(each for each in self.effects if each.unknown and not each.smooth)

    def moved(self, state: Floats) -> Model:
        """The model with its unknowns where ``state`` (p,) puts them: value times exp(state)."""
        moved = {str(each): each.at(each.value * math.exp(state[k])) for k, each in self.unknowns.items()}
        return replace(self, effects=tuple(moved.get(str(each), each) for each in self.effects))

    def with_effect(self, effect: Effect) -> Model:
        """The model with that effect in the place of the one of the same name."""
        return replace(self, effects=tuple(effect if str(each) == str(effect) else each for each in self.effects))

    def natural(self, state: Floats) -> tuple[Floats, Floats]:
        """Values of the effects' coefficients (q,) at ``state`` (p,), and how much of each a unit of its state is."""
        values, gains = state[STATE_COUNT:].copy(), np.ones(len(state) - STATE_COUNT)
        for k, effect in self.unknowns.items():
            values[k - STATE_COUNT] = effect.value * (1.0 + state[k])
            gains[k - STATE_COUNT] = effect.value
        return values, gains

    @property
    def count(self) -> int:
        return STATE_COUNT + len(self.coefficients)

    def nominal_state(self) -> Floats:
        """The state (p,) of nominal parameters and no effect."""
        twelve = paper.state_of(paper.nominal(self.bench.nominal))
        return np.concatenate([twelve, np.zeros(len(self.coefficients))])

    def columns(self, stimulus: Stimulus, state: Floats) -> Floats:
        """H (m, 3, p): what each accelerometer reads per unit of each state, linearised at ``state`` (p,)."""
        out = np.zeros((len(stimulus), 3, self.count))
        for i in range(3) if not stimulus.part else ():
            out[:, i, 4 * i : 4 * i + 3] = stimulus.force_mps2
            out[:, i, 4 * i + 3] = 1.0
        for effect in self.effects:
            if stimulus.part and not effect.oscillates:
                continue
            part = self.parts[str(effect)]
            own = slice(part.start, part.start + len(effect.coefficients))
            out[:, :, own] = effect_columns([effect], stimulus)
            if own.stop < part.stop:
                out[:, :, own.stop : part.stop] = effect.derivative(stimulus, state[own])
        return out


def effect_columns(effects: Sequence[Effect], stimulus: Stimulus) -> Floats:
    """What each accelerometer reads more per unit of each coefficient of the effects, (m, 3, q)."""
    own = [
        np.zeros((len(stimulus), 3, len(each.coefficients)))
        if stimulus.part and not each.oscillates
        else each.columns(stimulus)
        for each in effects
    ]
    columns = np.concatenate([np.zeros((len(stimulus), 3, 0)), *own], axis=2)
    scales = np.array([coefficient.scale for each in effects for coefficient in each.coefficients])
    # what a large coefficient would not lift above rounding is nothing: a vertical axis cannot tilt gravity
    columns[np.abs(columns) * scales < _ROUNDING_MPS2] = 0.0
    return columns


def _states_of(effect: Effect) -> tuple[Coefficient, ...]:
    unknown = effect.unknown
    if unknown is None or not effect.smooth:
        return effect.coefficients
    return *effect.coefficients, Coefficient(unknown.symbol, unknown.unit, 1.0, unknown.shown_unit, unknown.per_si)


def dwell_map(state: Floats) -> Floats:
    """N (3, 4, 6): the nuisance states of a dwell on the regressors, linearised at ``state``.

    Columns 0-2: rotation alpha, whose coefficient in channel i is f x s_i; columns 3-5: offset of sensor i.
    """
    out = np.zeros((3, len(REGRESSORS), DWELL_STATES))
    for i in range(3):
        sx, sy, sz = state[4 * i : 4 * i + 3]
        out[i, 1:, :3] = np.array([[0.0, -sz, sy], [sz, 0.0, -sx], [-sy, sx, 0.0]])  # (f x s) = f^T [s]
        out[i, 0, 3 + i] = 1.0
    return out


def model_rows(
    blocks: Iterable[Block], bench: Bench, tally: Tally, gate_sigma: float | None = 6.0, window_s: float = 0.0
) -> Iterator[Rows]:
    """Rows of every block, outliers gated out; the same rows feed both engines and batch least squares.

    window_s: rows of readings averaged over windows of that length, 0: they are not. Blocks too short for it are left
    out, and outliers are sought among the averages: a vibration that comes and goes has its own in the readings.
    """
    standing: tuple[Floats, Floats] | None = None  # a pose and its force: the same for all blocks of a dwell
    for block in blocks:
        if block.curve is not None:  # not gated: what an effect in a slew adds is no outlier
            yield _slew_rows(block, bench, block.curve)
            continue
        static = len(block.pose) == 1 and bench.reference == "base"
        if static and (standing is None or standing[0] is not block.pose):
            standing = block.pose, bench.specific_force(np.zeros(1), block.pose)
        force = standing[1] if static and standing else None
        raw = _rows(block, bench, force)
        means = averaged(block, window_s) if window_s else block
        if means is None:
            continue
        block, rows = means, _rows(means, bench, force) if window_s else raw
        if gate_sigma is not None and (not window_s or len(rows.readings) >= _GATED):
            keep = gate.inliers(rows.columns, rows.readings, rows.innovation, static, gate_sigma)
            if keep is not None:
                tally.gated += int((~keep).sum())
                out = rows.innovation[:, ~keep]
                block = _kept(block, keep)
                rows = _rows(block, bench, force)
                rows = replace(rows, gated=gate.channels(out, rows.innovation, gate_sigma))
        yield replace(rows, raw=raw, taken=block.taken) if window_s else rows


def _kept(block: Block, keep: Mask) -> Block:
    pose = block.pose if len(block.pose) == 1 else block.pose[keep]
    return replace(
        block,
        elapsed_s=block.elapsed_s[keep],
        accel_mps2=block.accel_mps2[keep],
        pose=pose,
        temperature_c=block.temperature_c[keep],
        variance_mps2_2=None if block.variance_mps2_2 is None else block.variance_mps2_2[keep],
    )


def _rows(block: Block, bench: Bench, force: Floats | None) -> Rows:
    """The rows of a block; ``force`` (1, 3) where the platform stands and gravity with it, else None."""
    since_s = block.elapsed_s - block.arrival_s
    edges = _EDGES_S[: int(np.searchsorted(_EDGES_S, since_s[-1]))]
    cuts = np.unique(np.concatenate([[0], np.searchsorted(since_s, edges), [len(since_s)]]))
    pieces = tuple(_piece(block, slice(a, b), bench, force) for a, b in itertools.pairwise(cuts.tolist()))
    if force is not None:
        columns = np.broadcast_to(np.append(1.0, force), (len(since_s), len(REGRESSORS)))
    else:
        columns = np.concatenate([basis(u).T @ parabola(nodes.regressors) for _, u, nodes in pieces])
    innovation = gate.innovations(columns, block.accel_mps2, force is not None)
    return Rows(
        block.dwell, block.elapsed_s, columns, block.accel_mps2, innovation, force is not None, pieces,
        pose_sigma_rad=block.pose_sigma_rad, turns=block.turns,
    )  # fmt: skip


def _slew_rows(block: Block, bench: Bench, curve: Curve) -> Rows:
    """The rows of a slew, in pieces of 2 deg."""
    pieces = tuple(
        _slew_piece(block, slice(a, b), bench, curve) for a, b in itertools.pairwise(curve.cuts(block.elapsed_s))
    )
    columns = np.concatenate([basis(u).T @ parabola(nodes.regressors) for _, u, nodes in pieces])
    return Rows(block.dwell, block.elapsed_s, columns, block.accel_mps2, block.accel_mps2.T, False, pieces, moving=True)


def _slew_piece(block: Block, part: slice, bench: Bench, curve: Curve) -> tuple[slice, Floats, Nodes]:
    own = block.elapsed_s[part]
    u, at = _spread(own)
    pose = curve.angles(at)
    nodes = Nodes(
        at, at - block.arrival_s, bench.specific_force(at, pose), pose, _temperatures(u, block.temperature_c[part]),
        curve.rate(at), curve.rate_change(at),
    )  # fmt: skip
    return part, u, nodes


def _spread(elapsed_s: Floats) -> tuple[Floats, Floats]:
    """u (n,) from -1 to 1 over readings, and the times of the nodes (3,)."""
    middle, half = 0.5 * (elapsed_s[0] + elapsed_s[-1]), max(0.5 * (elapsed_s[-1] - elapsed_s[0]), 1e-9)
    return (elapsed_s - middle) / half, np.array([elapsed_s[0], middle, elapsed_s[-1]])


_GATED = 32  # averages of a block, at least, among which an outlier can be told
_EDGES_S = np.concatenate([2.0 ** np.arange(6), 60.0 * np.arange(1, 20_000)])
"""A dwell is cut into pieces where 1, 2, 4 ... s have passed since the arrival, and at every further minute."""


def _piece(block: Block, part: slice, bench: Bench, force: Floats | None) -> tuple[slice, Floats, Nodes]:
    own, warm = block.elapsed_s[part], block.temperature_c[part]
    u, at = _spread(own)
    pose = np.repeat(block.pose, 3, axis=0) if len(block.pose) == 1 else _values_at_nodes(u, block.pose[part])
    if force is None:
        force = bench.specific_force(at, pose)
    variance = None if block.variance_mps2_2 is None else _values_at_nodes(u, block.variance_mps2_2[part])
    since_s = at - (block.arrival_s if block.felt_s is None else block.felt_s)
    nodes = Nodes(at, since_s, np.broadcast_to(force, (3, 3)), pose, _temperatures(u, warm), variance_mps2_2=variance)
    return part, u, nodes


def _temperatures(u: Floats, measured: Floats) -> Floats:
    """Temperature (3,) at u = -1, 0, 1: the line nearest to what was measured; NaN where any of it is missing."""
    level = measured.mean()
    if not math.isfinite(level) or measured[0] == measured[-1] == level:
        return np.full(3, level)
    away = u - u.mean()
    slope = (away @ measured) / max(away @ away, 1e-300)
    return level + slope * (np.array([-1.0, 0.0, 1.0]) - u.mean())


def basis(u: Floats, elapsed_s: Floats | None = None, carrier_hz: float = 0.0) -> Floats:
    """1, u, u^2 as rows (3, n); on a carrier these, and these times its cosine and times its sine, (9, n)."""
    if elapsed_s is not None and carrier_hz:
        plain, phase = basis(u), 2.0 * np.pi * carrier_hz * elapsed_s
        return np.concatenate([plain, plain * np.cos(phase), plain * np.sin(phase)])
    out = np.empty((3, len(u)))
    out[0], out[1] = 1.0, u
    np.multiply(u, u, out=out[2])
    return out


def _values_at_nodes(u: Floats, values: Floats) -> Floats:
    """Values (3, k) at u = -1, 0, 1 of the parabola nearest to samples (n, k)."""
    fitted = np.linalg.lstsq(basis(u).T, values, rcond=1e-9)[0]
    return basis(np.array([-1.0, 0.0, 1.0])).T @ fitted


@dataclass(frozen=True)
class Prior:
    """What is believed before the first sample: 1 sigma of misalignment (rad), scale factor (1) and bias (m/s^2).

    ``Prior()`` is diffuse: it says nothing, and the estimate equals least squares.
    """

    misalignment_rad: float | None = None
    scale: float | None = None
    bias_mps2: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                check_number(f"the prior's {name}", value)

    @property
    def diffuse(self) -> bool:
        return self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None

    def covariance(self, parameters: Floats) -> Floats:
        """Covariance (12, 12) of the affine state about the nominal ``parameters`` (12,)."""
        if self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None:
            raise ValueError("a diffuse prior has no covariance")
        sigma = np.array([self.misalignment_rad, self.misalignment_rad, self.scale, self.bias_mps2] * 3)
        jacobian = paper.sensitivity_jacobian(parameters)
        return jacobian @ np.diag(sigma**2) @ jacobian.T


PRIORS: dict[str, Prior] = {
    "diffuse": Prior(),
    "navigation": Prior(misalignment_rad=5e-3, scale=2e-3, bias_mps2=2e-2),
    "mems": Prior(misalignment_rad=0.1, scale=0.1, bias_mps2=1.0),
}
"""Grades a user can state; each is about twice what a sensor of that grade is sold with."""
