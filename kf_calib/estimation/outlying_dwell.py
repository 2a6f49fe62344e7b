"""The search for one dwell that alone does not fit: a pose mistyped or misread, a knock, a cable that pulled.

Each dwell is predicted by a fit to all others. Its error e (3,) has the covariance C, the sum of that of the prediction
and of the dwell's own noise, and e^T C^-1 e / 3 is F distributed with 3 and nu degrees of freedom, those that the other
dwells leave: where these are few, they agree by chance whatever is missing. Where scatter was stated, it may be 1/f
noise or a walk, which neighbouring dwells share: what leaving the dwell out takes off the chi-squared of the run in
such noise is then less than e^T C^-1 e, and counts in its place.

A dwell is outlying if its error is significant, as one of as many as there are dwells, and all others are consistent
without it. A turn of one gimbal moves the force along a circle, so that the error is u + v cos + w sin of the angle.
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
from kf_calib.support.tail_probabilities import LEVEL, REST, chi_squared_tail, f_tail


def outlying_in_words(found: Sequence[OutlyingDwell]) -> str:
    """A sentence on the outlying dwell, or on those of which any one could be it; '' if there is none."""
    return " Or ".join(map(str, found))


def outlying_dwells(result: Calibration, evaluate: Callable[[DwellTable], Calibration]) -> tuple[OutlyingDwell, ...]:
    """The dwell that alone does not fit, or several if any one of them could be the cause; empty if none is.

    They are tried in the order of what leaving them out takes off the misfit, while the others agree. ``evaluate``
    makes a calibration from some of the dwells with the same model.
    """
    left_out, dwells, wrong = result.held_out, result.fit.dwells, list[OutlyingDwell]()
    if left_out is None or not result.bench.angles or result.noise.walk.steps:
        return ()
    ratios = (left_out.statistics / left_out.statistics.max()).round(9)  # the first of equal dwells comes first
    for k in np.argsort(-ratios, kind="stable").tolist():
        if len(dwells) * chi_squared_tail(3.0, float(left_out.statistics[k])) > LEVEL * REST:
            break
        rest = evaluate(dwells.without((k,)))
        found = wrong_dwell(result, k, rest)
        if rest.consistency.consistent is not True or found.p_value > LEVEL * REST:
            break
        wrong.append(found)
    return tuple(wrong)


def wrong_dwell(result: Calibration, k: int, rest: Calibration) -> OutlyingDwell:
    """Dwell ``k`` against the calibration from all others."""
    dwells, estimate = result.fit.dwells, rest.estimate
    linearised = LinearisedDwells(without_attitudes(dwells), rest.model, estimate.state)
    means = linearised.means[[k]]
    error, covariance = means.readings[0] - means.design[0] @ estimate.state, _innovation_covariance(rest, means)
    statistic = min(float(error @ np.linalg.solve(covariance, error)), _fall(result, rest))
    p_value = min(len(dwells) * f_tail(3.0, max(rest.consistency.dof, 1), statistic / 3.0), 1.0)
    turns = tuple(_turns(linearised.dwells_at_state[k : k + 1], means, rest))
    return OutlyingDwell(dwells[k], dwells[k].number, error, p_value, turns, rest)


def _fall(result: Calibration, rest: Calibration) -> float:
    """Return by how much chi-squared falls without the dwell, in the noise of the other dwells."""
    with_all = consistency(replace(result.fit, noise=rest.noise))
    return max(with_all.statistic - rest.consistency.statistic, 0.0)


def _innovation_covariance(rest: Calibration, means: Means) -> Floats:
    """Return the covariance (3, 3) of one dwell's mean reading less its prediction."""
    design, estimate = means.design[0], rest.estimate
    own = mean_covariances(rest.noise, means, estimate.state)
    return lift_rounding(own + design @ estimate.covariance @ design.T)[0]


def _turns(alone: DwellTable, means: Means, rest: Calibration) -> Iterator[Turn]:
    """Yield the rotations of single gimbals with which the prediction of one dwell is correct to within its
    covariance."""
    bench, state, (dwell,) = rest.bench, rest.estimate.state, alone
    at_s = np.array([0.5 * (dwell.start_s + dwell.end_s)])

    def at(gimbal: int, turn_rad: float) -> tuple[Floats, Floats]:
        """Return the error (3,) with the specific force that the platform would have at this angle of the gimbal, and
        the inverse of its covariance (3, 3)."""
        pose = dwell.pose.copy()
        pose[gimbal] += turn_rad
        force, design = alone.felt(bench.specific_force(at_s, pose[None])), means.design.copy()
        for i in range(3):
            design[:, i, 4 * i : 4 * i + 3] = force
        readings = means.readings + turning_mps2(alone, force - means.force_mps2, state, 1)
        there = replace(means, force_mps2=force, design=design, readings=readings)
        return (readings - design @ state)[0], np.asarray(np.linalg.inv(_innovation_covariance(rest, there)), float)

    for gimbal, axis in enumerate(bench.to_metadata().get("axes", "").split()):
        (here, weight), (across, _), (opposite, _) = (at(gimbal, turn) for turn in (0.0, 0.5 * np.pi, np.pi))
        middle, cosine = 0.5 * (here + opposite), 0.5 * (here - opposite)
        sine, turn = across - middle, 0.0
        for _ in range(2):  # the second time by the covariance there
            turn = _least(middle, cosine, sine, weight)
            weight = at(gimbal, turn)[1]
        error, slope = at(gimbal, turn)[0], sine * math.cos(turn) - cosine * math.sin(turn)
        sigma_rad = max(float(slope @ weight @ slope), 1e-300) ** -0.5
        left = chi_squared_tail(2.0, float(error @ weight @ error))  # three channels less one angle
        if left > LEVEL * REST and sigma_rad < np.pi:
            recorded = math.degrees(dwell.recorded_pose[gimbal])
            mended = _written_as(recorded, recorded + math.degrees(turn))
            yield Turn(gimbal, axis, recorded, mended, math.degrees(sigma_rad))


def _least(middle: Floats, cosine: Floats, sine: Floats, weight: Floats) -> float:
    """Return the angle at which e = middle + cosine cos + sine sin (3,) is least by e^T weight e.

    Of z = exp(i angle) the derivative is a polynomial of degree 4, whose roots on the unit circle are the extrema.
    """
    wave = 0.5 * (cosine - 1j * sine)  # e = middle + wave z + its conjugate
    twice, once = 2j * (wave @ weight @ wave), 2j * (middle @ weight @ wave)
    roots = np.roots(np.array([twice, once, 0.0, np.conj(once), np.conj(twice)]))
    angles = np.append(np.angle(roots), 0.0)
    errors = middle[:, None] + np.outer(cosine, np.cos(angles)) + np.outer(sine, np.sin(angles))
    return float(angles[np.einsum("in,ij,jn->n", errors, weight, errors).argmin()])


def _written_as(recorded_deg: float, angle_deg: float) -> float:
    """Return an angle between the same limits as one that was recorded: -180 to 180 deg, 0 to 360, or none."""
    if abs(recorded_deg) <= 180.0:
        return (angle_deg + 180.0) % 360.0 - 180.0
    return angle_deg % 360.0 if 0.0 <= recorded_deg < 360.0 else angle_deg
