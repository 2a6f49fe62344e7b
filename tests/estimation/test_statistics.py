"""Honest numbers: over many simulated runs the errors are as large as the sigmas say."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.stats import chi2

from kf_calib.estimation.calibration import calibrate

RUNS = 1000
CASES = {
    "white": ({}, 0.93, 0.97),
    "ar1": ({"phi": 0.9, "count": 500}, 0.92, 0.98),
    "scatter": ({"scatter_mps2": 2e-4}, 0.92, 0.98),
    "setting stated": ({"setting_deg": 0.01}, 0.92, 0.98),
    "setting estimated": ({"setting_deg": 0.01, "stated": False}, 0.92, 0.98),
    "encoders": ({"encoder_deg": 0.01}, 0.92, 0.98),
    "mems": ({"white_mps2": 0.02, "spread": (0.05, 0.05, 0.5)}, 0.93, 0.97),
}


def trial(runs: int, first_seed: int, **case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors / sigma (runs, 12), NEES (runs,), p-values of consistency (runs,)."""
    ratios, nees, p_values = [], [], []
    for seed in range(first_seed, first_seed + runs):
        run = Run(seed=seed, **{"dwells": 24, "count": 200, **case})
        result = calibrate(run)
        error = result.estimate.parameters - run.truth
        ratios.append(error / result.estimate.sigma)
        nees.append(error @ np.linalg.solve(result.estimate.parameter_covariance, error))
        p_values.append(result.consistency.p_value)
    return np.array(ratios), np.array(nees), np.array(p_values)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_coverage_of_1000_runs(name: str) -> None:
    """95 % intervals of each of the twelve cover 93-97 % (92-98 % where a noise was estimated from few dwells)."""
    case, low, high = CASES[name]
    ratios, nees, p_values = trial(RUNS, 10_000, **case)
    coverage = np.mean(np.abs(ratios) < 1.96, axis=0)
    print(f"{name}: coverage {coverage.min():.3f}-{coverage.max():.3f}, NEES {nees.mean():.3f}, "
          f"p < 1 %: {np.mean(p_values < 0.01):.3f}, p < 5 %: {np.mean(p_values < 0.05):.3f}")  # fmt: skip
    assert ((coverage >= low) & (coverage <= high)).all(), coverage
    if name in ("white", "mems"):
        band = chi2.ppf([0.025, 0.975], 12 * RUNS) / RUNS
        assert band[0] <= nees.mean() <= band[1]
    if name != "scatter":
        assert np.mean(p_values < 0.01) <= 0.02


@pytest.mark.parametrize("runs", [3, *slow(9, 25)])
@pytest.mark.parametrize("name", ["white", "ar1", "scatter", "setting stated", "encoders"])
def test_coverage_pooled_over_parameters(name: str, runs: int) -> None:
    """The same over a few runs, the twelve parameters pooled; a sigma wrong by a third fails it, by a quarter in 25."""
    case, _, _ = CASES[name]
    ratios, nees, _ = trial(runs, 50_000, **case)
    off = np.sqrt(25.0 / runs)
    assert np.mean(np.abs(ratios) < 1.96) == pytest.approx(0.95, abs=0.036 * off)
    assert np.sqrt(np.mean(ratios**2)) == pytest.approx(1.0, abs=0.2 * off)
    assert nees.mean() == pytest.approx(12.0, abs=2.25 * off)
