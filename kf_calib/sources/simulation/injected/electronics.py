"""What happens to the readings on their way into the recording, in this order."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import SimulatedBench, made
from kf_calib.sources.simulation.physics import Disturbance, TrueState, TrueStep, adding, along, putting
from kf_calib.sources.simulation.sensors import OutlierProcess

_PAIRS = ("12", "13", "21", "23", "31", "32")


@made("cross-talk", "1", ("1ppm", "100ppm"), ("0.1permille", "2permille"), coefficients=_PAIRS)
def cross_talk(x: Floats, simulated: SimulatedBench) -> TrueStep:
    """Cross-talk: X_ij A_j of the other two readings, without their noise (acquisition chain)."""
    mixing = np.zeros((3, 3))
    mixing[~np.eye(3, dtype=bool)] = x
    return adding(lambda state: along(state.reading_mps2, mixing))


@made("outliers", "m/s^2", ("1mg", "100mg"), ("10mg", "1g"), stage="record", signed=False)
def outliers(size: Floats, simulated: SimulatedBench, *, rate: float = 1e-3) -> TrueStep:
    """Outliers: single readings jump by the size, either way, with probability ``rate`` (transmission)."""
    jumps = OutlierProcess(simulated.generator("outliers"), rate, 1.0)
    return Disturbance(lambda count: size * jumps(count))


@made("saturation", "m/s^2", ("0.7g", "0.98g"), ("0.7g", "0.98g"), stage="record", signed=False)
def saturation(limit: Floats, simulated: SimulatedBench) -> TrueStep:
    """Saturation: readings stop at -limit and +limit; 0 is no limit (IEEE Std 528, full range)."""
    least = np.where(limit > 0.0, limit, np.inf)
    return putting("reading_mps2", lambda state: np.clip(state.reading_mps2, -least, least))


@made("quantisation", "m/s^2", ("10ug", "1mg"), ("1mg", "50mg"), stage="record", signed=False)
def quantisation(step_size: Floats, simulated: SimulatedBench) -> TrueStep:
    """Quantisation: readings are whole multiples of the step (IEEE Std 952, Q)."""
    coarse = step_size > 0.0
    width = np.where(coarse, step_size, 1.0)

    def rounded(state: TrueState) -> Floats:
        return np.where(coarse, width * np.rint(state.reading_mps2 / width), state.reading_mps2)

    return putting("reading_mps2", rounded)
