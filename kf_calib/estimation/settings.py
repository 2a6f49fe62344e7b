"""The settings of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

from kf_calib.dwells.stationarity import Stillness
from kf_calib.errors import InputError, check_number
from kf_calib.estimation.prior import PRIORS, Prior

if TYPE_CHECKING:  # read only where one is given
    from kf_calib.estimation.bench_model import BenchModel

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
            known = 'kf_calib.estimation.prior.PRIORS["navigation"]'
            raise InputError(f"prior is {self.prior!r}: give a Prior, for example {known}.")
        if not isinstance(self.stillness, Stillness):
            raise InputError(f"stillness is {self.stillness!r}: give a kf_calib.dwells.stationarity.Stillness.")
        if self.gate_sigma is not None:
            check_number("gate_sigma (--gate-sigma)", self.gate_sigma, 3.0)
        check_number("walk_mps2_per_sqrt_s (--bias-walk)", self.walk_mps2_per_sqrt_s)
        check_number("window_s", self.window_s)
