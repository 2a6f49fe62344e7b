"""Runs whose numbers are stored: of every kind of noise, of benches that state little, of sensors without a bench."""

from collections.abc import Callable, Mapping
from typing import Any

from helpers import known_runs
from helpers.by_hand import by_hand
from helpers.hidden_effects import noisy_run
from helpers.result_numbers import ResultNumbers
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.sources.simulation.options import options_from_query, simulation
from kf_calib.support.json_values import json_value
from kf_calib.views.diagnosis import diagnosis_object
from kf_calib.views.improvement import improvement_object
from kf_calib.views.json import replay_object

Numbers = Mapping[str, Any]
"""What is stored of a case: a tree for each command, and the figures of all of the result."""


def of_calibration(result: Calibration) -> Numbers:
    """Of ``replay``."""
    return {"replay": json_value(replay_object(result)), "figures": ResultNumbers().add(result, "replay").figures}


def of_diagnosis(diagnosis: Diagnosis) -> Numbers:
    """Of ``replay`` and ``diagnose``."""
    told = {"replay": replay_object(diagnosis.before), "diagnose": diagnosis_object(diagnosis)}
    return json_value(told) | {"figures": ResultNumbers().add(diagnosis, "diagnose").figures}


def of_improvement(improvement: Improvement) -> Numbers:
    """Of ``improve``."""
    told = {"improve": improvement_object(improvement, None, {})}
    return json_value(told) | {"figures": ResultNumbers().add(improvement, "improve").figures}


def simulated(query: str, **keys: str) -> Source:
    """A simulated run of short dwells; keys: of the bench, before those that go with its noise."""
    return simulation(options_from_query(f"dwell_s=6&slew_degps=90&sample_hz=50&{query}"), keys)


def diagnosed(query: str, settings: Settings | None = None, **keys: str) -> Numbers:
    return of_diagnosis(diagnose(calibrate(simulated(query, **keys), settings)))


def calibrated(query: str, settings: Settings | None = None, **keys: str) -> Numbers:
    return of_calibration(calibrate(simulated(query, **keys), settings))


MEMS = "grade=mems&count=16&seed=2&flicker_mps2=2e-4&walk_mps2_per_sqrt_s=2e-4&swing_c=5&period_s=120"
TEMPERATURE = "count=18&seed=3&swing_c=4&period_s=90&sigma_c=0.05&hide=thermal-bias=20sigma&hide=thermal-scale=12sigma"
POSITIONS = "count=16&seed=4&setting_sigma_deg=1e-3&encoder_sigma_deg=2e-3&encoder_step_deg=1e-3"
OUTLIERS = "count=14&seed=6&outlier_rate=1e-3&outlier_mps2=0.02&ar1_phi=0.7&scatter_mps2=2e-5"

DIAGNOSED: Mapping[str, Callable[[], Numbers]] = {
    "hidden": lambda: of_diagnosis(known_runs.hidden_diagnosed()),
    "improved": lambda: of_improvement(known_runs.hidden_improved()),
    "nothing_hidden": lambda: of_diagnosis(known_runs.diagnosed()),
    "second_order": lambda: of_diagnosis(known_runs.diagnosed("second-order=15sigma")),
    "mems": lambda: diagnosed(MEMS + "&unstated=1"),
    "position_feedback": lambda: diagnosed(POSITIONS + "&hide=encoder-harmonic-1:z=20sigma"),
    "without_angles": lambda: of_diagnosis(diagnose(calibrate(by_hand("thermal-bias=30sigma", poses=16)))),
}
"""Diagnosed by the fast tests."""

CALIBRATED: Mapping[str, Callable[[], Numbers]] = {
    "temperature": lambda: calibrated(TEMPERATURE, Settings(effects=("thermal-bias", "thermal-scale"))),
    "outliers": lambda: calibrated(OUTLIERS),
    "setting_errors": lambda: calibrated("count=20&seed=8&setting_sigma_deg=3e-3&unstated=1"),
    "walk": lambda: of_calibration(noisy_run(walk_mps2_per_sqrt_s=3e-6, seed=4)),
    "oscillation": lambda: calibrated("count=12&seed=9&hide=sinusoid=20ug"),
}
"""Replayed by the fast tests."""

SLOW: Mapping[str, Callable[[], Numbers]] = {
    "temperature_diagnosed": lambda: diagnosed(TEMPERATURE),
    "outliers_diagnosed": lambda: diagnosed(OUTLIERS),
}
"""Diagnosed by the slow tests."""
