"""Short simulated runs of one bench, and calibrations of them as they are saved."""

from collections.abc import Mapping

import numpy as np

import kf_calib
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit

BENCH = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
SENSORS = GRADES["navigation"].sensors(1)
NOISE = TrueNoise(white_mps2=5e-5)


def visits(count: int, seed: int) -> list[PlannedVisit]:
    """Orientations drawn at random."""
    rng = np.random.default_rng(seed)
    return [PlannedVisit(tuple(rng.uniform(-180.0, 180.0, 3)), 3.0) for _ in range(count)]


def simulated(
    seed: int, count: int = 9, bench: Bench = BENCH, moved: Mapping[str, float] | None = None, **options: object
) -> Simulation:
    """A run of ``count`` orientations that differ with the seed, as the noise does; moved: added to parameters."""
    changed = {name: SENSORS.parameters[name] + change for name, change in (moved or {}).items()}
    sensors = Sensors({**SENSORS.parameters, **changed})
    settled = {"sample_hz": 20.0, "slew_rate_degps": np.inf, **options}
    return Simulation(bench, sensors, NOISE, visits(count, 7 * seed + 3), seed=seed, **settled)


def warming_up(seed: int, count: int) -> Simulation:
    """The same with a warm-up of two minutes, so that its time constant is determined."""
    run = simulated(seed, count)
    return run.hiding(parse(("warm-up=1e-3;tau=120",), run.bench.axes, seed=seed))


def with_result(template: SavedCalibration, result: kf_calib.Calibration) -> SavedCalibration:
    """What is saved of a result, as far as it is verified by; the rest, which takes long to find, is the template's."""
    estimate = result.estimate
    state = template.state.model_copy(
        update={"values": estimate.state.tolist(), "covariance": estimate.covariance.tolist()}
    )
    parameters = [
        calibration_file.SavedParameter(symbol=p.symbol, value=p.value, sigma=p.sigma, unit=p.unit, nominal=p.nominal)
        for p in result.parameters.values()
    ]
    return template.model_copy(update={"state": state, "parameters": parameters})
