"""Every effect of the catalogue against a truth that was made without its columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kf_calib.bench import Bench, axes_of
from kf_calib.calibration import Calibration, Settings, calibrate
from kf_calib.comparison import compare
from kf_calib.effects import effect_named, names
from kf_calib.errors import InputError
from kf_calib.model import Model
from kf_calib.sources.hidden import parse
from kf_calib.sources.noise_sources import Noise
from kf_calib.sources.physics import Ambient
from kf_calib.sources.plans import spread_plan
from kf_calib.sources.sensors import GRADES
from kf_calib.sources.simulator import Simulation

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
PLAN = spread_plan(30, dwell_s=6.0, seed=4)
NAMES = names(BENCH)
INVISIBLE = {  # exactly: wrong g is a common scale, the innermost zero a misalignment; a vertical axis turns nothing
    "cross-talk": {"theta1", "phi1", "nu1", "nu2", "theta3", "phi3", "X12", "X13", "X21", "X23", "X31", "X32"},
    "gravity-error": {"K1", "K2", "K3", "epsG"},
    "encoder-offset:x": {"eps_x"},
    "encoder-offset:y": {"eps_y"},
    "encoder-scale:y": {"epsS_y"},
    "encoder-harmonic-1:y": {"s1_y", "c1_y"},
    "encoder-harmonic-2:y": {"s2_y", "c2_y"},
}
SIZES = {
    "rad": 1e-5, "rad/s": 1e-8, "1": 1e-5, "m/s^2": 1e-4, "s^2/m": 1e-6, "s^4/m^2": 1e-7, "m/s^3": 1e-7, "1/s": 1e-8,
    "m/s^2/K": 1e-5, "m/s^2/K^2": 1e-6, "1/K": 1e-6, "rad/K": 1e-6, "m s^-1/K": 1e-2, "rad s^2/m": 1e-6,
}  # fmt: skip


def run(hidden: list[str], white_mps2: float = 0.0, seed: int = 5) -> Simulation:
    return Simulation(
        BENCH, GRADES["navigation"].sensors(seed), Noise(white_mps2=white_mps2), PLAN,
        sample_hz=20.0, slew_rate_degps=90.0, seed=seed, ambient=Ambient(swing_c=5.0, period_s=150.0, sigma_c=0.0),
        hidden=parse(hidden, BENCH.axes, seed=seed),
    )  # fmt: skip


def with_effect(name: str, source: Simulation) -> Calibration:
    return calibrate(source, Settings(effects=(name,)))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in {*INVISIBLE, "sinusoid"}])
def test_coefficients_of_a_nonlinear_truth_are_found(name: str) -> None:
    """Without noise: what the simulator hid comes out, and the model without it fails."""
    effect = effect_named(name, BENCH)
    size = SIZES[effect.coefficients[0].unit]
    truth = [size * (1.0, -0.6, 0.8, 0.5, -0.9, 0.7)[k] for k in range(len(effect.coefficients))]
    source = run([f"{name}={','.join(map(str, truth))}"])
    result = with_effect(name, source)
    got = [result.parameters[c.symbol].value for c in effect.coefficients]
    if name == "axis-nonorthogonality" or name.startswith("axis-"):  # the directions across an axis are free
        assert np.linalg.norm(got) == pytest.approx(np.linalg.norm(truth), rel=0.02)
    else:
        np.testing.assert_allclose(got, truth, rtol=0.02, atol=0.01 * size)
    without = calibrate(source)
    assert without.consistency.statistic > 100 * max(result.consistency.statistic, 1.0)


@pytest.mark.parametrize("name", INVISIBLE)
def test_exact_degeneracies_are_said_by_name(name: str) -> None:
    result = with_effect(name, run([], white_mps2=5e-5))
    unseen = {symbol for symbol, p in result.parameters.items() if p.value is None}
    assert unseen >= INVISIBLE[name]
    assert any("do not determine" in warning and sorted(INVISIBLE[name])[0] in warning for warning in result.warnings)


@pytest.mark.parametrize(
    "effects",
    [
        ("second-order", "bias-drift"),
        ("encoder-harmonic-2:z", "hysteresis"),
        ("thermal-scale", "axis-nonorthogonality:z"),
    ],
)
def test_engines_and_batch_agree_with_effects(effects: tuple[str, ...]) -> None:
    compared = compare(run([], white_mps2=5e-5), Settings(effects=effects))
    assert compared.max_difference_sigma <= 1e-6
    assert all(way.max_relative_variance <= 1e-8 for way in compared.ways.values())


def test_intervals_cover() -> None:
    """Coefficients over their sigmas, four effects of 25 runs each, with noise."""
    ratios = []
    for seed in range(25):
        for name in ("second-order", "bias-drift", "encoder-harmonic-1:z", "thermal-bias"):
            effect = effect_named(name, BENCH)
            result = with_effect(name, run([], white_mps2=5e-5, seed=100 + seed))
            ratios += [
                result.parameters[c.symbol].value / result.parameters[c.symbol].sigma for c in effect.coefficients
            ]
    assert 0.92 <= np.mean(np.abs(ratios) < 1.96) <= 0.98
    assert np.std(ratios) == pytest.approx(1.0, abs=0.12)


def test_models_compose() -> None:
    model = Model(BENCH)
    second = effect_named("second-order", BENCH)
    larger = model + second + effect_named("bias-drift", BENCH)
    assert str(larger) == "twelve parameters + second-order + bias-drift" and larger.count == 18
    assert str(larger - second) == "twelve parameters + bias-drift" and model.count == 12
    with pytest.raises(InputError, match="second-order is in the model already"):
        _ = larger + second


@pytest.mark.parametrize(
    "text, says", [("second-ordr", "second-order"), ("encoder-offset:q", "y, z, x"), ("wibble", "catalogue")]
)
def test_unknown_names_are_one_sentence(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        effect_named(text, BENCH)


def test_no_other_file_knows_an_effects_name() -> None:
    package = Path(__file__).resolve().parents[1] / "kf_calib"
    known = {name.split(":")[0] for name in NAMES}
    for path in package.rglob("*.py"):
        if {"effects", "hidden"} & set(path.relative_to(package).parts):
            continue
        text = path.read_text()
        mentions = {name for name in known if f'"{name}"' in text}
        assert not mentions, f"{path} knows {mentions}"
