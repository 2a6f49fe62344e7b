"""The smooth course of the temperature against scipy and dense matrices."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BSpline

from kf_calib.noise import temperature_course
from kf_calib.noise.temperature_course import _Spline


def test_bumps_are_cubic_b_splines_and_sum_to_one() -> None:
    places = np.linspace(0.0, 5.0, 57)
    bumps = temperature_course._bumps(places, 8)
    for number in range(8):
        middle = number - 1
        spline = BSpline.basis_element(np.arange(middle - 2.0, middle + 3.0), extrapolate=False)
        np.testing.assert_allclose(bumps[:, number], np.nan_to_num(spline(places)), atol=1e-14)
    np.testing.assert_allclose(bumps.sum(axis=1), 1.0)


def test_the_scatter_within_dwells_is_what_weighted_parabolas_leave() -> None:
    rng = np.random.default_rng(2)
    owners = np.repeat([0, 1, 2, 3], [12, 3, 7, 20])  # three levels of one dwell are its parabola
    middles, weights = np.sort(rng.uniform(0.0, 500.0, 42)), rng.uniform(0.5, 4.0, 42)
    levels = 20.0 + 0.01 * middles + rng.normal(size=42)
    squares, freedom = 0.0, 0
    for number in (0, 2, 3):
        t, y, w = middles[owners == number], levels[owners == number], weights[owners == number]
        fitted = np.polyval(np.polyfit(t - t.mean(), y, 2, w=np.sqrt(w)), t - t.mean())
        squares, freedom = squares + w @ (y - fitted) ** 2, freedom + len(t) - 3
    variance, found_freedom = temperature_course._within_dwells(middles, levels, weights, owners)
    assert found_freedom == freedom
    np.testing.assert_allclose(variance, squares / freedom, rtol=1e-9)


def test_the_spline_has_the_largest_restricted_likelihood_of_all_penalties() -> None:
    """For each penalty l: (A + l P) c = B' W y, and the likelihood from determinants of whole matrices."""
    rng, count = np.random.default_rng(3), 12
    at = np.sort(rng.uniform(0.0, count - 3.0, 80))
    basis, weights = temperature_course._bumps(at, count), rng.uniform(0.5, 2.0, 80)
    levels = 20.0 + np.sin(at) + rng.normal(size=80) / np.sqrt(weights) * 0.2
    spline = _Spline.through(basis, levels, weights)
    information, away = basis.T @ (weights[:, None] * basis), levels - levels.mean()
    along, order = basis.T @ (weights * away), temperature_course._ORDER
    differences = np.diff(np.eye(count), order, axis=0)
    penalty = differences.T @ differences * (np.trace(information) / count)
    costs, fits = list[float](), list[tuple[np.ndarray, float, np.ndarray]]()
    for size in temperature_course._PENALTIES:
        whole = information + size * penalty
        coefficients = np.linalg.solve(whole, along)
        variance = (weights @ away**2 - along @ coefficients) / (len(levels) - order)
        determinant = np.linalg.slogdet(whole)[1] - (count - order) * np.log(size)
        costs.append((len(levels) - order) * np.log(variance) + determinant)
        fits.append((coefficients, variance, variance * np.linalg.inv(whole)))
    best = int(np.argmin(costs))
    assert 0 < best < len(costs) - 1
    coefficients, variance, covariance = fits[best]
    np.testing.assert_allclose(spline.coefficients, coefficients, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(spline.variance, variance, rtol=1e-9)
    np.testing.assert_allclose(spline.errors @ spline.errors.T, covariance, rtol=1e-6, atol=1e-12)


def test_the_largest_errors_have_nearly_all_of_the_variance() -> None:
    errors = np.random.default_rng(4).normal(size=(30, 8)) * np.logspace(0.0, -6.0, 8)
    few = temperature_course._largest(errors)
    share = np.sum(few**2) / np.sum(errors**2)
    assert 1.0 - temperature_course._KEPT <= share <= 1.0 and few.shape[1] < 8
    fewer = few[:, np.argsort(np.sum(few**2, axis=0))[1:]]
    assert np.sum(fewer**2) / np.sum(errors**2) < share


def test_a_piece_weighs_as_the_mean_over_its_whole_length_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 1 K in a reading of 1 s, each carried on for a time c: (l + c) / l² is its variance."""
    begins, lengths = np.array([0.0, 5.0, 60.0, 62.0, 90.0]), np.array([5.0, 20.0, 2.0, 13.0, 0.0])
    at_s = begins[:, None] + np.array([0.0, 0.5, 1.0]) * lengths[:, None]
    read = begins[:, None] + np.array([0.0, 1.0, 5.0])
    told = list[tuple[np.ndarray, ...]]()
    monkeypatch.setattr(temperature_course, "_within_dwells", lambda *given: (told.append(given), (1.0, 0))[1])
    folded: Any = SimpleNamespace(moving=np.zeros(2, bool), piece_numbers=np.array([2, 3]), elapsed_s=at_s.ravel())
    assert temperature_course._smooth(folded, read.ravel()) is None  # too few degrees of freedom
    ((middles, levels, weights, owners),) = told
    np.testing.assert_allclose(middles, (begins + 0.5 * lengths)[:4])
    np.testing.assert_allclose(levels, begins[:4] + 1.0)
    np.testing.assert_allclose(
        1.0 / weights, ((lengths + temperature_course._CARRIED_S) / np.maximum(lengths, 1e-9) ** 2)[:4]
    )
    assert owners.tolist() == [0, 0, 1, 1]


def test_a_temperature_that_rises_evenly_is_followed_through_noise_of_the_thermometer() -> None:
    """By ten kelvin in a thousand seconds, in twenty dwells of four pieces: to half of what a piece scatters by, and
    with errors of that size."""
    begins = (50.0 * np.arange(20)[:, None] + 10.0 * np.arange(4)).ravel()
    elapsed_s = (begins[:, None] + np.array([0.0, 5.0, 10.0])).ravel()
    noise = 0.1 * np.random.default_rng(6).normal(size=len(elapsed_s))
    folded: Any = SimpleNamespace(moving=np.zeros(20, bool), piece_numbers=np.full(20, 4), elapsed_s=elapsed_s)
    course = temperature_course._smooth(folded, 20.0 + 0.01 * elapsed_s + noise)
    assert course is not None
    left = course.temperature_c - (20.0 + 0.01 * elapsed_s)
    sigma = np.sqrt(np.sum(course.errors_c**2, axis=1))
    assert np.sqrt(np.mean(left**2)) < 0.1 / 2.0 and 0.3 < np.sqrt(np.mean((left / sigma) ** 2)) < 2.0


@pytest.mark.parametrize(("course", "steady"), [("noise", True), ("swing", False), ("jumps", False)])
def test_a_room_is_steady_if_the_thermometer_scatters_alike_within_dwells_and_between(
    course: str, steady: bool
) -> None:
    """Fifty dwells of four pieces: noise alone, noise with a slow swing, and levels that differ from dwell to dwell."""
    rng, dwells = np.random.default_rng(4), 50
    level = {
        "noise": np.zeros(dwells),
        "swing": np.sin(np.arange(dwells) / 8.0),
        "jumps": 3.0 * rng.normal(size=dwells),
    }
    read = np.repeat(level[course], 12) + rng.normal(size=12 * dwells)
    folded: Any = SimpleNamespace(piece_numbers=np.full(dwells, 4), ends=np.arange(0, 4 * dwells + 1, 4))
    assert temperature_course._only_scatters(folded, read) == steady
