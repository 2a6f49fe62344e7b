"""What the error of the temperature adds to the readings: the error of its course times the sensitivity to temperature.

An error in the variables, which counts as noise (W. Deming, 1943, the effective variance). The sensitivity is that of
the model at its estimate, as a function of the specific force f and of the temperature T: its values on the regressors
1, f, T and T f. For an effect with a memory of the temperature, it is that to a temperature that is wrong for long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.noise.temperature_course import temperature_course

_MATTERS = 0.1  # share of the sigma of the mean of a dwell above which the error counts


def sensitivity_to_temperature(
    dwells: Sequence[DwellFactor], change_mps2_per_k: Callable[[], Floats], sigma_mps2: Floats
) -> Floats | None:
    """Change of the readings per K (3, 8) on the regressors 1, f, T, T f; None where the error of the temperature does
    not matter.

    change_mps2_per_k: gives the change per K (m, 3) at the nodes of all dwells by the model at its state. sigma_mps2
    (3,): noise of white readings.
    """
    errors_c = temperature_course(tuple(dwells)).errors_c
    if not errors_c.shape[1]:
        return None
    change = change_mps2_per_k()
    if not change.any():
        return None
    counts = np.repeat([dwell.count for dwell in dwells], [3 * len(dwell.pieces) for dwell in dwells])
    variance = change**2 * np.sum(errors_c**2, axis=1, keepdims=True) * counts[:, None]
    if variance.max() < (_MATTERS * sigma_mps2.min()) ** 2:
        return None
    return np.asarray(np.linalg.lstsq(_regressors(dwells), change, rcond=1e-9)[0].T, float)


def thermometer_errors(dwells: Sequence[DwellFactor], sensitivity_mps2_per_k: Floats) -> list[Floats]:
    """Changes of the readings at the nodes of each dwell by each independent error of the temperature of 1 sigma,
    (pieces, nodes, 3, k)."""
    errors_c = temperature_course(tuple(dwells)).errors_c
    change = (_regressors(dwells) @ sensitivity_mps2_per_k.T)[:, :, None] * errors_c[:, None, :]
    counts = [len(dwell.pieces) for dwell in dwells]
    parts = np.split(change, 3 * np.cumsum(counts)[:-1])
    columns = [
        np.zeros((count, dwell.width, 3, errors_c.shape[1])) for count, dwell in zip(counts, dwells, strict=True)
    ]
    for at_nodes, part in zip(columns, parts, strict=True):
        at_nodes[:, :3] = part.reshape(len(at_nodes), *at_nodes[:, :3].shape[1:])
    return columns


def _regressors(dwells: Sequence[DwellFactor]) -> Floats:
    """Return 1, f, T and T f at the nodes of all dwells, (m, 8)."""
    regressors = np.concatenate([dwell.nodes.regressors for dwell in dwells])
    warmth = temperature_course(tuple(dwells)).temperature_c - REFERENCE_TEMPERATURE_C
    return np.hstack([regressors, warmth[:, None] * regressors])
