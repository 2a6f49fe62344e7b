"""The settings of a calibration, among them what is known of the parameters before the first reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.dwells.stationarity import Stillness
from kf_calib.errors import InputError, check_number

if TYPE_CHECKING:  # read only where one is given
    from kf_calib.estimation.bench_model import BenchModel


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


Engine = Literal["block", "filterpy"]


@dataclass(frozen=True)
class Settings:
    """The settings by which a run is evaluated; raises InputError if a value is not possible.

    - engine: the filter that is used.
    - prior: prior knowledge of the parameters.
    - stillness: tolerances by which dwells are recognised.
    - gate_sigma: limit of the innovation gate in robust standard deviations; None for no gate.
    - walk_mps2_per_sqrt_s: intensity of the random walk of the biases (process noise); 0 for none.
    - effects: names of the effects in the model, or the name of one.
    - window_s: length of the windows over which readings are averaged first. With 0 they are averaged only for effects
      that depend on vibration, over a second or as long as the observed vibration requires.
    - left_out: numbers of dwells (from 1) that are not used.
    - bench_model: errors of the bench that are known from many runs; they are subtracted, and their sigma considered.
    """

    engine: Engine = "block"
    prior: Prior = PRIORS["diffuse"]
    stillness: Stillness = field(default_factory=Stillness)
    gate_sigma: float | None = 6.0
    walk_mps2_per_sqrt_s: float = 0.0
    effects: Sequence[str] = ()
    window_s: float = 0.0
    left_out: tuple[int, ...] = ()
    bench_model: BenchModel | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", (self.effects,) if isinstance(self.effects, str) else tuple(self.effects))
        if self.engine not in get_args(Engine):
            raise InputError(f"engine {self.engine!r} is not known: use {' or '.join(get_args(Engine))}.")
        if self.bench_model is not None and self.engine != "block":
            raise InputError("the filterpy engine takes no bench model (--bench-model): use --engine block.")
        if not isinstance(self.prior, Prior):
            known = 'kf_calib.estimation.settings.PRIORS["navigation"]'
            raise InputError(f"prior is {self.prior!r}: give a Prior, for example {known}.")
        if not isinstance(self.stillness, Stillness):
            raise InputError(f"stillness is {self.stillness!r}: give a kf_calib.dwells.stationarity.Stillness.")
        if self.gate_sigma is not None:
            check_number("gate_sigma (--gate-sigma)", self.gate_sigma, 3.0)
        check_number("walk_mps2_per_sqrt_s (--bias-walk)", self.walk_mps2_per_sqrt_s)
        check_number("window_s", self.window_s)
