"""Simulated runs with hidden effects, calibrated without them."""

from dataclasses import replace
from functools import partial
from typing import Any

from helpers.synthetic import plan_of
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)


def run(*hidden: str, seed: int = 5, plan: list | None = None) -> Calibration:
    """A calibration without the hidden effects in its model."""
    return calibrate(source(*hidden, seed=seed, plan=plan))


def source(*hidden: str, seed: int = 5, plan: list | None = None) -> Simulation:
    """A simulated run with hidden effects. A diagnosis takes as long as there are dwells."""
    base = Simulation(
        BENCH, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5),
        plan or plan_of(16, dwell_s=8.0, seed=seed),
        sample_hz=50.0, angle_hz=20.0, slew_rate_degps=90.0, seed=seed,
        ambient=Ambient(swing_c=5.0, period_s=300.0, sigma_c=0.0),
    )  # fmt: skip
    return base.hiding(parse(hidden, BENCH.axes, seed=seed, sized=partial(sized, base)))


WHITE = 5e-5


def noisy_run(*hidden: str, **options: Any) -> Calibration:
    """A calibration of a ``noisy_source`` without the hidden effects in its model."""
    return calibrate(noisy_source(*hidden, **options))


def noisy_source(
    *hidden: str, seed: int = 5, dwells: int = 16, plan: list[PlannedVisit] | None = None,
    states: dict[str, float | None] | None = None, **noise: float,
) -> Simulation:  # fmt: skip
    """A simulated run with hidden effects, on a bench that states its noise, or ``states``.

    A diagnosis takes as long as there are dwells; what goes with time rather than with gravity needs more of them.
    """
    made = TrueNoise(**{"white_mps2": WHITE, **noise})
    visits = plan or plan_of(dwells, dwell_s=8.0, seed=seed)
    scatter = made.dwell_sigma_mps2(len(visits))
    stated: dict[str, Any] = {"angle_sigma_deg": made.setting_sigma_deg, "scatter_sigma_mps2": scatter} | (states or {})
    bench = replace(BENCH, **stated)
    base = Simulation(
        bench, GRADES["navigation"].sensors(seed), made, visits, sample_hz=50.0, angle_hz=20.0, slew_rate_degps=90.0,
        seed=seed, ambient=Ambient(swing_c=5.0, period_s=300.0, sigma_c=0.0),
    )  # fmt: skip
    return base.hiding(parse(hidden, bench.axes, seed=seed, sized=partial(sized, base)))
