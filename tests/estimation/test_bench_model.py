"""Bench models: errors of a bench that are known are subtracted, and their sigma is considered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.paths import ROOT

from kf_calib.errors import InputError
from kf_calib.estimation import bench_model
from kf_calib.estimation.bench_model import BenchModel, BenchTerm
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.settings import Settings
from kf_calib.sources.simulation.options import simulation
from kf_calib.sources.simulation.settings import SimulationOptions

RECORDING = ROOT / "recordings" / "navigation_24.mcap"
QUICK = SimulationOptions(dwell_s=20.0, sample_hz=10.0, slew_degps=90.0, seed=3)
SIGMA = 1e-6
ECCENTRIC = BenchTerm("encoder-harmonic-1:z", ("s1_z", "c1_z"), (2e-5, -1e-5), ((SIGMA**2, 0.0), (0.0, SIGMA**2)))
MODEL = BenchModel((ECCENTRIC,), "bench 1", 40)


def test_parameters_are_those_of_a_bench_without_the_error() -> None:
    plain = calibrate(simulation(QUICK, {}))
    source = simulation(replace(QUICK, hidden=("encoder-harmonic-1:z=2e-5,-1e-5",)), {})
    with_error, known = calibrate(source), calibrate(source, Settings(bench_model=MODEL))
    assert with_error.consistency.p_value < 1e-6
    assert known.consistency.p_value == pytest.approx(plain.consistency.p_value, abs=0.1)
    for symbol in ("theta1", "phi1", "K2", "b3"):
        own, truth = known.parameters[symbol], plain.parameters[symbol]
        assert own.value is not None and truth.value is not None and own.sigma is not None
        assert abs(own.value - truth.value) < 0.1 * own.sigma


def test_sigmas_count_what_is_uncertain_of_the_bench() -> None:
    """As by moving the coefficients by one sigma and adding the squares of what that changes."""
    exact, first, second = (_with(*sizes) for sizes in ((0.0, 0.0), (SIGMA, 0.0), (0.0, SIGMA)))
    uncertain = calibrate(RECORDING, Settings(bench_model=BenchModel((replace(ECCENTRIC, coefficients=(0.0, 0.0)),))))
    changes = np.array([moved - exact.state for moved in (first.state, second.state)])
    added, expected = uncertain.estimate.covariance - exact.covariance, changes.T @ changes
    np.testing.assert_allclose(uncertain.estimate.state, exact.state, atol=1e-12)
    np.testing.assert_allclose(added, expected, atol=0.02 * np.abs(expected).max())


def _with(*sizes: float) -> Estimate:
    """Return the estimate with coefficients that are known exactly."""
    term = replace(ECCENTRIC, coefficients=sizes, covariance=((0.0, 0.0), (0.0, 0.0)))
    return calibrate(RECORDING, Settings(bench_model=BenchModel((term,)))).estimate


@pytest.mark.slow
def test_commands_take_a_bench_model_and_say_so(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    MODEL.write(path)
    assert bench_model.read_bench_model(path) == MODEL
    said = run.json("replay", RECORDING, "--bench-model", path)["warnings"]
    assert any("encoder-harmonic-1:z of the bench is taken from the bench model" in each for each in said)
    suspects = run.json("diagnose", RECORDING, "--bench-model", path)["suspects"]
    assert suspects[0]["effect"] == "encoder-harmonic-1:z"  # it is not in this run
    refusal = run.refused("replay", RECORDING, "--bench-model", path, "--engine", "filterpy")
    assert "the filterpy engine takes no bench model (--bench-model): use --engine block." in refusal


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("terms = []", "at least 1 item"),
        ('[[terms]]\neffect = "flexure"\nsymbols = ["dX"]\ncoefficients = [1.0, 2.0]\ncovariance = [[1.0]]',
         "flexure has 1 symbols, so it needs as many coefficients"),
        ('[[terms]]\neffect = "flexure"\nsymbols = ["dX"]\ncoefficients = [1.0]\ncovariance = [[-1.0]]',
         "the covariance of flexure is not one"),
    ],
)  # fmt: skip
def test_what_is_no_bench_model_is_refused_in_words(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        bench_model.read_bench_model(path)


def test_a_term_that_the_bench_cannot_have_is_refused(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    BenchModel((BenchTerm("flexure", ("dQ",), (1.0,), ((1.0,),)),)).write(path)
    refusal = run.refused("replay", RECORDING, "--bench-model", path)
    assert "has the term flexure, which has no coefficient dQ: it has dX, dY, dZ." in refusal
