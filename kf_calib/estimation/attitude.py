"""The attitude of each dwell, on the sphere: where it most likely stands, given the readings and the state.

A setting error alpha turns the specific force, and R(alpha) f is never longer than f. The model f + alpha x f about the
force that the angles show is therefore wrong by half the square of alpha, along the force, where the readings are exact
to their noise. So each dwell is linearised about its own posterior mode, which is found in turn with the state: the
fixed point of an iterated Kalman update, and least squares with the state and all alpha free (``fit``). Where no angles
are used, alpha has no prior, and the size of the force is all that is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import turn_by
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.attitude_error import AttitudeError
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect, FrameEffect, Stimulus
from kf_calib.estimation.dwell_columns import LinearisedDwells, stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.nuisance_states import rotation_map, tangents

_STEP = 1e-6  # relative to g, of the differences that give the bending
_ABRUPT = 0.5  # a bending beyond this is a jump of an effect's column, which has no derivative
_FARTHEST_RAD = 0.3  # of one step of an attitude
_UNTOLD = 10.0  # setting errors: where the poses spread less, the attitudes would tell as much as they


def at_their_modes(
    linearised: LinearisedDwells, noise: Noise, state: Floats, untold: Floats | None = None
) -> list[DwellFactor]:
    """The dwells with attitudes at their posterior modes at ``state`` (p,), to first order about where they were.

    Dwells stay as they are where no setting error is allowed for. Where it is only considered (``Noise.checked``),
    attitudes stay as recorded, and the force is shorter by what the setting error takes from its mean.

    untold: the ``untold_directions`` of the run, where the dwells are not all of it.
    """
    if not noise.setting_rad:
        return [without_attitude(dwell) for dwell in linearised.dwells]
    bendings = bendings_of(linearised, state)
    if not noise.checked:
        known = [AttitudeError(np.zeros(3), 2.0 * noise.setting_rad**2, bending) for bending in bendings]
        return [d.linearised(d.turned_rad, attitude) for d, attitude in zip(linearised.dwells, known, strict=True)]
    moved, variances = _posterior_rotations(linearised.means, noise, state, bendings)
    forces = linearised.means.force_mps2 / np.array([_length(dwell) for dwell in linearised.dwells])[:, None]
    if noise.attitude_unknown:
        forces = np.array([turn_by(force, _limited(step)) for force, step in zip(forces, moved, strict=True)])
        return _facing(linearised.dwells, forces, variances, noise, state, bendings)
    untold = untold_directions(linearised, noise) if untold is None else untold
    dwells = list[DwellFactor]()
    for k, (dwell, turned) in enumerate(zip(linearised.dwells, linearised.dwells_at_state, strict=True)):
        before = np.zeros(3) if dwell.attitude is None else dwell.attitude.rotation_rad
        force = turn_by(forces[k], _limited(moved[k] - before))
        attitude = AttitudeError(np.zeros(3), float(variances[k]), bendings[k])
        shown = _shown_force(turned)
        force = force - untold.T @ (untold @ (force - shown))
        dwells.append(dwell.linearised(None, replace(attitude, rotation_rad=rotation_between(shown, force))))
    return dwells


def _facing(
    dwells: Sequence[DwellFactor], forces: Floats, variances: Floats, noise: Noise, state: Floats, bendings: Floats
) -> list[DwellFactor]:
    """Return dwells of no known attitude with forces (D, 3), of components across them with ``variances`` (D,)."""
    variances = variances + _wander_rad2(dwells, noise, state, forces)
    facing = list[DwellFactor]()
    for dwell, force, variance_rad2, bending in zip(dwells, forces, variances.tolist(), bendings, strict=True):
        facing.append(with_force(dwell, force, AttitudeError(np.zeros(3), variance_rad2, bending), state))
    return facing


def without_attitude(dwell: DwellFactor) -> DwellFactor:
    """The dwell linearised about the force that its pose shows."""
    return dwell.linearised(dwell.turned_rad, None) if dwell.attitude else dwell


def untold_directions(linearised: LinearisedDwells, noise: Noise) -> Floats:
    """The unit vectors (k, 3) along which the poses of all dwells have the force alike, to some setting errors: the
    readings cannot tell the sensitivity to a force along them.

    The attitudes must not tell it either: with a very large sensitivity, tiny rotations along such a direction would
    explain every misfit. So the force along it stays as the poses show it.
    """
    if not noise.setting_rad or noise.attitude_unknown:
        return np.zeros((0, 3))
    units = np.array([_shown_force(turned) for turned in linearised.dwells_at_state])
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    variances, directions = np.linalg.eigh(np.cov(units.T, bias=True))
    return directions.T[variances < (_UNTOLD * noise.setting_rad) ** 2]


def _shown_force(turned: DwellFactor) -> Floats:
    """Return the mean specific force (3,) that the recorded pose of a dwell shows."""
    return without_attitude(turned).felt_force(turned.means[None, 1:4])[0]


def _wander_rad2(dwells: Sequence[DwellFactor], noise: Noise, state: Floats, forces: Floats) -> Floats:
    """Return the mean square (D,) of the angle by which the force wanders about its mean within each dwell: what the
    readings spread across it beyond their noise. A hand creeps and trembles, and a mean of directions is shorter than
    each."""
    inverse = np.linalg.inv(state[:STATE_COUNT].reshape(3, 4)[:, :3])
    spreads = np.array([dwell.spread for dwell in dwells])
    beyond = inverse @ (spreads - np.diag(noise.sigma_mps2**2)) @ inverse.T
    squares = np.sum(forces**2, axis=1)
    across = np.einsum("dii->d", beyond) - np.einsum("di,dij,dj->d", forces, beyond, forces) / squares
    return np.clip(across / squares, 0.0, _FARTHEST_RAD**2)


def _length(dwell: DwellFactor) -> float:
    return 1.0 if dwell.attitude is None else dwell.attitude.length


def _posterior_rotations(means: Means, noise: Noise, state: Floats, bendings: Floats) -> tuple[Floats, Floats]:
    """Return the modes (D, 3) of the setting errors about the forces in ``means``, and the sums (D,) of the variances
    of their two components across the force."""
    axes = tangents(means.force_mps2)
    sensitivities = state[:STATE_COUNT].reshape(3, 4)[:, :3] + bendings
    columns = rotation_map(means.force_mps2, sensitivities, axes)
    weights = 1.0 / (noise.effective_sigma_mps2**2 / means.counts[:, None] + noise.scatter_mps2**2)
    weighted = np.swapaxes(columns * weights[:, :, None], 1, 2)
    prior = 0.0 if noise.attitude_unknown else 1.0 / noise.setting_rad**2
    covariances = np.linalg.inv(weighted @ columns + prior * np.eye(2))
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
    stimulus = stimulus_of(dwells, model.bench, state)
    step_mps2, firsts = _STEP * model.bench.gravity_mps2, np.cumsum([0, *(3 * len(d.pieces) for d in dwells)])[:-1]
    counts = np.array([3 * len(dwell.pieces) for dwell in dwells])[:, None]
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
        if not (isinstance(effect, FrameEffect) or effect.dynamic or effect.oscillates or effect.no_columns)
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


def rotation_between(one: Floats, other: Floats) -> Floats:
    """The rotation vector (3,) of the shortest turn from the direction of one vector (3,) to that of another."""
    across = np.cross(one, other)
    sine = float(np.linalg.norm(across))
    return across * (np.arctan2(sine, one @ other) / sine) if sine else np.zeros(3)


def _limited(rotation_rad: Floats) -> Floats:
    """Return a rotation vector no longer than a step may be."""
    angle_rad = float(np.linalg.norm(rotation_rad))
    return rotation_rad * min(1.0, _FARTHEST_RAD / angle_rad) if angle_rad else rotation_rad


def with_force(dwell: DwellFactor, force_mps2: Floats, attitude: AttitudeError | None, state: Floats) -> DwellFactor:
    """The dwell with another specific force at all its nodes, and a pose that has it up, of an arbitrary heading. The
    dwell before it, where that was left out, has the force that its own readings show at ``state``."""
    size_mps2 = float(np.linalg.norm(force_mps2))
    before = dwell.came_from and facing_readings([dwell.came_from], state, size_mps2)[0]
    return dwell.with_force(force_mps2, _pose(force_mps2 / size_mps2), attitude, before)


def _pose(unit: Floats) -> Floats:
    """Return the quaternion (x, y, z, w) of the shortest rotation that brings a direction up, that is to +y."""
    x, y, z = unit
    if y < -1.0 + 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.array([-z, 0.0, x, 1.0 + y])
    return quaternion / np.linalg.norm(quaternion)


def force_shown(readings: Floats, state: Floats) -> Floats:
    """Specific force (D, 3) by the mean readings (D, 3) alone: S^-1 (z - b)."""
    affine = state[:STATE_COUNT].reshape(3, 4)
    return np.asarray(np.linalg.solve(affine[:, :3], (readings - affine[:, 3]).T).T, float)


def facing_readings(dwells: Sequence[DwellFactor], state: Floats, gravity_mps2: float) -> list[DwellFactor]:
    """The dwells with the specific force that their mean readings alone show at ``state``, S^-1 (z - b) with the size
    of g: where the search for attitudes that are not known begins."""
    forces = force_shown(np.array([dwell.means[4:] for dwell in dwells]), state)
    forces *= gravity_mps2 / np.linalg.norm(forces, axis=1, keepdims=True)
    return [with_force(dwell, force, dwell.attitude, state) for dwell, force in zip(dwells, forces, strict=True)]
