"""Score tests of a run, made for a few dwells at a time, are those of least squares of all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from helpers.synthetic import plan_of
from scipy.interpolate import Akima1DInterpolator

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.dwells.qr import orthonormal
from kf_calib.effects.stimulus import smooth_between
from kf_calib.estimation import dwell_columns
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan, triangles, whiten_model
from kf_calib.noise.terms import Scatter, SettingError
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


@pytest.mark.parametrize("names", [(), ("second-order", "settling")])
def test_a_scan_of_few_dwells_at_a_time_is_least_squares_of_all(names: tuple[str, ...], monkeypatch: Any) -> None:
    before = Refits().with_effects(run("second-order=40ug/g^2"), names)
    noise = before.noise.for_goodness_of_fit.with_terms(SettingError(2e-6, stated=True))
    effects = candidates(before.model)
    monkeypatch.setattr(dwell_columns, "IN_MEMORY", 4000)
    found = scan(before.linearised, noise, effects)
    for effect, each, lowered in list(zip(effects, found.candidates, found.statistics, strict=True))[::9]:
        rows, width = whiten_model(before.linearised, noise, [effect])
        without, with_it = (chi2(rows[:, :last], rows[:, -1]) for last in (width, rows.shape[1] - 1))
        assert each.effect is effect
        np.testing.assert_allclose(lowered, without - with_it, rtol=1e-4, atol=1e-3)


def chi2(columns: np.ndarray, readings: np.ndarray) -> float:
    """What is left of the readings beside these columns, by scipy."""
    sizes = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(sizes > 0.0, sizes, 1.0)
    return float(np.sum((readings - scaled @ scipy.linalg.lstsq(scaled, readings, cond=1e-7)[0]) ** 2))


def test_triangles_of_groups_are_those_of_their_dwells() -> None:
    before = run("second-order=40ug/g^2")
    noise = before.noise.for_goodness_of_fit.with_terms(Scatter(np.full(3, 1e-5), stated=True))
    effects, groups = candidates(before.model)[:9], [np.array([0, 3, 4, 9]), np.array([1, 2, 5, 6, 7, 8, 10, 11])]
    (whole, *parts), width = triangles(before.linearised, noise, effects, groups)
    rows, known = whiten_model(before.linearised, noise, effects)
    assert width == known > before.model.count  # scatter that is stated is slow in part, which all dwells share
    sizes = np.linalg.norm(rows, axis=0)
    unit = np.outer(sizes, sizes) + 1e-300
    np.testing.assert_allclose(whole.T @ whole / unit, rows.T @ rows / unit, atol=1e-12)
    own, shared = [part.T @ part for part in parts], slice(before.model.count, width)
    prior = np.zeros_like(own[0])
    prior[shared, shared] = np.eye(width - before.model.count)
    np.testing.assert_allclose((own[0] + own[1] - prior) / unit, rows.T @ rows / unit, atol=1e-12)


def test_nothing_is_fitted_twice() -> None:
    before = run("second-order=40ug/g^2")
    refits = Refits()
    assert refits.with_effects(before, ("second-order",)) is refits.with_effects(before, ("second-order",))
    found = diagnose(before, refits)
    assert found.after is not None and found.after is refits.with_effects(before, found.missing)


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
