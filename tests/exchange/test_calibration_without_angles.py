"""What a calibration without angles is good for once it is saved."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.paths import RECORDINGS
from helpers.synthetic import SYMBOLS, plan_of
from scipy import stats

import kf_calib
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.certificate import budget, statement
from kf_calib.errors import InputError
from kf_calib.estimation.settings import Settings
from kf_calib.exchange import calibration_file
from kf_calib.exchange.history import history
from kf_calib.exchange.verification import verify
from kf_calib.exports import TARGETS, exported
from kf_calib.sources.simulation.sensors import Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit

FRAME = ["theta1", "phi1", "nu2"]


@cache
def result() -> kf_calib.Calibration:
    return kf_calib.calibrate(by_hand("thermal-bias=0.4mg/K"), Settings(effects=("thermal-bias",)))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("saved") / "cal.json"
    calibration_file.write_calibration(out, calibration_file.saved(result()))
    return out


def test_it_is_saved_with_its_frame_and_read_as_it_was(path: Path) -> None:
    saved = calibration_file.open_calibration(path)
    assert saved.fixed == dict.fromkeys(FRAME, "frame")
    assert saved.state.undetermined == [] and not saved.bench.angles
    assert [p.symbol for p in saved.parameters if p.value is None] == FRAME
    assert {"flexure", "cross-talk", "base-tilt", "latency"} <= set(saved.not_seen)
    assert saved.model(path).fixed == result().model.fixed


def test_it_corrects_readings_to_the_size_of_gravity(path: Path) -> None:
    correction, means = calibration_file.open_calibration(path).correction(path), result().linearised.means
    warmth = np.array([np.mean(dwell.pieces.nodes.temperature_c) for dwell in result().fit.dwells])
    found = correction(means.readings, warmth)
    sigma = np.sqrt(np.mean(result().noise.sigma_mps2 ** 2) / means.counts.min())
    assert np.abs(np.linalg.norm(found, axis=1) - result().bench.gravity_mps2).max() < 5.0 * sigma
    assert correction.matrix[0, 1:] == pytest.approx(0.0, abs=1e-12)  # x is the axis of accelerometer 1


def test_it_holds_for_a_run_of_the_same_block_and_not_for_another(path: Path) -> None:
    saved = calibration_file.open_calibration(path)
    same = by_hand("thermal-bias=0.4mg/K", poses=16)
    found = verify(saved, saved.model(path, bench=same.bench), same)
    assert found.holds and found.dof == 16 and {move.symbol for move in found.moves}.isdisjoint(FRAME)
    other = by_hand("thermal-bias=0.4mg/K", seed=2, poses=16)
    assert not verify(saved, saved.model(path, bench=other.bench), other).holds


def test_it_is_not_mixed_with_calibrations_in_the_frame_of_a_platform(path: Path) -> None:
    saved, recording = calibration_file.open_calibration(path), kf_calib.open_recording(RECORDINGS / "mems_faces.mcap")
    with pytest.raises(InputError, match="without angles, in the frame of its sensors: verify it without them"):
        verify(saved, saved.model(path), recording)
    platform = calibration_file.saved(kf_calib.calibrate(recording))
    with pytest.raises(InputError, match="leave out --no-angles"):
        verify(platform, platform.model(), by_hand(poses=8))
    with pytest.raises(InputError, match="give those of one kind"):
        history([saved, platform])
    with pytest.raises(InputError, match="calibrate on a bench that records angles"):
        budget.certificate(saved, saved.model(path), statement.read_statement(None))


def test_six_faces_are_saved_with_axes_taken_for_square(tmp_path: Path) -> None:
    six = kf_calib.calibrate(kf_calib.open_recording(RECORDINGS / "mems_faces.mcap", angles=False))
    calibration_file.write_calibration(tmp_path / "six.json", calibration_file.saved(six))
    saved = calibration_file.open_calibration(tmp_path / "six.json")
    assert set(saved.fixed.values()) == {"frame", "square"} and saved.model().square
    assert np.isfinite(saved.correction()(np.array([[0.0, 9.81, 0.0]]), 25.0)).all()


def _with_axis_3_off_square(off_deg: float, seed: int, plan: list[PlannedVisit]) -> Simulation:
    """A run of a board whose axes are square but for one."""
    bench = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    square = dict.fromkeys(SYMBOLS, 0.0) | dict.fromkeys(("K1", "K2", "K3"), 1.0)
    sensors = Sensors(square | {"b1": 0.01, "b2": 0.02, "b3": 0.03, "phi3": np.radians(off_deg - 90.0)})
    noise = TrueNoise(white_mps2=2e-4)
    run = Simulation(bench, sensors, noise, plan, sample_hz=50.0, slew_rate_degps=180.0, seed=seed)
    return run.by_hand()


@pytest.mark.parametrize(("off_deg", "holds"), [(0.0, True), (1.0, True), (2.0, True), (6.0, False)])
def test_axes_that_were_taken_for_square_may_be_a_degree_or_two_off(off_deg: float, holds: bool) -> None:
    """With means sure to 2 ug, which a degree off square changes by 17 mg."""
    six = [PlannedVisit(each, 4.0) for each in ((0.0, 0.0, 0.0), (0.0, 180.0, 0.0), (0.0, 90.0, 0.0), (0.0, -90.0, 0.0),
                                         (0.0, 0.0, 90.0), (0.0, 0.0, -90.0))]  # fmt: skip
    saved = calibration_file.saved(kf_calib.calibrate(_with_axis_3_off_square(off_deg, 1, six)))
    assert "square" in saved.fixed.values()
    new = _with_axis_3_off_square(off_deg, 2, plan_of(20, dwell_s=4.0, seed=2))
    found = verify(saved, saved.model(bench=new.bench), new)
    assert found.holds == holds and found.dof == 20
    if off_deg == 1.0:  # one sigma: the square of that beside the scatter of as many means as poses
        assert stats.chi2.sf(found.statistic, found.dof) > 0.01


@pytest.mark.parametrize("to", sorted(TARGETS))
def test_it_is_exported_to_every_program(path: Path, to: str) -> None:
    saved = calibration_file.open_calibration(path)
    target = exported(saved, saved.correction(path), to, lossy=True)
    numbers = [float(each) for each in re.findall(r"-?\d+\.\d+(?:e[-+]\d+)?", target.text())]
    assert len(numbers) >= 6 and np.isfinite(numbers).all()
