"""Effects that show while the platform turns only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.altered import Altered, short_run
from helpers.long_runs import slow

import kf_calib
from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.slew_effects import _Jackknife
from kf_calib.estimation.fit import Fit
from kf_calib.sources.simulation.injected import parse


def diagnosed(hidden: list[str], stated: bool, seed: int = 3) -> Diagnosis:
    keys = {"angle_sigma_deg": "0", "scatter_sigma_mps2": "0"} if stated else {}
    run = short_run({"gravity_mps2": "9.81", **keys}, seed=seed, slew_degps=30.0, count=16)
    return kf_calib.diagnose(run.hiding(parse(hidden, run.bench.axes, seed=seed)) if hidden else run)


@pytest.mark.parametrize(("hidden", "symbol", "truth"), [("latency=0.2", "tau_d", 0.2), *slow(
    ("latency=0.02", "tau_d", 0.02), ("lever-arm=0.02", "r1x", 0.02))])  # fmt: skip
@pytest.mark.parametrize("stated", [False, *slow(True)])
def test_what_shows_in_slews_alone_is_named(hidden: str, symbol: str, truth: float, stated: bool) -> None:
    found = diagnosed([hidden], stated)
    assert found.missing == (hidden.partition("=")[0],) and found.sure and found.after is not None, found.verdict
    own = found.after.parameters[symbol]
    assert (
        own.value is not None and own.sigma is not None and abs(own.value - truth) < max(4.0 * own.sigma, 0.01 * truth)
    )
    assert "while the platform turns" in found.verdict and "changes no reading at rest" in found.verdict
    assert found.replication is None
    for own, alone in zip(list(found.after.parameters.values())[:12], found.before.parameters.values(), strict=False):
        assert own.value is not None and alone.value is not None and alone.sigma is not None
        assert abs(own.value - alone.value) < alone.sigma


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [[], *slow(["latency=0.02"])])
def test_agreement_at_rest_that_was_not_stated_is_said_first(hidden: list[str]) -> None:
    run = short_run({"gravity_mps2": "9.81"}, seed=3, slew_degps=30.0, count=16, setting_sigma_deg=0.3)
    run = run.hiding(parse(hidden, run.bench.axes, seed=3)) if hidden else run
    found = kf_calib.diagnose(Altered(run, bench=replace(run.bench, angle_sigma_deg=None, scatter_sigma_mps2=None)))
    condition = "if your table sets angles no better than 1100 arcsec"
    at_rest = f"The model agrees at rest {condition}; while the platform turns the readings fail"
    assert found.missing == (("latency",) if hidden else ()), found.verdict
    assert found.verdict.startswith(at_rest if hidden else f"The model agrees with the measurements {condition}")


@pytest.mark.parametrize("seed", [3, *slow(4, 5, 6, 7, 8)])
def test_slews_without_an_effect_are_quiet(seed: int) -> None:
    found = diagnosed([], True, seed)
    assert found.consistent and not found.missing


@dataclass(frozen=True)
class _Rows:
    """What the test of slews reads of a fit: the whitened rows of dwells, each with those of the slew after it."""

    following: list[Floats]
    linearised: Any
    steps: None = None

    def all_rows(self) -> list[Floats]:
        return self.following


def _p_values(random: np.random.Generator, runs: int, correlated: float, size: float = 0.0) -> Floats:
    """p-values (runs,) of two coefficients of a ``size`` beside the twelve, in 12 slews of 30 rows, of which one
    tells five times as much; noise that a slew has in common is a course of the size ``correlated``."""
    parts = SimpleNamespace(model=SimpleNamespace(parts={"latency": slice(12, 14)}))
    design = random.standard_normal((12, 30, 14)) * np.where(np.arange(12) == 4, 5.0, 1.0)[:, None, None]
    course = np.sin(np.linspace(0.0, 3.0, 30)) + design[..., 12]
    found = []
    for _ in range(runs):
        common = correlated * random.standard_normal((12, 1)) * course
        noise = random.standard_normal((12, 30)) + common
        rows = np.concatenate([design, (noise + size * design[..., 13])[..., None]], axis=2)
        found.append(_Jackknife(cast("Fit", _Rows(list(rows), parts))).p_value("latency"))
    return np.array(found)


def test_what_slews_do_not_show_of_an_effect_is_left_out() -> None:
    """A coefficient without a column, and one that is the sum of two others, made the covariance singular."""
    parts = SimpleNamespace(model=SimpleNamespace(parts={"latency": slice(12, 16), "nothing": slice(16, 17)}))
    random = np.random.default_rng(5)
    design = np.concatenate([random.standard_normal((12, 30, 14)), np.zeros((12, 30, 3))], axis=2)
    design[..., 14] = design[..., 12] + design[..., 13]
    for size, named in ((0.0, False), (1.0, True)):
        readings = random.standard_normal((12, 30)) + size * design[..., 12]
        rows = np.concatenate([design, readings[..., None]], axis=2)
        jackknife = _Jackknife(cast("Fit", _Rows(list(rows), parts)))
        assert jackknife.p_value("nothing") == 1.0 and (jackknife.p_value("latency") < 1e-6) == named


@pytest.mark.parametrize("correlated", [0.0, 0.5, 3.0])
def test_p_values_of_slews_hold_in_noise_that_is_common_to_a_slew(correlated: float) -> None:
    random = np.random.default_rng(8)
    found = _p_values(random, 400, correlated)
    assert np.mean(found < 0.05) < 0.09 and np.mean(found < 0.01) < 0.03
    assert np.median(_p_values(random, 20, correlated, 1.0 + 10.0 * correlated)) < 1e-3


def test_what_one_slew_alone_shows_is_not_named() -> None:
    random = np.random.default_rng(9)
    parts = SimpleNamespace(model=SimpleNamespace(parts={"latency": slice(12, 14)}))
    design = random.standard_normal((12, 30, 14))
    design[1:, :, 12:] *= 1e-3
    rows = np.concatenate([design, (100.0 * design[..., 12] + random.standard_normal((12, 30)))[..., None]], axis=2)
    assert _Jackknife(cast("Fit", _Rows(list(rows), parts))).p_value("latency") > 1e-4
    assert _Jackknife(cast("Fit", _Rows(list(rows[:1]), parts))).p_value("latency") == 1.0
