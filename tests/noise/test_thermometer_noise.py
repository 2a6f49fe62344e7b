"""The noise of the thermometer: the course of the temperature, its error, and what both are to a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import plan_of

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration, consistency
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.within_dwell_trend import trend
from kf_calib.noise.temperature_course import temperature_course
from kf_calib.noise.terms import ThermometerError
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation

BENCH = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
LARGE = np.array([1e-2, -7e-3, 5e-3])
"""1 mg/K, which makes 3e-4 m/s^2 of 0.03 K."""


def calibrated(alpha: Floats, seed: int = 0, **climate: float) -> tuple[Calibration, Ambient]:
    """A run whose biases follow the temperature, calibrated with that effect, and its true temperature."""
    ambient = Ambient(**{"swing_c": 5.0, "period_s": 900.0, "warm_up_c": 4.0, "warm_up_s": 300.0} | climate)
    hidden = parse([f"thermal-bias={','.join(map(str, alpha.tolist()))}"], BENCH.axes)
    run = Simulation(
        BENCH, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5), plan_of(18, dwell_s=40.0),
        sample_hz=5.0, angle_hz=5.0, slew_rate_degps=90.0, seed=seed, ambient=ambient, hidden=hidden,
    )  # fmt: skip
    return calibrate(run, Settings(effects=("thermal-bias",))), ambient


@pytest.fixture(scope="module")
def noisy() -> tuple[Calibration, Ambient]:
    return calibrated(LARGE, sigma_c=0.03)


def errors(dwells: DwellTable, ambient: Ambient) -> tuple[Floats, Floats, Floats]:
    """Errors of the temperatures as they were read and of their course, and the sigma of the course."""
    course, nodes = temperature_course(dwells.folded), dwells.folded.pieces.nodes
    true, read = ambient(nodes.elapsed_s), nodes.temperature_c
    return read - true, course.temperature_c - true, np.linalg.norm(course.errors_c, axis=1)


@pytest.mark.parametrize("thermometer", [{"sigma_c": 0.03}, {"sigma_c": 0.0, "step_c": 0.1}], ids=["noise", "steps"])
def test_the_course_of_the_temperature_is_as_near_the_truth_as_its_sigma_says(thermometer: dict[str, float]) -> None:
    ratios, better = list[float](), list[float]()
    for seed in range(4):
        run, ambient = calibrated(LARGE, seed, **thermometer)
        read, smooth, sigma = errors(run.fit.dwells, ambient)
        ratios.append(float(np.mean((smooth / sigma) ** 2)))
        better.append(float(np.std(smooth) / np.std(read)))
    assert 0.6 < np.sqrt(np.mean(ratios)) < 1.4
    assert max(better) < 0.5


def test_the_error_of_the_temperature_is_in_the_sigmas_and_in_the_test_of_the_model(
    noisy: tuple[Calibration, Ambient],
) -> None:
    run, _ = noisy
    exact = replace(run.fit, noise=run.noise.without(ThermometerError))
    assert consistency(exact).p_value < 1e-9
    assert run.consistency.consistent
    assert any("thermometer" in sentence for sentence in run.warnings)
    found = [run.parameters[f"alpha{k}"] for k in (1, 2, 3)]
    assert np.abs([(each.value - true) / each.sigma for each, true in zip(found, LARGE, strict=True)]).max() < 3.0
    truth = GRADES["navigation"].sensors(0).parameters
    assert (
        np.sqrt(np.mean([((run.parameters[k].value - truth[k]) / run.parameters[k].sigma) ** 2 for k in truth])) < 1.5
    )
    sensitivity = run.noise.term(ThermometerError).sensitivity_mps2_per_k
    np.testing.assert_allclose(sensitivity[:, 0], [each.value for each in found], rtol=1e-6)
    np.testing.assert_allclose(sensitivity[:, 1:], 0.0, atol=1e-9)


def test_the_error_of_the_temperature_is_no_trend_within_dwells(noisy: tuple[Calibration, Ambient]) -> None:
    """Where it is left out of the noise, all dwells seem to have one."""
    run, _ = noisy
    exact = replace(run.fit, noise=run.noise.without(ThermometerError))
    with_error, without = trend(run.fit), trend(exact)
    assert with_error is not None and with_error.p_value > 1e-3 and 0.7 < with_error.ratio < 1.4
    assert without is not None and without.p_value < 1e-40


def test_an_effect_too_small_for_the_error_of_the_temperature_to_matter_has_none() -> None:
    run, _ = calibrated(1e-4 * LARGE, sigma_c=0.03)
    assert run.noise.term(ThermometerError) is None
    assert not any("thermometer" in sentence for sentence in run.warnings)


def test_a_quiet_thermometer_is_taken_as_it_was_read(noisy: tuple[Calibration, Ambient]) -> None:
    dwells = [at_temperatures(dwell, 20.0 + 1e-3 * dwell.pieces.nodes.elapsed_s) for dwell in noisy[0].fit.dwells]
    assert_as_read(dwells)


def test_a_temperature_with_steps_from_dwell_to_dwell_is_taken_as_it_was_read(
    noisy: tuple[Calibration, Ambient],
) -> None:
    """As in a chamber that is set to another temperature for each orientation: no smooth curve follows it."""
    steps = np.random.default_rng(1).uniform(-10.0, 10.0, len(noisy[0].fit.dwells)).tolist()
    each = zip(noisy[0].fit.dwells, steps, strict=True)
    assert_as_read([at_temperatures(dwell, dwell.pieces.nodes.temperature_c + step) for dwell, step in each])


def at_temperatures(dwell: Dwell, temperature_c: Floats) -> Dwell:
    """A dwell at other temperatures, (3 pieces,)."""
    nodes = replace(dwell.pieces.nodes, temperature_c=temperature_c)
    return replace(dwell, pieces=replace(dwell.pieces, nodes=nodes))


def assert_as_read(dwells: Sequence[Dwell]) -> None:
    folded = DwellTable.of(dwells).folded
    course = temperature_course(folded)
    np.testing.assert_array_equal(course.temperature_c, folded.pieces.nodes.temperature_c)
    assert course.errors_c.shape[1] == 0


@pytest.mark.parametrize("read_c", [25.0, 0.0, 24.9])
def test_a_thermometer_that_always_reads_the_same_is_taken_at_its_word(read_c: float) -> None:
    """Of a room at exactly one temperature there is nothing to smooth, and no warning of numpy."""
    run, ambient = calibrated(0.0 * LARGE, swing_c=0.0, warm_up_c=0.0, sigma_c=0.0, constant_c=read_c)
    read, smooth, sigma = errors(run.fit.dwells, ambient)
    assert np.abs([read, smooth]).max() < 1e-12 and not sigma.any()
