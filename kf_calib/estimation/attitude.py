"""The attitude of each dwell, on the sphere: where it most likely stands, given the readings and the state.

A setting error alpha turns the specific force, and R(alpha) f is never longer than f. The model f + alpha x f about the
force that the angles show is therefore wrong by half the square of alpha, along the force, where the readings are exact
to their noise. So each dwell is linearised about its own posterior mode, which is found in turn with the state: the
fixed point of an iterated Kalman update, and least squares with the state and all alpha free (``fit``), by Gauss-Newton
steps with a line search. Where no angles are used, alpha has no prior, and the size of the force is all that is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import DIFFERENCE, ROUNDING, Floats, crossed
from kf_calib.bench.bench import turn_by, turned
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.table import Attitudes, DwellTable
from kf_calib.effects import Effect, RotationEffect, Stimulus
from kf_calib.estimation.dwell_columns import FARTHEST_RAD, LinearisedDwells, stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, lift_rounding
from kf_calib.noise.rotations import rotation_map, tangents
from kf_calib.support.searches import MOST_STEPS

_ABRUPT = 0.5  # a bending beyond this is a jump of an effect's column, which has no derivative
_UNTOLD = 10.0  # setting errors: where the poses spread less, the attitudes would tell as much as they

SETTLED = 2.5e-4
"""A smaller step ends the search: in sigmas of each state, or as a share of the largest that a constant may take."""
UNSETTLED = 1.0
"""In sigmas: a fit whose last step was larger has not converged."""


def at_their_modes(
    linearised: LinearisedDwells, noise: Noise, state: Floats, untold: Floats | None = None
) -> DwellTable:
    """The dwells with attitudes at their posterior modes at ``state`` (p,), to first order about where they were.

    Dwells stay as they are where no setting error is allowed for. Where it is only considered (``SettingError``),
    attitudes stay as recorded, and the force is shorter by what the setting error takes from its mean.

    untold: the ``untold_directions`` of the run, where the dwells are not all of it.
    """
    table = linearised.dwells
    if not noise.setting_rad:
        return without_attitudes(table)
    bendings = bendings_of(linearised, state)
    if noise.setting.considered:
        variances = np.full(len(table), 2.0 * noise.setting_rad**2)
        return table.linearised(table.turned_rad, Attitudes(np.zeros((len(table), 3)), variances, bendings))
    moved, variances = _posterior_rotations(linearised.means, noise, state, bendings)
    forces, before = linearised.means.force_mps2, np.zeros((len(table), 3))
    if table.attitudes is not None:
        forces, before = forces / table.attitudes.length[:, None], table.attitudes.rotation_rad
    if noise.attitude_unknown:
        return _facing(table, turned(forces, _limited(moved)), variances, noise, state, bendings)
    untold = untold_directions(linearised, noise) if untold is None else untold
    shown = _shown_forces(linearised.dwells_at_state)
    forces = turned(forces, _limited(moved - before))
    forces = forces - (forces - shown) @ untold.T @ untold
    return table.linearised(None, Attitudes(rotations_between(shown, forces), variances, bendings))


def _facing(
    table: DwellTable, forces: Floats, variances: Floats, noise: Noise, state: Floats, bendings: Floats
) -> DwellTable:
    """Return dwells of no known attitude with forces (D, 3), of components across them with ``variances`` (D,)."""
    variances = variances + _wander_rad2(table, noise, state, forces)
    return with_forces(table, forces, Attitudes(np.zeros((len(table), 3)), variances, bendings), state)


def without_attitudes(dwells: DwellTable) -> DwellTable:
    """The dwells linearised about the forces that their poses show."""
    return dwells if dwells.attitudes is None else dwells.linearised(dwells.turned_rad, None)


def untold_directions(linearised: LinearisedDwells, noise: Noise) -> Floats:
    """The unit vectors (k, 3) along which the poses of all dwells have the force alike, to some setting errors: the
    readings cannot tell the sensitivity to a force along them.

    The attitudes must not tell it either: with a very large sensitivity, tiny rotations along such a direction would
    explain every misfit. So the force along it stays as the poses show it.
    """
    if not noise.setting_rad or noise.attitude_unknown:
        return np.zeros((0, 3))
    units = _shown_forces(linearised.dwells_at_state)
    units = units / np.linalg.norm(units, axis=1, keepdims=True)
    variances, directions = np.linalg.eigh(np.cov(units.T, bias=True))
    return directions.T[variances < (_UNTOLD * noise.setting_rad) ** 2]


def _shown_forces(table: DwellTable) -> Floats:
    """Return the mean specific forces (D, 3) that the recorded poses show."""
    shown = table.means[:, 1:4]
    return shown if table.turned_rad is None else turned(shown, table.turned_rad)


def _wander_rad2(table: DwellTable, noise: Noise, state: Floats, forces: Floats) -> Floats:
    """Return the mean square (D,) of the angle by which the force wanders about its mean within each dwell: what the
    readings spread across it beyond their noise. A hand creeps and trembles, and a mean of directions is shorter than
    each."""
    inverse = np.linalg.inv(state[:STATE_COUNT].reshape(3, 4)[:, :3])
    beyond = inverse @ (table.folded.spreads - np.diag(noise.sigma_mps2**2)) @ inverse.T
    squares = np.sum(forces**2, axis=1)
    across = np.einsum("dii->d", beyond) - np.einsum("di,dij,dj->d", forces, beyond, forces) / squares
    return np.clip(across / squares, 0.0, FARTHEST_RAD**2)


def _posterior_rotations(means: Means, noise: Noise, state: Floats, bendings: Floats) -> tuple[Floats, Floats]:
    """Return the modes (D, 3) of the setting errors about the forces in ``means``, and the sums (D,) of the variances
    of their two components across the force."""
    axes = tangents(means.force_mps2)
    sensitivities = state[:STATE_COUNT].reshape(3, 4)[:, :3] + bendings
    columns = rotation_map(means.force_mps2, sensitivities, axes)
    spreads = noise.of_means(means.counts, means.correlations) + np.diag(noise.scatter_mps2**2)
    weighted = np.swapaxes(np.linalg.solve(spreads, columns), 1, 2)
    prior = 0.0 if noise.attitude_unknown else 1.0 / noise.setting_rad**2
    covariances = np.linalg.inv(lift_rounding(weighted @ columns + prior * np.eye(2)))
    errors = means.readings - means.design @ state
    modes = covariances @ weighted @ errors[:, :, None]
    return (axes @ modes)[:, :, 0], np.einsum("dii->d", covariances)


def bendings_of(linearised: LinearisedDwells, state: Floats) -> Floats:
    """By how much the effects of the model change the mean readings of each dwell per unit of force, (D, 3, 3), from
    central differences; zeros for effects that turn the platform, oscillate, or show in slews only."""
    model, dwells = linearised.model, linearised.dwells_at_state
    bendings, bent = np.zeros((len(dwells), 3, 3)), bent_effects(model, state)
    if not bent:
        return bendings
    stimulus, folded = stimulus_of(dwells, model.bench, state), dwells.folded
    step_mps2, firsts = DIFFERENCE * model.bench.gravity_mps2, 3 * folded.ends[:-1]
    counts = 3 * folded.piece_numbers[:, None]
    for axis in range(3):
        more, less = (
            added_by(bent, replace(stimulus, force_mps2=stimulus.force_mps2 + step * np.eye(3)[axis]), model, state)
            for step in (step_mps2, -step_mps2)
        )
        bendings[:, :, axis] = np.add.reduceat((more - less) / (2.0 * step_mps2), firsts, axis=0) / counts
    return np.where(np.abs(bendings) < _ABRUPT, bendings, 0.0)


def bent_effects(model: Model, state: Floats) -> list[Effect]:
    """The effects of a model that depend on the force in dwells, as far as their coefficients in ``state`` are not
    zero."""
    return [
        effect
        for effect in model.effects
        if not (isinstance(effect, RotationEffect) or effect.dynamic or effect.oscillates or effect.no_columns)
        and state[model.parts[str(effect)]].any()
    ]


def added_by(effects: Sequence[Effect], stimulus: Stimulus, model: Model, state: Floats) -> Floats:
    """What effects of a model add to the readings, (m, 3), with their coefficients in ``state`` (p,)."""
    added_mps2 = np.zeros((len(stimulus), 3))
    for effect in effects:
        added_mps2 += effect.added(stimulus, state[model.parts[str(effect)]][: len(effect.coefficients)])
    return added_mps2


def matrix_of(rotation_rad: Floats) -> Floats:
    """The rotation matrix (3, 3) of a rotation vector (3,)."""
    return np.array([turn_by(axis, rotation_rad) for axis in np.eye(3)]).T


def rotations_between(one: Floats, other: Floats) -> Floats:
    """The rotation vectors (D, 3) of the shortest turns from the directions of vectors (D, 3) to those of others."""
    across = crossed(one, other)
    sines = np.linalg.norm(across, axis=1, keepdims=True)
    angles = np.arctan2(sines, (one * other).sum(axis=1, keepdims=True))
    return across * np.where(sines > 0.0, angles / np.where(sines > 0.0, sines, 1.0), 0.0)


def _limited(rotations_rad: Floats) -> Floats:
    """Return rotation vectors (D, 3) no longer than a step may be."""
    angles_rad = np.linalg.norm(rotations_rad, axis=1, keepdims=True)
    return rotations_rad * np.minimum(1.0, FARTHEST_RAD / np.maximum(angles_rad, 1e-300))


def with_forces(dwells: DwellTable, forces_mps2: Floats, attitudes: Attitudes | None, state: Floats) -> DwellTable:
    """The dwells with other specific forces (D, 3), each at all nodes of its dwell, and poses that have them up, of an
    arbitrary heading. The dwell before one, where that was left out, has the force that its own readings show at
    ``state``."""
    sizes_mps2 = np.linalg.norm(forces_mps2, axis=1)
    before = dwells.came_from and facing_readings(dwells.came_from, state, sizes_mps2)
    facing = forces_mps2, _poses(forces_mps2 / sizes_mps2[:, None])
    return replace(dwells, attitudes=attitudes, facing=facing, came_from=before)


def _poses(units: Floats) -> Floats:
    """Return the quaternions (D, 4) x, y, z, w of the shortest rotations that bring directions (D, 3) up, to +y."""
    x, y, z = units.T
    quaternions = np.stack([-z, np.zeros_like(x), x, 1.0 + y], axis=1)
    quaternions[y < -1.0 + 1e-12] = [1.0, 0.0, 0.0, 0.0]
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def force_shown(readings: Floats, state: Floats) -> Floats:
    """Specific force (D, 3) by the mean readings (D, 3) alone: S^-1 (z - b)."""
    affine = state[:STATE_COUNT].reshape(3, 4)
    return np.asarray(np.linalg.solve(affine[:, :3], (readings - affine[:, 3]).T).T, float)


def facing_readings(dwells: DwellTable, state: Floats, gravity_mps2: Floats | float) -> DwellTable:
    """The dwells with the specific force that their mean readings alone show at ``state``, S^-1 (z - b) with the size
    of g, one or (D,): where the search for attitudes that are not known begins."""
    forces = force_shown(dwells.means[:, 4:], state)
    forces *= (gravity_mps2 / np.linalg.norm(forces, axis=1))[:, None]
    return with_forces(dwells, forces, dwells.attitudes, state)


def relinearised(
    linearised: LinearisedDwells, noise: Noise, model: Model, state: Floats, untold: Floats | None = None
) -> LinearisedDwells:
    """The dwells with the columns of a model at a state, and attitudes where the readings show them there.

    untold: as in ``at_their_modes``.
    """
    known = state if len(state) == linearised.model.count else linearised.state
    return LinearisedDwells(at_their_modes(linearised, noise, known, untold), model, state, linearised.slews)


def _farthest_rad(one: LinearisedDwells, other: LinearisedDwells) -> float:
    """Return the largest angle between the forces of two linearisations of the same dwells."""
    unit, there = (c.means.force_mps2 / np.linalg.norm(c.means.force_mps2, axis=1, keepdims=True) for c in (one, other))
    return float(np.linalg.norm(unit - there, axis=1).max())


def linearised_at(
    dwells: DwellTable, model: Model, state: Floats, noise: Noise, untold: Floats | None = None
) -> LinearisedDwells:
    """Dwells with the columns of a model at a state, and attitudes where the readings show them there.

    untold: as in ``at_their_modes``.
    """
    if noise.attitude_unknown:
        dwells = facing_readings(dwells, state, model.bench.gravity_mps2)
    linearised = LinearisedDwells(dwells, model, state)
    for _ in range(MOST_STEPS if noise.setting_rad else 1):
        before, linearised = linearised, relinearised(linearised, noise, model, state, untold)
        if _farthest_rad(before, linearised) < ROUNDING:
            break
    return linearised


def at_its_mode(dwell: DwellTable, so_far: LinearisedDwells, noise: Noise) -> DwellTable:
    """A dwell that follows those ``so_far``, with its attitude where its readings show it at their state: the iterated
    update of a filter by one dwell."""
    if not noise.setting_rad:
        return dwell
    both, untold = so_far.dwells[-1:].beside(dwell), untold_directions(so_far, noise)
    return linearised_at(both, so_far.model, so_far.state, noise, untold).dwells[1:]


def left_to_settle(state: Floats, before: Floats, sigma: Floats) -> float:
    """By how many of their sigmas (p,) the states moved at most; those without a sigma are not determined."""
    return float((np.abs(state - before) / np.where(sigma > 0, sigma, np.inf)).max())


def descended(
    linearised: LinearisedDwells, noise: Noise, state: Floats, misfit: Callable[[LinearisedDwells], float]
) -> LinearisedDwells:
    """The dwells linearised at ``state``, or on the way to it where the misfit is less there.

    misfit: of a linearisation at its own state, the sum of squares of all readings and all setting errors over their
    sigmas.
    """
    model, begin, share = linearised.model, linearised.state, 1.0
    highest = misfit(linearised) * (1.0 + ROUNDING)
    nearest = relinearised(linearised, noise, model, state)
    while share > SETTLED and misfit(nearest) > highest:
        share *= 0.5
        nearest = relinearised(linearised, noise, model, begin + share * (state - begin))
    return nearest
