"""What is to be simulated: the run, the noise and the temperature; the command line knows it, so it imports little."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self

from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.bench.arrays import Floats
    from kf_calib.sources.simulation.sensors import TrueNoise


@dataclass(frozen=True)
class Ambient:
    """Temperature over time: constant + swing sin(2 pi t / period) - warm_up exp(-t / warm_up_s), degC."""

    constant_c: float = 25.0
    swing_c: float = 0.0
    period_s: float = 14400.0
    warm_up_c: float = 0.0
    warm_up_s: float = 1800.0
    sigma_c: float = 0.01  # noise of the recorded values
    step_c: float = 0.0  # their resolution; 0: not rounded

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, astuple(self))):
            raise InputError("a figure of the temperature is not a finite number: give one.")
        for words, value_s in (("period of the temperature", self.period_s), ("warm-up time", self.warm_up_s)):
            if not value_s > 0.0:
                raise InputError(f"the {words} is {value_s:g} s: give a positive time.")
        for words, value_c in (("noise", self.sigma_c), ("resolution", self.step_c)):
            if value_c < 0.0:
                raise InputError(f"the {words} of the thermometer is {value_c:g} K: give zero or a positive number.")
        coldest_c = self.constant_c - abs(self.swing_c) - max(self.warm_up_c, 0.0)
        if coldest_c < -273.15:
            raise InputError(f"the temperature falls to {coldest_c:g} degC, below absolute zero: give a warmer one.")

    def __call__(self, time_s: Floats) -> Floats:
        import numpy as np

        swing = self.swing_c * np.sin(2.0 * np.pi * time_s / self.period_s)
        return self.constant_c + swing - self.warm_up_c * np.exp(-time_s / self.warm_up_s)

    def rate(self, time_s: Floats) -> Floats:
        """Its rate of change, K/s."""
        import numpy as np

        swing = 2.0 * np.pi * self.swing_c / self.period_s * np.cos(2.0 * np.pi * time_s / self.period_s)
        return swing + self.warm_up_c / self.warm_up_s * np.exp(-time_s / self.warm_up_s)


@dataclass(frozen=True)
class NoiseOptions:
    """Fields of ``TrueNoise``; None: as the grade has it."""

    white_mps2: float | None = None
    ar1_phi: float | None = None
    flicker_mps2: float | None = None
    walk_mps2_per_sqrt_s: float | None = None
    scatter_mps2: float | None = None
    setting_sigma_deg: float | None = None
    encoder_sigma_deg: float | None = None
    encoder_step_deg: float | None = None
    outlier_rate: float | None = None
    outlier_mps2: float | None = None
    vibration_mps2: float | None = None

    def over(self, noise: TrueNoise) -> TrueNoise:
        """That noise, with what is stated here in its place."""
        stated = {each.name: getattr(self, each.name) for each in fields(self)}
        return replace(noise, **{name: value for name, value in stated.items() if value is not None})


@dataclass(frozen=True)
class SimulationOptions:
    """What is simulated; ``kf-calib simulate --help-all`` says what each is."""

    grade: Literal["paper", "navigation", "mems"] = "navigation"
    plan: str = "spread"
    count: int = 24
    dwell_s: float = 30.0
    sample_hz: float = 100.0
    angle_hz: float = 10.0
    slew_degps: float = 20.0
    seed: int = 0
    unstated: bool = False
    hidden: tuple[str, ...] = ()
    noise: NoiseOptions = NoiseOptions()
    ambient: Ambient = field(default_factory=Ambient)

    @classmethod
    def of(cls, **values: Any) -> Self:
        """From values by name, those of noise and ambient among them."""
        noise, ambient = ({each.name: values.pop(each.name) for each in fields(kind) if each.name in values}
                          for kind in (NoiseOptions, Ambient))  # fmt: skip
        return cls(**values, noise=NoiseOptions(**noise), ambient=Ambient(**ambient))
