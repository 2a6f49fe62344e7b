"""Which effect is missing, from the size of gravity alone."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.paths import RECORDINGS
from scipy.stats import binom

import kf_calib
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.effects import effect_named, names
from kf_calib.estimation.dwell_columns import candidate_columns
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.free_attitude import weights_of_size
from kf_calib.estimation.observability import visibility_of
from kf_calib.estimation.settings import Settings

pytestmark = pytest.mark.usefixtures("unmeasured")

ATTITUDE = ("magnetic", "base-tilt", "base-tilt-drift", "platform-drift", "flexure", "uneven-flexure")
ALWAYS = ("gravity-error", "cross-talk")


@cache
def clean() -> kf_calib.Calibration:
    return kf_calib.calibrate(by_hand())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["second-order", "scale-asymmetry", "thermal-bias", "bias-drift", "hysteresis"])
def test_an_effect_of_ten_sigma_is_named_or_among_its_equals(name: str) -> None:
    found = kf_calib.diagnose(kf_calib.calibrate(by_hand(f"{name}=10sigma")))
    assert found.test.consistent is False
    assert name in found.ambiguity
    assert found.after is not None and found.after.held_out is not None and found.before.held_out is not None
    assert found.after.held_out.rms_mps2 < 0.8 * found.before.held_out.rms_mps2


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, size",
    [
        ("cross-coupling-po", 150),
        ("cross-coupling-ip", 150), ("cross-axis-square", 150), ("thermal-scale", 40), ("thermal-scale", 150),
              ("second-order", 150), ("hysteresis", 150), ("thermal-misalignment", 150),
    ],
)  # fmt: skip
def test_a_large_effect_is_named_though_nobody_knows_where_its_axes_are(name: str, size: int) -> None:
    """Axes across the input axes lie in the block, whose frame is not that of the sensors: at this size that shows."""
    run = by_hand(f"{name}={size}sigma")
    found = kf_calib.diagnose(run, replicate=False)
    assert found.missing == (name,) and found.sure, found.verdict
    assert kf_calib.calibrate(run, effects=[name]).consistency.p_value > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("size", [40, 150])
def test_an_oscillation_within_dwells_is_not_another_effect(size: int) -> None:
    """What takes some of it and leaves most has no name."""
    found = kf_calib.diagnose(by_hand(f"sinusoid={size}sigma"), replicate=False)
    assert found.missing in ((), ("sinusoid",)), found.verdict


@pytest.mark.slow  # docs/no_angles.md says the same of it, in short
def test_the_board_in_recordings_is_improved_by_what_its_truth_says() -> None:
    truth = json.loads((RECORDINGS / "hand.truth.json").read_text())["effects"][0]
    state = kf_calib.improve(kf_calib.open_recording(RECORDINGS / "hand.mcap", angles=False))
    assert state.effects == (truth["name"],) and state.because == "consistent"
    assert state.start.suspects[0].statistic == pytest.approx(truth["size_sigma"] ** 2, rel=0.15)
    parameters = state.result.parameters
    assert [symbol for symbol, p in parameters.items() if p.value is None] == ["theta1", "phi1", "nu2"]
    sizes = [abs(p.value) for p in list(parameters.values())[12:] if p.value is not None]
    assert sizes == pytest.approx([abs(size) for size in truth["sizes"].values()], rel=0.15)


@pytest.mark.slow
def test_a_walk_of_the_biases_is_found_by_its_likelihood() -> None:
    found = kf_calib.diagnose(kf_calib.calibrate(by_hand("bias-walk=3e-4", poses=18)))
    assert found.missing == ("bias-walk",) and found.after is not None
    intensity = found.after.parameters["qb"]
    assert intensity.value == pytest.approx(3e-4, rel=0.6)
    assert found.after.held_out_rms_mps2 is not None


def test_what_cannot_be_seen_has_no_column_in_the_size_of_f() -> None:
    """An effect is listed exactly if its columns, along n = S^-T f / g and less what nine parameters explain, vanish;
    those which change within a dwell are seen there, too."""
    result = clean()
    linearised, state = result.linearised, result.linearised.state
    listed = {each.name for each in kf_calib.diagnose(result).unseen}
    assert {*ATTITUDE, *ALWAYS, "latency", "lever-arm"} <= listed
    across = weights_of_size(linearised.means, state)
    model = np.einsum("di,dip->dp", across, linearised.means.design)
    model = model[:, np.abs(model).max(axis=0) > 0.0]
    model /= np.linalg.norm(model, axis=0)
    for name in ("second-order", "third-order", "cross-axis-square", "thermal-bias", "hysteresis", *ATTITUDE, *ALWAYS):
        effect = effect_named(name, result.bench)
        own = candidate_columns(linearised.dwells, [effect], result.bench, state)
        means = np.array([np.tensordot(dwell.pieces.counts / dwell.count, each.mean(axis=1), 1)
                          for dwell, each in zip(linearised.dwells, own, strict=True)])  # fmt: skip
        columns = np.einsum("di,diq->dq", across, means)
        left = columns - model @ np.linalg.lstsq(model, columns, rcond=None)[0]
        share = np.linalg.norm(left) / max(float(np.linalg.norm(means)), 1e-300)
        assert (share < 1e-9) == (name in listed), name


def test_visibility_is_told_of_every_effect() -> None:
    result = clean()
    seen = {str(each.effect): each for each in visibility_of(
        result.fit, [effect_named(name, result.bench) for name in names(result.bench)])}  # fmt: skip
    assert seen["second-order"].visible and seen["second-order"].smallest is not None
    assert seen["flexure"].visible is False
    assert not seen["cross-talk"].visible and "misalignment" in str(seen["cross-talk"])


def test_engines_agree_with_an_effect_in_the_model() -> None:
    compared = compare(by_hand("second-order=20sigma", poses=14), Settings(effects=("second-order",)))
    assert compared.max_difference_sigma < 1e-4


def _p_values(runs: int, poses: tuple[int, ...]) -> list[float]:
    out = list[float]()
    for seed in range(runs):
        result = kf_calib.calibrate(by_hand(seed=100 + seed, poses=poses[seed % len(poses)], stated=bool(seed % 2)))
        p_value = assess_candidates(result.fit).p_value
        assert p_value is not None
        out.append(p_value)
    return out


@pytest.mark.slow
def test_noise_alone_is_rarely_significant() -> None:
    assert min(_p_values(4, (14, 18))) > 1e-4


@pytest.mark.slow
def test_false_alarms_come_at_the_stated_rate_at_most() -> None:
    p_values = np.array(_p_values(200, (14, 18, 24)))
    for level in (0.01, 0.05, 0.2):
        assert (p_values < level).sum() <= binom.ppf(0.999, len(p_values), level)
