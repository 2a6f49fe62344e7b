"""Runs of single units: simulated through the nonlinear truth, each with 24 orientations of its own in random order."""

from __future__ import annotations

from collections.abc import Sequence

from kf_calib.estimation.calibration import calibrate
from kf_calib.fleet.run_factor import RunFactor, run_factor
from kf_calib.sources.simulation.options import simulation
from kf_calib.sources.simulation.settings import SimulationOptions

# Few readings, but half an hour of them, so that drifts and time constants show, and a temperature that changes.
_OPTIONS = {
    "dwell_s": 60.0, "sample_hz": 6.0, "angle_hz": 4.0, "slew_degps": 20.0, "setting_sigma_deg": 0.0002,
    "swing_c": 5.0, "period_s": 700.0, "warm_up_c": 4.0, "warm_up_s": 500.0,
}  # fmt: skip
_BENCH = {"gravity_mps2": "9.81", "latitude_deg": "50"}


def simulated(seed: int, hidden: Sequence[str] = ()) -> RunFactor:
    """Return the factor of a simulated run; hidden: effects as ``kf-calib simulate --hide`` takes them."""
    source = simulation(SimulationOptions.of(**_OPTIONS, seed=seed, hidden=tuple(hidden)), _BENCH)
    return run_factor(calibrate(source).fit)
