"""The search for one dwell that alone does not fit: a pose mistyped or misread, a knock, a cable that pulled.

Each dwell is predicted by a fit to all others. Its error e (3,) has the covariance C, the sum of that of the prediction
and of the dwell's own noise, and e^T C^-1 e / 3 is F distributed with 3 and nu degrees of freedom, those that the other
dwells leave: where these are few, they agree by chance whatever is missing. Where scatter was stated, it may be 1/f
noise or a walk, which neighbouring dwells share: what leaving the dwell out takes off the chi-squared of the run in
such noise is then less than e^T C^-1 e, and counts in its place.

A dwell is outlying if three things hold: its error is significant at the level of the run, all other dwells are
consistent without it, and either a rotation of one gimbal explains its readings or its error is larger than any known
effect causes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.attitude import without_attitudes
from kf_calib.estimation.dwell_columns import LinearisedDwells, turning_mps2
from kf_calib.estimation.results import Calibration, OutlyingDwell, Turn, consistency
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import lift_rounding, mean_covariances
from kf_calib.support.tail_probabilities import f_tail

_BEYOND_DOUBT = 1e-6  # significance over the whole run; a dwell must be wrong beyond doubt
_MOST_LEFT = -2.0 * math.log(1e-4)  # limit of chi-squared after a rotation; three channels less one angle leave 2 dof
_GROSS = 0.02  # g; larger than any known effect in one dwell
_NEARLY = 0.3  # relative to the largest statistic; dwells above it are tried, too
_TRIED = 4
_GRID = 360  # rotations of a gimbal that are tried first
_REFINED = 6  # Gauss-Newton steps
_STEP = 1e-4  # rad, for difference quotients
_FARTHEST = 0.02  # rad, largest Gauss-Newton step


def outlying_in_words(found: Sequence[OutlyingDwell]) -> str:
    """A sentence on the outlying dwell, or on those of which any one could be it; '' if there is none."""
    return " Or ".join(map(str, found))


def outlying_dwells(result: Calibration, evaluate: Callable[[DwellTable], Calibration]) -> tuple[OutlyingDwell, ...]:
    """The dwell that alone does not fit, or several if any one of them could be the cause; empty if none is.

    ``evaluate`` makes a calibration from some of the dwells with the same model.
    """
    left_out, dwells = result.held_out, result.fit.dwells
    if left_out is None or not result.bench.angles or len(dwells) < 6 or result.noise.walk_mps2_per_sqrt_s:
        return ()
    statistics = left_out.statistics
    if statistics.max() < 30.0:  # no dwell can be significant
        return ()
    ratios = (statistics / statistics.max()).round(9)  # rounded, so that the first of equal dwells comes first
    order = np.argsort(-ratios, kind="stable")[:_TRIED]
    tried = [k for k in order.tolist() if ratios[k] > _NEARLY]
    found = ((k, evaluate(dwells.without((k,)))) for k in tried)
    judged = [wrong_dwell(result, k, rest, _BEYOND_DOUBT) for k, rest in found if rest.consistency.consistent is True]
    gross_mps2 = _GROSS * result.bench.gravity_mps2
    return tuple(each for each in judged if each and (each.turns or np.linalg.norm(each.error_mps2) > gross_mps2))


def wrong_dwell(result: Calibration, k: int, rest: Calibration, most_p: float = 1.0) -> OutlyingDwell | None:
    """Dwell ``k`` against the calibration from all others; None if its p-value is larger than ``most_p``."""
    dwells, estimate = result.fit.dwells, rest.estimate
    linearised = LinearisedDwells(without_attitudes(dwells), rest.model, estimate.state)
    means = linearised.means[[k]]
    error, covariance = means.readings[0] - means.design[0] @ estimate.state, _covariance(rest, means)
    statistic = min(float(error @ np.linalg.solve(covariance, error)), _fall(result, rest))
    p_value = min(len(dwells) * f_tail(3.0, max(rest.consistency.dof, 1), statistic / 3.0), 1.0)
    if p_value > most_p:
        return None
    turns = tuple(_turns(linearised.dwells_at_state[k : k + 1], means, rest))
    return OutlyingDwell(dwells[k], dwells[k].number, error, p_value, turns, rest)


def _fall(result: Calibration, rest: Calibration) -> float:
    """Return by how much chi-squared falls without the dwell, in the noise of the other dwells."""
    with_all = consistency(replace(result.fit, noise=rest.noise))
    return max(with_all.statistic - rest.consistency.statistic, 0.0)


def _covariance(rest: Calibration, means: Means) -> Floats:
    """Return the covariance (3, 3) of one dwell's mean reading less its prediction."""
    design, estimate = means.design[0], rest.estimate
    own = mean_covariances(rest.noise, means, estimate.state)
    return lift_rounding(own + design @ estimate.covariance @ design.T)[0]


