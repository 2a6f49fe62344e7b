"""What the error of the temperature adds to the readings: the error of its course times the sensitivity to temperature.

An error in the variables, which counts as noise (W. Deming, 1943, the effective variance). The sensitivity is that of
the model at its estimate, as a function of the specific force f and of the temperature T: its values on the regressors
1, f, T and T f. For an effect with a memory of the temperature, it is that to a temperature that is wrong for long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.piece_values import OfPieces
from kf_calib.dwells.stack import DwellStack
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
    folded = DwellStack.of(dwells).folded
    errors_c = temperature_course(folded).errors_c
    if not errors_c.shape[1]:
        return None
    change = change_mps2_per_k()
    if not change.any():
        return None
    counts = np.repeat(folded.counts, 3 * folded.piece_numbers)
    variance = change**2 * np.sum(errors_c**2, axis=1, keepdims=True) * counts[:, None]
    if variance.max() < (_MATTERS * sigma_mps2.min()) ** 2:
        return None
    return np.asarray(np.linalg.lstsq(_regressors(dwells), change, rcond=1e-9)[0].T, float)


def thermometer_errors(dwells: Sequence[DwellFactor], sensitivity_mps2_per_k: Floats) -> OfPieces:
    """Changes of the readings at the nodes of each dwell by each independent error of the temperature of 1 sigma,
    (pieces, nodes, 3, k)."""
    folded = DwellStack.of(dwells).folded
    errors_c = temperature_course(folded).errors_c
    change = (_regressors(dwells) @ sensitivity_mps2_per_k.T)[:, :, None] * errors_c[:, None, :]
    columns = np.zeros((folded.ends[-1], folded.dwells[0].width, 3, errors_c.shape[1]))
    columns[:, :3] = change.reshape(-1, 3, *change.shape[1:])
    return OfPieces(columns, folded.ends)


def _regressors(dwells: Sequence[DwellFactor]) -> Floats:
    """Return 1, f, T and T f at the nodes of all dwells, (m, 8)."""
    stack = DwellStack.of(dwells)
    regressors = np.hstack([np.ones((len(stack.force_mps2), 1)), stack.force_mps2])
    warmth = temperature_course(stack.folded).temperature_c - REFERENCE_TEMPERATURE_C
    return np.hstack([regressors, warmth[:, None] * regressors])
