"""Effects that turn the platform by so much that their square shows, beside setting errors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hidden_effects import noisy_source
from helpers.long_runs import slow
from helpers.synthetic import plan_of
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.effects import RotationEffect, Stimulus, effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.settings import Settings

pytestmark = pytest.mark.usefixtures("unmeasured")

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0)
SETTING_DEG = 0.01
NOT_STATED: dict[str, float | None] = {"angle_sigma_deg": None, "scatter_sigma_mps2": None}


def attitude(pose: Floats) -> Rotation:
    return Rotation.from_euler("YZX", pose)


@pytest.mark.parametrize("name", ["encoder-harmonic-1:z", "encoder-scale:y", "base-tilt", "platform-drift"])
def test_columns_times_coefficients_are_the_whole_rotation(name: str) -> None:
    """To rounding at 3 deg, by rotations of scipy; axes and scale factors as they are."""
    rng = np.random.default_rng(3)
    poses, elapsed_s, vertical = rng.uniform(-3.0, 3.0, (8, 3)), np.linspace(1.0, 90.0, 8), np.array([0.0, 9.81, 0.0])
    force = attitude(poses).inv().apply(vertical)
    effect = effect_named(name, BENCH)
    sizes = 0.05 * rng.choice([-1.0, 1.0], len(effect.coefficients)) / (90.0 if name == "platform-drift" else 1.0)
    if name == "encoder-harmonic-1:z":
        true = attitude(poses + np.outer(sizes[0] * np.sin(poses[:, 1]) + sizes[1] * np.cos(poses[:, 1]), [0, 1, 0]))
    elif name == "encoder-scale:y":
        true = attitude(poses * [1.0 + sizes[0], 1.0, 1.0])
    elif name == "base-tilt":
        true = Rotation.from_rotvec([sizes[0], 0.0, sizes[1]]) * attitude(poses)  # North is x, East is z
    else:
        true = attitude(poses) * Rotation.from_rotvec(elapsed_s[:, None] * sizes)
    sensitivity = np.eye(3) + 0.01 * rng.normal(size=(3, 3))
    stimulus = Stimulus(
        bench=BENCH, elapsed_s=elapsed_s, since_arrival_s=elapsed_s, force_mps2=force, previous_force_mps2=force,
        pose=poses, previous_pose=poses, temperature_c=np.full(8, 25.0),
        sensitivity=sensitivity,
    )  # fmt: skip
    assert isinstance(effect, RotationEffect)
    expected = (true.inv().apply(vertical) - force) @ sensitivity.T
    np.testing.assert_allclose(effect.added(stimulus, sizes), expected, rtol=0, atol=1e-13 * 9.81)


@pytest.mark.parametrize("setting_deg", [SETTING_DEG, 0.0])
def test_engines_agree_where_a_large_turn_meets_setting_errors_and_where_it_does_not(setting_deg: float) -> None:
    plan = plan_of(10, dwell_s=2.0, seed=5)
    source = noisy_source("base-tilt=0.004", setting_sigma_deg=setting_deg, plan=plan)
    compared = compare(source, Settings(effects=("base-tilt",)))
    assert compared.result.linearised.dwells_at_state.turned_rad is not None
    for way in compared.ways.values():
        assert way.max_difference_sigma <= 1e-6 and way.max_relative_variance <= 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden, states",
    [
        ("base-tilt=0.004", NOT_STATED),
        *slow(("encoder-harmonic-1:z=0.005", {}), ("base-tilt=0.004", {}), ("encoder-harmonic-1:z=0.005", NOT_STATED)),
    ],
)  # fmt: skip
def test_a_turn_of_a_fifth_of_a_degree_is_named_beside_setting_errors(
    hidden: str, states: dict[str, float | None]
) -> None:
    """Linear columns leave 0.1 mm/s^2 of it along the specific force, which was taken for another effect."""
    found = diagnose(noisy_source(hidden, setting_sigma_deg=SETTING_DEG, states=states, seed=8))
    assert found.missing == (hidden.partition("=")[0],) and found.table is not None
    assert found.table.probability(found.missing) > 0.9


@pytest.mark.parametrize("runs", [4, *slow(12)])
def test_the_sigma_of_a_large_turn_and_of_the_twelve_hold_beside_setting_errors(runs: int) -> None:
    """Errors over sigma of 13 numbers a run; with linear columns those of scale factors are beyond 10."""
    ratios = list[float]()
    for seed in range(runs):
        source = noisy_source("encoder-offset:z=0.01", setting_sigma_deg=SETTING_DEG, dwells=10, seed=seed)
        result = calibrate(source, Settings(effects=("encoder-offset:z",)))
        truth = {**source.sensors.parameters, "eps_z": 0.01}
        found = result.parameters
        ratios += [(found[key].value - truth[key]) / (found[key].sigma or np.nan) for key in truth]
    assert len(ratios) == 13 * runs
    assert np.mean(np.abs(ratios) < 1.96) == pytest.approx(0.95, abs=0.05)
    assert np.max(np.abs(ratios)) < 4.5
