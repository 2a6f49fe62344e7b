"""The nine parameters of the sensors that no choice of a frame changes, with the covariance that follows.

A turn of the platform's frame turns the input axes of all three accelerometers alike. What stays is the sensitivity of
each, the angle between each pair of axes, and the offset of each: the intrinsic parameters of J. Geist and M. Gaitan
(Journal of Research of NIST 126, 2021, article 126038). Errors that turn the whole block, as a tilt of the base does,
cancel in their angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats

SYMBOLS = ("S1", "S2", "S3", "angle12", "angle13", "angle23", "b1", "b2", "b3")
UNITS = ("1", "1", "1", "rad", "rad", "rad", "m/s^2", "m/s^2", "m/s^2")
_PAIRS = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Intrinsic:
    """Values (9,) and covariance (9, 9) in SI: sensitivities, angles between axes, offsets."""

    values: Floats
    covariance: Floats


def intrinsic(parameters: Floats, covariance: Floats) -> Intrinsic:
    """The nine of the twelve parameters (12,) with their covariance (12, 12), by the law of propagation (JCGM 102).

        S_i = |s_i|,  cos angle_ij = s_i . s_j / (S_i S_j),  b_i;  J = d nine / d state . d state / d twelve

    s_i: the sensitivities of accelerometer i, the first three states of its four.
    """
    state = paper_parameters.state_of(parameters).reshape(3, 4)
    sizes = np.linalg.norm(state[:, :3], axis=1)
    axes = state[:, :3] / sizes[:, None]
    gradient = np.zeros((9, 3, 4))
    gradient[[0, 1, 2], [0, 1, 2], :3] = axes
    gradient[[6, 7, 8], [0, 1, 2], 3] = 1.0
    angles = np.zeros(3)
    for k, (i, j) in enumerate(_PAIRS):
        cosine = float(axes[i] @ axes[j])
        angles[k] = np.arccos(cosine)
        sine = max(float(np.sin(angles[k])), 1e-12)
        gradient[3 + k, i, :3] = -(axes[j] - cosine * axes[i]) / (sine * sizes[i])
        gradient[3 + k, j, :3] = -(axes[i] - cosine * axes[j]) / (sine * sizes[j])
    jacobian = gradient.reshape(9, 12) @ paper_parameters.sensitivity_jacobian(parameters)
    return Intrinsic(np.concatenate([sizes, angles, state[:, 3]]), jacobian @ covariance @ jacobian.T)
