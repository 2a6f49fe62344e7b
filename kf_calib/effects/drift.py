"""What changes with time: drift of bias and scale factor, history of the poses."""

from __future__ import annotations

import numpy as np

from kf_calib.effects.effect import G, SensorEffect
from kf_calib.effects.stimulus import Stimulus
from kf_calib.samples import Floats


class BiasDrift(SensorEffect):
    """beta t, t since the first sample."""

    name, title, source = "bias-drift", "bias that drifts with time", "IEEE Std 1293, drift"
    confused_with = "warm-up; a monotone order of poses mixes it with angle"
    symbol, unit, scale, shown = "beta", "m/s^3", 1e-6, ("µg/h", 3600e6 / G)

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.elapsed_s[:, None], 3, axis=1)


class ScaleDrift(SensorEffect):
    """kappa t a_i."""

    name, title, source = "scale-drift", "scale factor that drifts with time", "IEEE Std 1293, drift"
    confused_with = "base-tilt-drift"
    symbol, unit, scale, shown = "kappa", "1/s", 1e-7, ("ppm/h", 3600e6)

    def terms(self, s: Stimulus) -> Floats:
        return s.elapsed_s[:, None] * s.along


class Hysteresis(SensorEffect):
    """h sgn(Delta a_i), Delta a_i the last step of the input."""

    name, title, source = "hysteresis", "reading that depends on the side it was come from", "IEEE Std 1293, hysteresis"
    confused_with = "needs the same pose from two sides"
    symbol, unit, scale, shown = "h", "m/s^2", 1e-3, ("µg", 1e6 / G)

    def terms(self, s: Stimulus) -> Floats:
        return np.sign(np.where(np.abs(s.step) > 1e-6 * G, s.step, 0.0))
