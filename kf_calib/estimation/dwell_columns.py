"""The columns of models and effects over dwells that are kept as sufficient statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench.arrays import DIFFERENCE, IN_MEMORY, Floats, Indices, crossed
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable, FoldedDwells, computed_once
from kf_calib.effects import Effect, RotationEffect, Stimulus
from kf_calib.estimation.measurement_model import Model, effect_columns
from kf_calib.noise.means import Means, means_of
from kf_calib.noise.temperature_course import temperature_course

FARTHEST_RAD = 0.3
"""By which attitudes are turned in a step; what hardly determined coefficients may amount to, but no bench."""
_VIBRATING = 15.0  # mean squared deviation of the variances in units of sigma; autocorrelation alone gives up to 10


def stimulus_of(dwells: DwellTable, bench: Bench, state: Floats) -> Stimulus:
    """The conditions at the nodes of all pieces of all dwells and slews, in order; rotations are linearised at
    ``state``. Poses are NaN where no angles are used."""
    known = _known_conditions(dwells.folded) | _conditions(dwells) | _turned_conditions(dwells)
    if not bench.angles:
        known = known | {key: np.full_like(known[key], np.nan) for key in ("pose", "previous_pose")}
    return Stimulus(bench=bench, sensitivity=state[:12].reshape(3, 4)[:, :3], **known)


def _conditions(table: DwellTable) -> dict[str, Any]:
    """Return the forces (m, 3) and poses (m, k) that the angles show at the nodes of the dwells, and before them.

    The last step stays that of the poses: where a pose changes nothing along an axis, its sign is not that of noise.
    """
    (forces, poses), times = table.before, 3 * table.folded.piece_numbers
    before = np.repeat(forces, times, axis=0)
    if table.turned_rad is not None or table.attitudes is not None:
        before += table.felt_force_mps2 - table.force_mps2
    previous_pose = np.repeat(poses, times, axis=0)
    return {"previous_force_mps2": before, "pose": table.pose, "previous_pose": previous_pose}


def _turned_conditions(table: DwellTable) -> dict[str, Any]:
    """Return the specific force (m, 3) that is felt at the nodes, and by what it is turned there."""
    conditions = dict[str, Any](force_mps2=table.felt_force_mps2)
    if table.turned_rad is not None or table.attitudes is not None:
        still, times = np.zeros((len(table), 3)), 3 * table.folded.piece_numbers
        turned_rad = still if table.turned_rad is None else table.turned_rad
        attitude_rad = still if table.attitudes is None else table.attitudes.rotation_rad
        conditions["turned_rad"] = np.repeat(turned_rad, times, axis=0)
        conditions["attitude_rad"] = np.repeat(attitude_rad, times, axis=0)
    return conditions


@computed_once
def _known_conditions(folded: FoldedDwells) -> dict[str, Any]:
    """Return the conditions that do not change if dwells are turned; every fit asks for them several times."""
    elapsed_s = folded.elapsed_s
    return {
        "elapsed_s": elapsed_s,
        "since_arrival_s": folded.pieces.nodes.since_arrival_s,
        "temperature_c": temperature_course(folded).temperature_c,
        "variance_mps2_2": _varying(folded).reshape(-1, 3),
        "rate_radps": folded.rates("rate_radps"),
        "rate_change_radps2": folded.rates("rate_change_radps2"),
        "half_s": np.repeat(0.5 * (elapsed_s[2::3] - elapsed_s[::3]), 3),
        "within": np.tile([-1.0, 0.0, 1.0], len(folded.pieces)),
        "carrier_hz": folded.carrier_hz,
    }


def _varying(folded: FoldedDwells) -> Floats:
    """Return the variances of the readings (pieces, nodes, 3), or their mean if they vary no more than their estimates
    scatter."""
    at_nodes, counts = folded.shaking
    variances = at_nodes.mean(axis=1)
    mean = np.average(variances, axis=0, weights=counts)
    excess = np.mean(0.5 * counts[:, None] * (variances / np.where(mean > 0, mean, 1.0) - 1.0) ** 2, axis=0)
    return np.where(excess > _VIBRATING, at_nodes, mean)


def without_known(dwells: DwellTable, model: Model) -> DwellTable:
    """The dwells with readings that no longer contain the known effects of a model.

    A triangle [1 u u^2 ... | z] with z less the columns times the coefficients is the triangle times a unit matrix with
    these in it, so that no second pass is needed. They are linearised at the nominal parameters.
    """
    if not model.known or not dwells:
        return dwells
    effects, sizes = [each.effect for each in model.known], np.concatenate([each.coefficients for each in model.known])
    columns = candidate_columns(dwells, effects, model.bench, model.nominal_state())
    return dwells.plus(-on_basis(columns.values @ sizes))


def columns_of(dwells: DwellTable, model: Model, state: Floats) -> OfPieces:
    """The model's columns at the nodes of each dwell, (pieces, K nodes, 3 channels, p)."""
    stimulus = stimulus_of(dwells, model.bench, state)
    return _by_dwell(dwells.folded, lambda s: model.columns(s, state), stimulus)


