"""An old calibration is said not to hold no more often than agreed, and what has moved is named."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
from helpers.calibrations import BENCH, simulated, with_result
from helpers.long_runs import slow
from helpers.paths import ROOT
from scipy import stats

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.errors import UnobservableError
from kf_calib.exchange import calibration_file, verification
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.verification import Verification, verify
from kf_calib.support.tail_probabilities import chi_squared_tail


@cache
def saved(seed: int) -> SavedCalibration:
    if seed == 0:
        return calibration_file.saved(kf_calib.calibrate(simulated(0)))
    return with_result(saved(0), kf_calib.calibrate(simulated(seed)))


def verified(seed: int, count: int = 9, **moved: float) -> Verification:
    return verify(saved(seed), saved(seed).model(), simulated(10_000 + seed, count, moved=moved))


@pytest.mark.parametrize(("count", "runs"), [(3, 25), (8, 50), *slow((3, 200), (8, 200))])
def test_p_values_are_uniform_where_nothing_has_moved(count: int, runs: int) -> None:
    found = [verified(seed, count) for seed in range(runs)]
    joint = [chi_squared_tail(each.dof, each.statistic) for each in found]
    assert stats.kstest(joint, "uniform").pvalue > 0.01
    scores = [move.difference / move.sigma for each in found for move in each.moves]
    assert len(scores) == (0 if count == 3 else 12 * runs)
    if scores:
        assert 0.95 < float(np.std(scores)) < 1.05
    false_alarms = sum(not each.holds for each in found)
    assert false_alarms <= stats.binom.ppf(0.999, runs, verification.LEVEL)


def test_the_parameter_that_moved_is_found_and_named() -> None:
    found = [verified(seed, K2=8e-6) for seed in range(15)]
    assert sum(not each.holds for each in found) >= 14
    named = Counter(each.moved[0].symbol for each in found if each.moved)
    assert named["K2"] >= 14 and sum(named.values()) == named["K2"]
    worst = np.array([(each.worst_mps2, each.worst_sigma_mps2) for each in found])
    assert np.all(np.abs(worst[:, 0] - 8e-6 * BENCH.gravity_mps2) < 5.0 * worst[:, 1])


def test_three_orientations_see_a_bias_that_moved_though_they_name_nothing() -> None:
    found = [verified(seed, 3, b1=1e-4) for seed in range(10)]
    assert all(not each.holds and each.new is None and not each.moves for each in found)


def test_gravity_block_and_the_very_same_recording_are_told() -> None:
    path = ROOT / "recordings" / "navigation_24.mcap"
    recording = kf_calib.open_recording(path)
    own = calibration_file.of_source(kf_calib.calibrate(path), recording)
    assert "this is the recording that it was calibrated from" in verify(own, own.model(), recording).warnings[0]
    other = Bench.from_metadata({**recording.bench.to_metadata(), "gravity_mps2": "9.8124", "block_serial": "B2"})
    again = kf_calib.open_recording(path, other.to_metadata())
    marked = own.provenance.model_copy(update={"bench": {**own.provenance.bench, "block_serial": "B1"}})
    found = verify(own.model_copy(update={"provenance": marked}), own.model(bench=other), again)
    told = " ".join(found.warnings)
    assert "gravity is stated" in told and "the block is B2, the calibration is of B1" in told
    ratio = other.gravity_mps2 / recording.bench.gravity_mps2
    assert not found.holds and {"K1", "K2", "K3"} <= {move.symbol for move in found.moved}
    k2 = next(move for move in found.moves if move.symbol == "K2")
    assert k2.new / k2.old == pytest.approx(1.0 / ratio, abs=1e-6)


def test_effects_of_the_run_are_not_compared() -> None:
    settings = kf_calib.Settings(effects=("warm-up", "second-order"))
    own = calibration_file.saved(kf_calib.calibrate(simulated(0, 14), settings))
    found = verify(own, own.model(), simulated(77, 14))
    assert found.free == ("warm-up",) and found.holds
    assert {move.symbol for move in found.moves} >= {"K1", "K2_1"}
    assert not {move.symbol for move in found.moves} & {"B1", "B2", "B3", "tauWarm"}
    assert found.dof == 3 * 14 - 4


def test_a_calibration_that_determined_too_little_predicts_nothing() -> None:
    settings = kf_calib.Settings(effects="thermal-bias")  # the temperature does not vary
    own = calibration_file.saved(kf_calib.calibrate(simulated(0), settings))
    assert own.state.undetermined
    with pytest.raises(UnobservableError, match=r"did not determine .*: verify one that did"):
        verification.refuse_incomplete(own)
