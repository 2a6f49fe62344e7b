"""Which conditions the paper's non-optimal column was made under, as far as Table 2 tells.

All of this is inference from twelve printed figures. Many conditions are tried, so the nearest ones fit somewhat
better than they deserve; what the print's own scatter would leave stands beside them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import DEVIATIONS
from kf_calib.reproduction import grebenkin2019
from kf_calib.reproduction.grebenkin2019 import (
    GRAVITY_MPS2,
    NOISE_MPS2,
    READINGS_PER_DWELL,
    SAMPLED,
    TOGETHER,
    TURNS,
    Conditions,
)

PERIODS_S = np.geomspace(2.0, 60.0, 48)
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)


@dataclass(frozen=True)
class ConditionFit:
    """Conditions, and the rms over the twelve of ln(expected / print) under them."""

    conditions: Conditions
    log_ratio: float


@dataclass(frozen=True)
class ConditionSearch:
    """The nearest conditions of all that were tried: accelerometers read together, and one after another.

    floor: the least rms log-ratio of any conditions in which all three accelerometers see the same vectors.
    scatter: what the print's own scatter would leave. bias_excess (3,): see ``bias_excess``.
    """

    tried: int
    together: ConditionFit
    in_turn: ConditionFit
    floor: float
    scatter: float
    bias_excess: Floats


def search(latitude_deg: float = Conditions.latitude_deg) -> ConditionSearch:
    """Every reading of the turns, order of sampling, azimuth in steps of 15 deg, and 48 periods from 2 to 60 s."""
    fits = [
        fit for azimuth in AZIMUTHS_DEG.tolist() for fit in _nearest_periods(Conditions(1.0, latitude_deg, azimuth))
    ]
    together, in_turn = (
        min((f for f in fits if (f.conditions.sampled == TOGETHER) is kind), key=lambda f: f.log_ratio)
        for kind in (True, False)
    )
    excess = bias_excess(grebenkin2019.printed_column(grebenkin2019.NONOPTIMAL_PRINTED))
    tried = len(fits) * len(PERIODS_S)
    return ConditionSearch(
        tried, together, in_turn, shared_floor(), grebenkin2019.scatter(grebenkin2019.REPETITIONS), excess
    )


def _nearest_periods(base: Conditions) -> Iterator[ConditionFit]:
    """The nearest period for every reading of the turns and order of sampling, by the closed form."""
    column, vertical = grebenkin2019.printed_column(grebenkin2019.NONOPTIMAL_PRINTED), _vertical(base)
    attitudes = {turns: base.bench.attitude(grebenkin2019.attitudes(turns)) for turns in TURNS}
    for turns, sampled in product(TURNS, SAMPLED):
        moments = _moments(vertical, attitudes[turns], sampled)
        figures = grebenkin2019.log_ratio(grebenkin2019.expected_of(grebenkin2019.normal_of(moments)), column)
        best = int(figures.argmin())
        conditions = replace(base, period_s=float(PERIODS_S[best]), turns=turns, sampled=sampled)
        yield ConditionFit(conditions, float(figures[best]))


def _vertical(base: Conditions) -> Floats:
    """Sums of [f, 1][f, 1]^T over stretches of 100 readings, the platform at zero: (P, 12 stretches, 4, 4)."""
    elapsed_s = np.outer(PERIODS_S, np.arange(12 * READINGS_PER_DWELL))
    still = np.tile([0.0, 0.0, 0.0, 1.0], (elapsed_s.size, 1))
    force = base.bench.specific_force(elapsed_s.ravel(), still)
    rows = np.column_stack([force, np.ones(len(force))]).reshape(len(PERIODS_S), 12, READINGS_PER_DWELL, 4)
    return rows.swapaxes(-1, -2) @ rows


def _moments(vertical: Floats, attitudes: Floats, sampled: str) -> Floats:
    """What each accelerometer sees in the four attitudes (4, 3, 3): (P, 1 or 3, 4, 4)."""
    rotations = np.zeros((4, 4, 4))  # [f, 1] in the platform is [f, 1] in the bench times this
    rotations[:, :3, :3], rotations[:, 3, 3] = attitudes, 1.0
    if sampled == TOGETHER:
        return (rotations.swapaxes(1, 2) @ vertical[:, :4] @ rotations).sum(axis=1)[:, None]
    in_turn = vertical.reshape(-1, 4, 3, 4, 4)[:, :, [sampled.index(i) for i in "123"]]
    return (rotations[:, None].swapaxes(2, 3) @ in_turn @ rotations[:, None]).sum(axis=1)


def shared_floor() -> float:
    """The least rms log-ratio to Table 2 while all three accelerometers see the same vectors, whatever these are.

    Along x, y and z of the platform the error of the sensitivity is then the same for all three, to first order in the
    nominal 0.5 deg: theta1, theta3, K2 g show that along y, phi1, nu2, K3 that along z, nu1, phi3, K1 that along x,
    and the three biases have one error. The best any conditions can do is the geometric mean of each four.
    """
    error = grebenkin2019.printed_column(grebenkin2019.NONOPTIMAL_PRINTED) * DEVIATIONS
    groups = (("theta1", "theta3", "K2"), ("phi1", "nu2", "K3"), ("nu1", "phi3", "K1"), ("b1", "b2", "b3"))
    logs = np.log([[error[paper_parameters.SYMBOLS.index(symbol)] for symbol in group] for group in groups])
    return float(np.sqrt(np.mean((logs - logs.mean(axis=1, keepdims=True)) ** 2)))


def bias_excess(column: Floats) -> Floats:
    """sigma of each bias over the most that the accelerometer's other three figures allow, (3,); above 1: impossible.

    The errors e of an unbiased fit leave 4 sigma^2 in the sum of (e_s . f_j + e_b)^2 over n readings, so that
    sigma_b <= g |sigma_s| + 2 sigma / sqrt(n), whatever the vectors f_j of length g; |sigma_s|: of K and both angles.
    """
    sigma = (column / 100 * DEVIATIONS * math.sqrt(math.pi / 2)).reshape(3, 4)
    most = GRAVITY_MPS2 * np.linalg.norm(sigma[:, :3], axis=1) + 2 * NOISE_MPS2 / math.sqrt(4 * READINGS_PER_DWELL)
    return sigma[:, 3] / most
