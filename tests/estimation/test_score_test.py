"""A frame of columns serves all models of a run, and gives what a scan made for one alone gives."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import plan_of
from scipy.interpolate import Akima1DInterpolator

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.dwells.qr import orthonormal
from kf_calib.effects import effect_named
from kf_calib.effects.stimulus import smooth_between
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import Frame, scan
from kf_calib.noise.terms import RandomWalk, SettingError
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)


def run(*hidden: str, seed: int = 5) -> Calibration:
    base = Simulation(
        BENCH, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5), plan_of(12, dwell_s=8.0, seed=seed),
        sample_hz=20.0, angle_hz=20.0, slew_rate_degps=90.0, seed=seed,
    )  # fmt: skip
    return calibrate(base.hiding(parse(hidden, BENCH.axes, seed=seed)))


@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_a_frame_gives_what_a_scan_of_one_model_gives(walk_mps2: float) -> None:
    before = run("second-order=40ug/g^2")
    noise = before.noise.for_goodness_of_fit.with_terms(RandomWalk(walk_mps2))
    frame = Frame(before.linearised, noise, candidates(Model(BENCH)))
    more = [effect_named("mine = a*p*o", BENCH)]
    refits = Refits()
    for result in (before, *(refits.with_effects(before, (name,)) for name in ("second-order", "settling"))):
        found = frame.scan(result.linearised, more)
        alone = scan(result.linearised, noise, [*candidates(result.model), *more])
        assert [str(each.effect) for each in found.candidates] == [str(each.effect) for each in alone.candidates]
        assert [each.dof for each in found.candidates] == [each.dof for each in alone.candidates]
        # with an effect in the model small rotations are linearised a little elsewhere
        np.testing.assert_allclose(found.statistics, alone.statistics, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(
            [each.visibility for each in found.candidates], [each.visibility for each in alone.candidates], atol=1e-4
        )


def test_a_frame_serves_one_noise_and_one_run() -> None:
    one, other = run(), run(seed=3)
    frame = Frame(one.linearised, one.noise.for_goodness_of_fit, [])
    assert frame.serves(one.linearised, one.noise.for_goodness_of_fit)
    assert not frame.serves(other.linearised, one.noise.for_goodness_of_fit)
    assert not frame.serves(one.linearised, one.noise.for_goodness_of_fit.with_terms(SettingError(1e-5)))


def test_nothing_is_fitted_twice() -> None:
    before = run("second-order=40ug/g^2")
    refits = Refits()
    assert refits.with_effects(before, ("second-order",)) is refits.with_effects(before, ("second-order",))
    found, frame = diagnose(before, refits), refits.frame_of(before.fit)
    assert found.after is not None and found.after is refits.with_effects(before, found.missing)
    assert refits.frame_of(found.after.fit) is frame


@pytest.mark.parametrize("count", [5, 40, 5000])
def test_rows_made_orthonormal_in_parts(count: int) -> None:
    rows = np.random.default_rng(1).standard_normal((count, 20))
    rows[:, 7] = rows[:, 3]  # a column that is there twice
    basis, upper = orthonormal(rows.copy())
    np.testing.assert_allclose(basis @ upper, rows, atol=1e-12)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)


@pytest.mark.parametrize("count", [3, 4, 5, 60])
def test_curves_between_temperatures_are_akimas(count: int) -> None:
    rng = np.random.default_rng(count)
    times = np.cumsum(rng.uniform(0.1, 3.0, count))
    at = np.linspace(times[0], times[-1], 500)
    for values in (rng.normal(size=count), np.repeat(2.5, count), (times > times[count // 2]).astype(float)):
        expected = Akima1DInterpolator(times, values, method="makima")(at)
        np.testing.assert_allclose(smooth_between(times, values, at), expected, atol=1e-13)
