"""Calibrations of sensors that are stated, and readings to correct with them."""

from collections.abc import Callable
from functools import cache

import numpy as np

import kf_calib
from helpers.paths import RECORDINGS
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.estimation.correction import Correction
from kf_calib.estimation.measurement_model import Model
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration

BENCH = Bench(axes=axes_of("yzx"), gravity_mps2=9.81)
COLD_C, WARM_C = 5.0, 45.0
Formula = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Specific force (n, 3) from readings (n, 3) and temperatures (n,)."""


@cache
def saved() -> SavedCalibration:
    """A calibration file's content; tests state numbers of their own in a ``Correction``."""
    source = kf_calib.open_recording(RECORDINGS / "navigation_24.mcap")
    found = calibration_file.saved(kf_calib.calibrate(source), "navigation_24.mcap")
    conditions = found.conditions.model_copy(update={"temperature_min_c": COLD_C, "temperature_max_c": WARM_C})
    return found.model_copy(update={"conditions": conditions})


def correction(*names: str, size: float = 3.0, turned: float = 1e-2, bias: float = 0.05) -> Correction:
    """Sensors near x, y, z with these effects, each ``size`` times as large as what a user would call large."""
    rng = np.random.default_rng(7)
    model = Model.of(BENCH, names)
    scale = np.diag(1.0 + rng.normal(size=3) * 5e-3)
    rows = np.column_stack([scale + turned * rng.normal(size=(3, 3)), bias * rng.normal(size=3)])
    large = np.array([min(size * each.scale, 0.3) for each in model.coefficients])
    state = np.concatenate([rows.ravel(), rng.choice([-1.0, 1.0], len(large)) * large])
    return Correction(BENCH, model, state, 1e-16 * np.eye(len(state)), np.full(3, 1e-5))


def samples(count: int = 20_000, sizes: tuple[float, float] = (1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Specific force in any direction, and temperatures, at random."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(count, 3))
    length = BENCH.gravity_mps2 * rng.uniform(*sizes, size=(count, 1))
    force = length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return force, rng.uniform(COLD_C, WARM_C, count)
