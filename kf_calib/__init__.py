"""kf_calib: sequential Kalman-filter calibration of accelerometers on a stationary gimballed bench.

    import kf_calib

    run = kf_calib.calibrate("run.mcap")        # or open_recording("bag", {"axes": "y z x"}), Settings(...)
    print(run)                                  # parameters, noise, verdict
    run.parameters["K1"].value, run.parameters["K1"].sigma
    print(kf_calib.diagnose(run).verdict)       # which physical effect is missing
    print(kf_calib.improve(run).reason)         # added, refitted, tested, until there is a reason to stop
    kf_calib.save_view(run, "run.rrd")          # opens in Rerun
    run.apply(readings).force_mps2              # readings corrected, with their uncertainty
    kf_calib.save_calibration(run, "cal.json", "run.mcap")
    kf_calib.open_calibration("cal.json").correction()(readings)

Conventions, kept everywhere:

- Readings are specific force in m/s^2: +g when the sensitive axis points up. reading_i = K_i E_i . f + b_i.
- Frames: n = North, Up, East; b = bench, n turned by the azimuth; p = platform, C_bp = Rot(axis1, q1) Rot(axis2, q2)...
  All angles zero: y up, accelerometer 2 reads +g. Right-handed, angles in rad, quaternions x y z w (platform -> bench).
- Time: stamps are integer nanoseconds (``time_ns``); ``elapsed_s`` counts from the first reading.
- Units are in the names: ``accel_mps2``, ``angle_sigma_deg``, ``gimbal_deg``, ``sigma_mps2``.
- Arrays have samples (n) or dwells (D) first: readings (n, 3), mean columns (D, 3, p). sigma is always 1 sigma.
- The affine state is (s1, b1, s2, b2, s3, b3), s_i = K_i E_i; the paper's theta, phi, nu, K, b follow in closed form.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from kf_calib.support.text import shown_by

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
    from kf_calib.diagnosis.missing_effect import diagnose
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.diagnosis.stepwise_selection import Improvement, improve
    from kf_calib.errors import InputError, KfCalibError, UnobservableError
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.correction import Corrected, Correction
    from kf_calib.estimation.engine_comparison import compare
    from kf_calib.estimation.results import Calibration, Parameter
    from kf_calib.estimation.settings import Settings
    from kf_calib.exchange.calibration_file import SavedCalibration, open_calibration, save_calibration
    from kf_calib.fleet.results import Fleet
    from kf_calib.fleet.results import Fleet as open_fleet
    from kf_calib.noise.rest_noise import RestNoise, noise_at_rest
    from kf_calib.online.sequential_test import RecursiveTest, SequentialTest
    from kf_calib.online.session import Session
    from kf_calib.sources.files.recorder import Recorder
    from kf_calib.sources.files.recording import Recording as open_recording
    from kf_calib.sources.text.lines import Lines as open_log
    from kf_calib.sources.text.means import open_table
    from kf_calib.support.units import shown_in
    from kf_calib.views import figures as plot
    from kf_calib.views.rerun import save_view

_HOMES = {
    "Bench": ("bench.bench", "Bench"),
    "Calibration": ("estimation.results", "Calibration"),
    "Parameter": ("estimation.results", "Parameter"),
    "Settings": ("estimation.settings", "Settings"),
    "calibrate": ("estimation.calibration", "calibrate"),
    "compare": ("estimation.engine_comparison", "compare"),
    "Corrected": ("estimation.correction", "Corrected"),
    "Correction": ("estimation.correction", "Correction"),
    "SavedCalibration": ("exchange.calibration_file", "SavedCalibration"),
    "open_calibration": ("exchange.calibration_file", "open_calibration"),
    "save_calibration": ("exchange.calibration_file", "save_calibration"),
    "Fleet": ("fleet.results", "Fleet"),
    "open_fleet": ("fleet.results", "Fleet"),
    "Diagnosis": ("diagnosis.results", "Diagnosis"),
    "diagnose": ("diagnosis.missing_effect", "diagnose"),
    "Improvement": ("diagnosis.stepwise_selection", "Improvement"),
    "improve": ("diagnosis.stepwise_selection", "improve"),
    "Refits": ("diagnosis.refits", "Refits"),
    "RestNoise": ("noise.rest_noise", "RestNoise"),
    "noise_at_rest": ("noise.rest_noise", "noise_at_rest"),
    "InputError": ("errors", "InputError"),
    "KfCalibError": ("errors", "KfCalibError"),
    "UnobservableError": ("errors", "UnobservableError"),
    "RecursiveTest": ("online.sequential_test", "RecursiveTest"),
    "Session": ("online.session", "Session"),
    "Recorder": ("sources.files.recorder", "Recorder"),
    "open_log": ("sources.text.lines", "Lines"),
    "open_recording": ("sources.files.recording", "Recording"),
    "open_table": ("sources.text.means", "open_table"),
    "save_view": ("views.rerun", "save_view"),
    "shown_in": ("support.units", "shown_in"),
    "SequentialTest": ("online.sequential_test", "SequentialTest"),
}

shown_by(lambda: import_module("kf_calib.views.html"))

__all__ = [
    "Bench", "Calibration", "Corrected", "Correction", "Diagnosis", "Fleet", "Improvement", "InputError",
    "KfCalibError", "Parameter", "Recorder", "RecursiveTest", "Refits", "RestNoise", "SavedCalibration",
    "SequentialTest", "Session", "Settings", "UnobservableError", "calibrate", "compare", "diagnose", "improve",
    "noise_at_rest", "open_calibration", "open_fleet", "open_log", "open_recording", "open_table", "plot",
    "save_calibration", "save_view", "shown_in",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Public names are imported when first used: the package itself imports in milliseconds."""
    if name == "plot":
        return import_module("kf_calib.views.figures")
    if name not in _HOMES:
        raise AttributeError(f"module 'kf_calib' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(f"kf_calib.{module}"), attribute)
