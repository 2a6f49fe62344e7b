"""Where the axes across the input axes lie: a term of the noise of a model with effects."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from kf_calib.bench.arrays import DIFFERENCE, Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.attitude import added_by, bent_effects, matrix_of
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.terms import FLOOR_MPS2, NoiseTerm, Scope


@dataclass(frozen=True)
class AxesAcross(NoiseTerm):
    """The pendulous and output axis of each accelerometer, which are known no better than the input axes are aligned.

    Effects have them along the axes of the platform, or of the frame of the sensors where there are no angles. Each
    error turns those of one accelerometer by 1 sigma about one axis, and so changes its readings in each dwell in
    proportion to what the effects of the ``model`` are at ``state`` (p,) in its mean. With square axes, |f| does not
    tell the three coefficients of some effects from each other; what else would is no more than this uncertainty.
    """

    model: Model
    state: Floats
    scope: ClassVar[Scope] = "run"

    @property
    def sizes(self) -> Floats:
        """The root of the mean square (1,) of the angles that input axes may have, and have, from their nominal
        axes."""
        has, nominal = (_unit_axes(state) for state in (self.state, self.model.nominal_state()))
        square = float(np.sum(np.cross(has, nominal) ** 2)) / max(2 * len(has) - len(self.model.fixed), 1)
        return np.array([max(math.sqrt(square), 0.0 if self.model.bench.angles else self.model.bench.square_rad)])

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        del state
        folded, to_sigma = dwells.folded, 0.5 * self.sizes / DIFFERENCE
        effects, stimulus = bent_effects(self.model, self.state), stimulus_of(dwells, self.model.bench, self.state)
        changes = np.zeros((len(stimulus), 3, 3, 3))  # pieces, channels, accelerometers that are turned, axes
        for axis in range(3):
            ends = list[Floats]()
            for sign in (1.0, -1.0):
                turn = matrix_of(sign * DIFFERENCE * np.eye(3)[axis])
                turned = replace(
                    stimulus, force_mps2=stimulus.force_mps2 @ turn.T, sensitivity=stimulus.sensitivity @ turn.T,
                    previous_force_mps2=stimulus.previous_force_mps2 @ turn.T,
                )  # fmt: skip
                ends.append(added_by(effects, turned, self.model, self.state))
            changes[:, [0, 1, 2], [0, 1, 2], axis] = (ends[0] - ends[1]) * to_sigma
        of_dwells = folded.weighted(changes.reshape(-1, 3, 3, 9).mean(axis=1))
        of_dwells = of_dwells[..., np.abs(of_dwells).max(axis=(0, 1)) > FLOOR_MPS2]
        return folded.at_nodes(np.repeat(of_dwells, 3 * folded.piece_numbers, axis=0)).values


def _unit_axes(state: Floats) -> Floats:
    """Return the unit input axes (3, 3) of a state (p,)."""
    sensitivity = state[:STATE_COUNT].reshape(3, 4)[:, :3]
    return sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
