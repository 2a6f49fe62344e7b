"""Effects that show while the platform turns only."""

from __future__ import annotations

import pytest
from helpers.altered import short_run
from helpers.long_runs import slow

import kf_calib
from kf_calib.diagnosis.results import Diagnosis
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


@pytest.mark.parametrize("seed", [3, *slow(4, 5, 6, 7, 8)])
def test_slews_without_an_effect_are_quiet(seed: int) -> None:
    found = diagnosed([], True, seed)
    assert found.consistent and not found.missing
