"""One dwell that alone does not fit: a pose mistyped or misread, a knock, a cable that pulled.

Each dwell is predicted by a fit to all others; its error e (3,) has the covariance C of that prediction and of its own
noise, and e^T C^-1 e / 3 is F distributed with 3 and nu degrees of freedom: nu is infinite where the noise from dwell
to dwell is stated, else what all others leave over to estimate it by. A dwell is outlying where this is beyond chance
at the level of the run, all others agree without it, and either a turn of one gimbal explains its readings or it is off
by more than any known effect makes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor, dwells_without
from kf_calib.estimation.dwell_columns import Carried, Means
from kf_calib.estimation.noise_model import lift_rounding, mean_covariances
from kf_calib.estimation.results import Calibration, OutlyingDwell, Turn
from kf_calib.support.tail_probabilities import f_tail

LEVEL = 1e-6  # of the run: a dwell that is called wrong must be so beyond doubt
_MOST_LEFT = -2.0 * math.log(1e-4)  # chi-squared that a turn leaves, of 2 degrees of freedom: three channels less it
_GROSS = 0.02  # g: more than a known effect makes in one dwell
_NEARLY = 0.3  # of the largest statistic: dwells as far off are tried too
_TRIED = 4
_GRID = 360  # turns at which a gimbal is tried first
_REFINED = 6  # steps of Gauss-Newton
_STEP = 1e-4  # rad, of its differences
_FARTHEST = 0.02  # rad, of one of its steps


def outlying_in_words(found: Sequence[OutlyingDwell]) -> str:
    """What is said of the dwells of which any one could be it; '' where there are none."""
    return " Or ".join(map(str, found))


def outlying_dwells(
    result: Calibration, evaluate: Callable[[list[DwellFactor]], Calibration]
) -> tuple[OutlyingDwell, ...]:
    """The dwell that alone does not fit; several where any one of them could be it, none where none does.

    evaluate: the calibration from some of the dwells, by the same model.
    """
    left_out, dwells = result.held_out, result.fit.dwells
    if left_out is None or len(dwells) < 6 or result.noise.walk_mps2_per_sqrt_s:
        return ()
    statistics = left_out.statistics
    if statistics.max() < 30.0:  # no dwell can be beyond the level
        return ()
    ratios = (statistics / statistics.max()).round(9)  # of dwells as far off, to rounding, the first comes first
    order = np.argsort(-ratios, kind="stable")[:_TRIED]
    tried = [k for k in order.tolist() if ratios[k] > _NEARLY]
    found = [_judged(result, k, evaluate(dwells_without(dwells, (k,)))) for k in tried]
    return tuple(each for each in found if each is not None)


def _judged(result: Calibration, k: int, rest: Calibration) -> OutlyingDwell | None:
    """Dwell ``k`` against the calibration from all others; None where they disagree too, or it is within chance."""
    if rest.consistency.consistent is not True:
        return None
    dwells, estimate, noise = result.fit.dwells, rest.estimate, rest.noise
    means = Carried(dwells, rest.model, estimate.state).means[[k]]
    error, covariance = means.readings[0] - means.design[0] @ estimate.state, _covariance(rest, means)
    freedom = 1e9 if noise.setting_stated and noise.scatter_stated else max(rest.consistency.dof, 1)
    statistic = float(error @ np.linalg.solve(covariance, error))
    p_value = min(len(dwells) * f_tail(3.0, freedom, statistic / 3.0), 1.0)
    if p_value > LEVEL:
        return None
    turns = tuple(_turns(dwells[k], means, rest))
    if not turns and np.linalg.norm(error) < _GROSS * result.bench.gravity_mps2:
        return None
    return OutlyingDwell(dwells[k], dwells[k].number, error, p_value, turns, rest)


def _covariance(rest: Calibration, means: Means) -> Floats:
    """Of the mean reading of one dwell less its prediction, (3, 3)."""
    design, estimate = means.design[0], rest.estimate
    own = mean_covariances(rest.noise, means, estimate.state)
    return lift_rounding(own + design @ estimate.covariance @ design.T)[0]


def _turns(dwell: DwellFactor, means: Means, rest: Calibration) -> Iterator[Turn]:
    """Turns of single gimbals with which the prediction would be right to within its covariance."""
    bench, state = rest.bench, rest.estimate.state
    at_s = np.array([0.5 * (dwell.start_s + dwell.end_s)])

    def at(gimbal: int, turn_rad: float) -> Means:
        """The dwell's means with the gravity that the platform would feel there."""
        pose = dwell.pose.copy()
        pose[gimbal] += turn_rad
        force, design = bench.specific_force(at_s, pose[None]), means.design.copy()
        for i in range(3):
            design[:, i, 4 * i : 4 * i + 3] = force
        return replace(means, force_mps2=force, design=design)

    def error(gimbal: int, turn_rad: float) -> Floats:
        return means.readings[0] - at(gimbal, turn_rad).design[0] @ state

    for gimbal, axis in enumerate(bench.to_metadata().get("axes", "").split()):
        grid = np.linspace(-np.pi, np.pi, _GRID, endpoint=False).tolist()
        turn = min(grid, key=lambda each, g=gimbal: float(np.sum(error(g, each) ** 2)))
        curvature = 1e-300
        for _ in range(_REFINED):  # Gauss-Newton, what is uncertain of the pose being so where it would be
            ahead, behind = (error(gimbal, turn + step) for step in (_STEP, -_STEP))
            slope, here, weight = (ahead - behind) / (2.0 * _STEP), error(gimbal, turn), _weight(rest, at(gimbal, turn))
            curvature = max(float(slope @ weight @ slope), 1e-300)
            turn -= min(max(float(slope @ weight @ here) / curvature, -_FARTHEST), _FARTHEST)
        here = error(gimbal, turn)
        if float(here @ _weight(rest, at(gimbal, turn)) @ here) < _MOST_LEFT:
            recorded = math.degrees(dwell.recorded_pose[gimbal])
            yield Turn(gimbal, axis, recorded, recorded + math.degrees(turn), math.degrees(curvature**-0.5))


def _weight(rest: Calibration, means: Means) -> Floats:
    return np.asarray(np.linalg.inv(_covariance(rest, means)), float)