def candidate_columns(
    dwells: DwellTable, effects: Sequence[Effect], bench: Bench, state: Floats, stimulus: Stimulus | None = None
) -> OfPieces:
    """The columns of effects that are not in the model, in the form of ``columns_of``; ``stimulus`` may be given if it
    is known."""
    stimulus = stimulus or stimulus_of(dwells, bench, state)
    return _by_dwell(dwells.folded, lambda s: effect_columns(effects, s), stimulus)


def _by_dwell(folded: FoldedDwells, columns: Callable[[Stimulus], Floats], stimulus: Stimulus) -> OfPieces:
    """Arrange the columns of a stimulus (m, 3, p) by dwell; of dwells of which only the mean is known they are those at
    the middle node."""
    if not folded.shows_means_only or stimulus.carrier_hz:
        return OfPieces(_by_piece(columns, stimulus), folded.ends)
    middle = columns(stimulus.at(slice(1, None, 3)))[:, None]
    return OfPieces(np.broadcast_to(middle, (len(middle), 3, *middle.shape[2:])), folded.ends)


def _by_piece(columns: Callable[[Stimulus], Floats], stimulus: Stimulus) -> Floats:
    """Arrange the columns of a stimulus (m, 3, p) by piece; on a carrier the nodes of both envelopes follow those of
    the plain part."""
    parts = [columns(stimulus)]
    if stimulus.carrier_hz:
        parts += [columns(replace(stimulus, part=part)) for part in (1, 2)]
    shaped = [part.reshape(len(part) // 3, 3, *part.shape[1:]) for part in parts]
    return np.concatenate(shaped, axis=1) if len(shaped) > 1 else shaped[0]


def few_at_a_time(
    dwells: DwellTable, stimulus: Stimulus, columns: int
) -> Iterator[tuple[slice, DwellTable, slice, Stimulus]]:
    """Yield few dwells at a time, whose columns are made together: which they are, the dwells, which pieces they have,
    and the stimulus at their nodes."""
    ends, first, most = dwells.folded.ends, 0, max(IN_MEMORY // (9 * max(columns, 1)), 1)
    while first < len(dwells):
        last = max(int(np.searchsorted(ends, ends[first] + most, "right")) - 1, first + 1)
        pieces = slice(int(ends[first]), int(ends[last]))
        whole = last - first == len(dwells)
        nodes = stimulus if whole else stimulus.at(slice(3 * pieces.start, 3 * pieces.stop))
        yield slice(first, last), dwells[first:last], pieces, nodes
        first = last


class LinearisedDwells:
    """Dwells with the columns of a model: the common input of noise model, filter and diagnosis.

    ``state`` (p,) is where rotations and input axes are linearised. The attribute ``dwells_at_state`` has the dwells as
    the function of this name returns them: columns are made from these, and rows are whitened with them. ``slews`` and
    ``slew_columns`` belong to the motions and are used only if an effect of the model shows in slews; everything else
    refers to dwells only.
    """

    def __init__(self, dwells: DwellTable, model: Model, state: Floats, slews: Sequence[Dwell] = ()) -> None:
        self.dwells, self.slews, self.model, self.state = dwells, list(slews), model, state
        self.dwells_at_state = dwells_at_state(self.dwells, model, state)
        self.slew_columns: Sequence[Floats] = []
        if not slews:
            self.columns: Sequence[Floats] = columns_of(self.dwells_at_state, model, state)
            return
        both = self.dwells_at_state.beside(DwellTable.of(self.slews))
        order = np.lexsort((both.folded.moving, both.folded.numbers))
        columns, moving = columns_of(both.take(order), model, state), both.folded.moving[order]
        self.columns = [columns[k] for k in np.flatnonzero(~moving).tolist()]
        self.slew_columns = [columns[k] for k in np.flatnonzero(moving).tolist()]

    def followed_by(self, dwell: DwellTable, like: DwellTable | None = None) -> LinearisedDwells:
        """The same with one more dwell; the columns of the others are not computed again.

        like: all of these dwells, where they are a table already.
        """
        longer = LinearisedDwells.__new__(LinearisedDwells)
        longer.dwells, longer.slews, longer.model, longer.state = (
            self.dwells.beside(dwell).sharing(like),
            self.slews,
            self.model,
            self.state,
        )
        longer.dwells_at_state = self.dwells_at_state.beside(dwell).sharing(longer.dwells)
        last = stimulus_of(longer.dwells_at_state, self.model.bench, self.state)
        last = last.at(slice(-3 * len(dwell.folded.pieces), None))
        longer.columns = [*self.columns, *_by_dwell(dwell.folded, lambda s: self.model.columns(s, self.state), last)]
        longer.slew_columns = self.slew_columns
        return longer

    def with_columns(self, columns: Sequence[Floats]) -> LinearisedDwells:
        """The same dwells with other columns (pieces, K nodes, 3, c) of each: those of the first c states alone."""
        other = LinearisedDwells.__new__(LinearisedDwells)
        other.dwells, other.slews, other.model, other.state = self.dwells, self.slews, self.model, self.state
        other.dwells_at_state, other.columns, other.slew_columns = (
            self.dwells_at_state,
            list(columns),
            self.slew_columns,
        )
        return other

    @cached_property
    def means(self) -> Means:
        """The means over each dwell."""
        return means_of(self.dwells_at_state, self.columns)

    @property
    def carrier_hz(self) -> float:
        """Frequency of the carrier on which the dwells were folded; 0 for none."""
        return self.dwells.folded.carrier_hz

    @property
    def sizes(self) -> Floats:
        """Largest change of a reading per unit of each state, (p,); 1 for a state that changes none."""
        design = self.means.design
        largest = np.maximum(design.max(axis=(0, 1)), -design.min(axis=(0, 1)))
        # oscillations average out in a mean
        seen_within = [own[:, 3:] for own in self.columns] if self.carrier_hz else []
        for own in (*seen_within, *self.slew_columns):
            largest = np.maximum(largest, np.abs(own).max(axis=(0, 1, 2)))
        return np.where(largest > 0, largest, 1.0)


def change_by_temperature(linearised: LinearisedDwells) -> Floats:
    """Change of the readings per K (m, 3) at the nodes of all dwells, by the model at its state."""
    model, state = linearised.model, linearised.state
    stimulus = stimulus_of(linearised.dwells_at_state, model.bench, state)
    warmer = replace(stimulus, temperature_c=stimulus.temperature_c + DIFFERENCE)
    return (model.columns(warmer, state) - model.columns(stimulus, state)) @ state / DIFFERENCE


def dwells_at_state(dwells: DwellTable, model: Model, state: Floats) -> DwellTable:
    """The dwells about which a model is linear in the rotations of its dwells.

    At ``state`` the effects of the frame turn the specific force f of a dwell by the rotation vector rho, its mean over
    the dwell, and the setting error turns it by alpha, so that S g + b is read, g = R(alpha) exp([rho]) f and S the
    sensitivities. What is still to be found (changes of coefficients, of S and of alpha) acts on g, which therefore
    takes the place of f. The columns of the effects there, times their coefficients, amount to S (R(alpha) rho x g),
    and alpha itself, about which the prior is zero, to S (alpha x g); as S g has both rotations in it already, they
    are added to the readings. An absurd rho is taken for none.
    """
    rotations = _rotations_of_effects(dwells, model, state)
    if rotations is None and dwells.attitudes is None:
        return dwells
    there = dwells.linearised(rotations, dwells.attitudes)
    change = turning_mps2(there, there.felt_force_mps2, state, 3 * there.folded.piece_numbers)
    if not change.any():
        return there
    nodes = np.zeros((len(change) // 3, dwells.folded.width, 3))
    nodes[:, :3] = change.reshape(-1, 3, 3)  # no part on a carrier
    return there.plus(on_basis(nodes))


def _rotations_of_effects(table: DwellTable, model: Model, state: Floats) -> Floats | None:
    """Return the mean rotation vector (D, 3) of each dwell by effects of the frame; None where there are none."""
    if not model.bench.angles or not any(isinstance(effect, RotationEffect) for effect in model.effects):
        return None
    rotations, ends = model.turned_rad(stimulus_of(table, model.bench, state), state), 3 * table.folded.ends
    means = np.add.reduceat(rotations, ends[:-1], axis=0) / np.diff(ends)[:, None]
    return means if 0.0 < np.abs(means).max() < FARTHEST_RAD else None


def turning_mps2(dwells: DwellTable, force_mps2: Floats, state: Floats, times: Indices | int) -> Floats:
    """By how much the rotations of turned dwells change readings (m, 3) to first order about the forces g (m, 3) that
    are felt, ``times`` of each dwell: S (rho x g) + (S + B) (alpha x g), with B the bending by effects."""
    sensitivity, change = state[:STATE_COUNT].reshape(3, 4)[:, :3], np.zeros_like(force_mps2)
    alpha = np.zeros((len(dwells), 3)) if dwells.attitudes is None else dwells.attitudes.rotation_rad
    if dwells.turned_rad is not None:
        rho = dwells.turned_rad + crossed(alpha, dwells.turned_rad)
        change += crossed(np.repeat(rho, times, axis=0), force_mps2) @ sensitivity.T
    if alpha.any():
        bent = np.repeat(sensitivity + dwells.bendings, times, axis=0)
        change += (bent @ crossed(np.repeat(alpha, times, axis=0), force_mps2)[:, :, None])[:, :, 0]
    return change