def _turns(alone: DwellTable, means: Means, rest: Calibration) -> Iterator[Turn]:
    """Yield the rotations of single gimbals with which the prediction of one dwell is correct to within its
    covariance."""
    bench, state, (dwell,) = rest.bench, rest.estimate.state, alone
    at_s = np.array([0.5 * (dwell.start_s + dwell.end_s)])

    def at(gimbal: int, turn_rad: float) -> Means:
        """Return the dwell's means with the specific force that the platform would have at this angle of the gimbal."""
        pose = dwell.pose.copy()
        pose[gimbal] += turn_rad
        force, design = alone.felt(bench.specific_force(at_s, pose[None])), means.design.copy()
        for i in range(3):
            design[:, i, 4 * i : 4 * i + 3] = force
        return replace(means, force_mps2=force, design=design, readings=means.readings + there(force))

    def there(force: Floats) -> Floats:
        """Return by how much more effects turn the readings at another specific force."""
        return turning_mps2(alone, force - means.force_mps2, state, 1)

    def error(gimbal: int, turn_rad: float) -> Floats:
        other = at(gimbal, turn_rad)
        return other.readings[0] - other.design[0] @ state

    for gimbal, axis in enumerate(bench.to_metadata().get("axes", "").split()):
        grid = np.linspace(-np.pi, np.pi, _GRID, endpoint=False).tolist()
        turn = min(grid, key=lambda each, g=gimbal: float(np.sum(error(g, each) ** 2)))
        curvature = 1e-300
        for _ in range(_REFINED):  # Gauss-Newton, with the pose's uncertainty taken at the new angle
            ahead, behind = (error(gimbal, turn + step) for step in (_STEP, -_STEP))
            slope, here, weight = (ahead - behind) / (2.0 * _STEP), error(gimbal, turn), _weight(rest, at(gimbal, turn))
            curvature = max(float(slope @ weight @ slope), 1e-300)
            turn -= min(max(float(slope @ weight @ here) / curvature, -_FARTHEST), _FARTHEST)
        here = error(gimbal, turn)
        if float(here @ _weight(rest, at(gimbal, turn)) @ here) < _MOST_LEFT:
            recorded = math.degrees(dwell.recorded_pose[gimbal])
            mended = _written_as(recorded, recorded + math.degrees(turn))
            yield Turn(gimbal, axis, recorded, mended, math.degrees(curvature**-0.5))


def _written_as(recorded_deg: float, angle_deg: float) -> float:
    """Return an angle between the same limits as one that was recorded: -180 to 180 deg, 0 to 360, or none."""
    if abs(recorded_deg) <= 180.0:
        return (angle_deg + 180.0) % 360.0 - 180.0
    return angle_deg % 360.0 if 0.0 <= recorded_deg < 360.0 else angle_deg


def _weight(rest: Calibration, means: Means) -> Floats:
    """Return the inverse covariance of the dwell's error."""
    return np.asarray(np.linalg.inv(_covariance(rest, means)), float)
