"""Prior knowledge of the parameters before the first reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.errors import check_number


@dataclass(frozen=True)
class Prior:
    """Prior standard deviations of misalignment (rad), scale factor (1) and bias (m/s^2).

    ``Prior()`` is diffuse: it contains no information, and the estimate equals that of least squares.
    """

    misalignment_rad: float | None = None
    scale: float | None = None
    bias_mps2: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                check_number(f"the prior's {name}", value)

    @property
    def diffuse(self) -> bool:
        """Whether any of the sigmas is missing, so that the prior contains no information."""
        return self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None

    def covariance(self, parameters: Floats) -> Floats:
        """Covariance (12, 12) of the affine state about the nominal ``parameters`` (12,)."""
        if self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None:
            raise ValueError("a diffuse prior has no covariance")
        sigma = np.array([self.misalignment_rad, self.misalignment_rad, self.scale, self.bias_mps2] * 3)
        jacobian = paper_parameters.sensitivity_jacobian(parameters)
        return jacobian @ np.diag(sigma**2) @ jacobian.T


PRIORS: dict[str, Prior] = {
    "diffuse": Prior(),
    "navigation": Prior(misalignment_rad=5e-3, scale=2e-3, bias_mps2=2e-2),
    "mems": Prior(misalignment_rad=0.1, scale=0.1, bias_mps2=1.0),
}
"""Priors by grade of accelerometer; each is about twice as wide as the specification of sensors of that grade."""
