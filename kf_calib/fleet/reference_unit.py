"""A unit whose scale factors are known from elsewhere: against it, an error of the gravity that a bench uses shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import triangle
from kf_calib.errors import InputError, check_number
from kf_calib.fleet.run_factor import STATES, RunFactor


@dataclass(frozen=True)
class ReferenceUnit:
    """unit: its name in the runs. scale (3,): its scale factors K1, K2, K3. sigma (3,): how well these are known.
    sha256: of the recording that they are from.

    One run cannot tell a wrong gravity from scale factors that are all wrong by the same share. Runs of a unit whose
    scale factors are known can.
    """

    unit: str
    scale: tuple[float, float, float]
    sigma: tuple[float, float, float]
    sha256: str | None = None

    def __post_init__(self) -> None:
        for scale, sigma in zip(self.scale, self.sigma, strict=True):
            check_number(f"a scale factor of the reference unit {self.unit}", scale)
            check_number(f"a sigma of the reference unit {self.unit}", sigma)
            if not sigma:
                raise InputError(f"the reference unit {self.unit} has a sigma of 0: state how well it is known.")

    def known(self, factor: RunFactor, runs: int) -> Floats:
        """The factor [H | G | z] of a run of this unit with what is known of it: K_i = s_i . E_i as three readings.

        runs: how many of this unit there are. What is known is known once, so each of them has its share of it.

        Raises InputError if the run has not all twelve states, as without angles.
        """
        if len(factor.states) < len(STATES):
            raise InputError(f"{factor.run}: the reference unit {self.unit} needs a run with platform angles.")
        upper, width = factor.factor, factor.width
        states = np.linalg.lstsq(upper[:width, :width], upper[:width, -1], rcond=1e-12)[0]
        rows, sigma = np.zeros((3, upper.shape[1])), np.sqrt(runs) * np.array(self.sigma)
        for i in range(3):
            own = [factor.places[f"s{part}{i + 1}"] for part in "xyz"]
            rows[i, own] = states[own] / np.linalg.norm(states[own]) / sigma[i]
            rows[i, -1] = self.scale[i] / sigma[i]
        return triangle(np.vstack([upper, rows]))
