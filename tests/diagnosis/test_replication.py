"""What one half of the dwells names, tried on the other: against least squares by hand, and rates on hidden effects."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import known_runs
from helpers.known_runs import diagnosed
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.spatial.transform import Rotation
from scipy.stats import t

import kf_calib
from kf_calib.bench.streams import Stream
from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.diagnosis.replication import FEWEST, Replication, _one_sided, replication
from kf_calib.estimation.results import Calibration, Consistency
from kf_calib.views.diagnosis import replication_in_words

WHITE_MPS2, COUNT = 1e-4, 600
SIGMA_MPS2 = WHITE_MPS2 / np.sqrt(COUNT)


def hidden(seed: int, sigmas: float, dwells: int = 24, power: float = 2.0) -> tuple[Run, np.ndarray]:
    """A run in which the square of the force, or another power, of this size is hidden, and the forces (D, 3) in g."""
    run = Run(seed, dwells, COUNT, white_mps2=WHITE_MPS2)
    run.bench = replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    poses = run.pose.values.reshape(dwells, -1, 3)[:, 0]
    force = Rotation.from_euler("YZX", poses).inv().apply([0.0, 1.0, 0.0])
    shape = np.abs(force) ** power * np.random.default_rng(seed).normal(size=3)
    left = shape - model(force) @ np.linalg.lstsq(model(force), shape, rcond=None)[0]
    shape *= sigmas * SIGMA_MPS2 / np.linalg.norm(left)
    run.accel = Stream(run.accel.time_ns, run.accel.values + np.repeat(shape, COUNT, axis=0))
    return run, force


def model(force: np.ndarray) -> np.ndarray:
    return np.column_stack([force, np.ones(len(force))])


def replicated(before: Calibration, relevant: list[str], left: Consistency | None = None) -> Replication:
    return replication(before, relevant, 1, left or Consistency(50.0, 50, 0.5, True))


@cache
def everything() -> list[str]:
    return sorted({str(effect) for effect in candidates(kf_calib.calibrate(hidden(1, 0.0)[0]).model)})


def by_hand(values: np.ndarray, force: np.ndarray, seen: np.ndarray) -> tuple[float, float, float]:
    """Fall of chi-squared of the unseen dwells by a square of the force that the others give, its score and variance.

    The prediction without it and with it, and the covariance of the first, by least squares for each accelerometer.
    """
    fall = score = square = 0.0
    for reading, along in zip(values.T, force.T, strict=True):
        columns, further = model(force), np.column_stack([model(force), along**2])
        without = np.linalg.lstsq(columns[seen], reading[seen], rcond=None)[0]
        with_it = np.linalg.lstsq(further[seen], reading[seen], rcond=None)[0]
        spread = np.linalg.inv(columns[seen].T @ columns[seen])
        inverse = np.linalg.inv(np.eye(np.sum(~seen)) + columns[~seen] @ spread @ columns[~seen].T)
        errors = [(reading - columns @ without)[~seen], (reading - further @ with_it)[~seen]]
        fall += errors[0] @ inverse @ errors[0] - errors[1] @ inverse @ errors[1]
        change = errors[0] - errors[1]
        score, square = score + change @ inverse @ errors[0], square + change @ inverse @ change
    return fall / SIGMA_MPS2**2, score / SIGMA_MPS2**2, square / SIGMA_MPS2**2


def test_a_half_predicts_the_other_as_least_squares_by_hand_do() -> None:
    run, force = hidden(4, 10.0)
    before = kf_calib.calibrate(run)
    tried, values = replicated(before, ["second-order"]), run.accel.values.reshape(24, COUNT, 3).mean(axis=1)
    assert [half.named for half in tried.halves] == [("second-order",)] * 2
    for half, first in zip(tried.halves, (0, 1), strict=True):
        seen = np.arange(24) % 2 == first
        assert half.dwells == tuple(np.flatnonzero(~seen) + 1)
        fall, score, square = by_hand(values, force, seen)
        assert half.fall == pytest.approx(fall, rel=0.2)  # the program leaves the first second of a dwell out
        assert np.log(half.p_value) == pytest.approx(float(t.logsf(score / np.sqrt(square), 50)), rel=0.1)
    assert tried.answer == "yes" and tried.fall > 0.5 * tried.predicted


@pytest.mark.slow
def test_true_effects_of_ten_sigma_replicate_and_coefficients_of_noise_do_not() -> None:
    """Of noise at most one in a hundred replicates, whatever is named: of 60 runs with more than 4, p < 0.001."""
    alike = ["second-order", "scale-asymmetry", "cross-axis-square"]
    true = [replicated(kf_calib.calibrate(hidden(seed, 10.0)[0]), alike) for seed in range(30)]
    noise = [replicated(kf_calib.calibrate(hidden(seed, 0.0)[0]), everything()) for seed in range(100, 160)]
    assert sum(tried.answer == "yes" for tried in true) >= 27
    assert not any(tried.answer == "no" for tried in true)
    assert sum(tried.answer == "yes" for tried in noise) <= 4
    assert sum(half.p_value < 0.5 for tried in noise for half in tried.halves) == pytest.approx(60, abs=24)


@pytest.mark.parametrize("runs", [3, *slow(20)])
def test_a_wrong_name_does_not_replicate(runs: int) -> None:
    """A drift in a run that has none: what it takes from one half it does not take from the other."""
    tried = [replicated(kf_calib.calibrate(hidden(seed, 12.0)[0]), ["bias-drift"]) for seed in range(runs)]
    assert not any(each.answer == "yes" for each in tried)


def test_less_than_the_size_predicts_is_no() -> None:
    """In the first half the square is there, in the second it is of the other sign."""
    run, force = hidden(5, 0.0)
    shape = np.abs(force) ** 2 * np.where(np.arange(24) % 2, 1.0, -1.0)[:, None] * 40.0 * SIGMA_MPS2
    run.accel = Stream(run.accel.time_ns, run.accel.values + np.repeat(shape, COUNT, axis=0))
    tried = replicated(kf_calib.calibrate(run), everything())
    assert tried.answer == "no" and tried.fall < 0.0 < tried.predicted


def test_a_misfit_that_is_left_counts_as_noise() -> None:
    before = kf_calib.calibrate(hidden(3, 10.0)[0])
    clear = replicated(before, ["second-order"])
    unclear = replicated(before, ["second-order"], Consistency(50.0 * 100.0, 50, 0.0, False))
    assert unclear.p_value > 100.0 * clear.p_value


@pytest.mark.parametrize("dof", [1.0, 4.5, 60.0])
def test_a_prediction_is_tested_on_one_side_by_students_t(dof: float) -> None:
    for value in (-6.0, -0.4, 0.0, 0.7, 5.0):
        assert _one_sided(value, dof) == pytest.approx(t.sf(value, dof), rel=1e-9)


@pytest.mark.parametrize(("fall", "said"), [
    (40.2, "It replicates: named from half of the dwells, it lowers χ² of the others by 40 (35 predicted; p = 1e-08)."),
    (0.6, "It does not replicate: named from half of the dwells, it lowers χ² of the others by 1 (35 predicted; "
          "p = 0.5), less than its size predicts (p = 0.001)."),
    (-2.8, "It does not replicate: named from half of the dwells, it raises χ² of the others by 2.8, less than its "
           "size predicts (p = 0.001)."),
])  # fmt: skip
def test_what_the_other_half_shows_is_told_in_words(fall: float, said: str) -> None:
    answer, p_value = ("yes", 1e-8) if fall > 9.0 else ("no", 0.5)
    tried = SimpleNamespace(halves=[1, 2], relevant=[1], fall=fall, predicted=35.0, p_value=p_value, p_less=1e-3,
                            answer=answer)  # fmt: skip
    diagnosis: Any = SimpleNamespace(replication=tried)
    assert replication_in_words(diagnosis) == said


def test_few_dwells_cannot_tell() -> None:
    before = kf_calib.calibrate(hidden(3, 30.0, dwells=FEWEST - 1)[0])
    assert replicated(before, ["second-order"]) == Replication()
    assert Replication().answer == "cannot tell"


@pytest.mark.slow
def test_a_diagnosis_has_it_unless_it_is_switched_off() -> None:
    diagnosis = diagnosed("second-order=15sigma")
    assert diagnosis.missing == ("second-order",) and diagnosis.replication is not None
    assert diagnosis.replication.answer == "yes"
    refits = known_runs.refits("second-order=15sigma")
    assert kf_calib.diagnose(diagnosis.before, refits, replicate=False).replication is None
    assert diagnosed().replication is None


def test_what_no_candidate_is_has_no_replication() -> None:
    before = kf_calib.calibrate(hidden(3, 12.0)[0])
    assert replicated(before, ["second-order"]).halves
    assert replicated(before, []).halves == replicated(before, ["no such effect"]).halves == ()


def test_one_orientation_cannot_be_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = hidden(4, 10.0)
    before = kf_calib.calibrate(run)
    monkeypatch.setattr("kf_calib.diagnosis.replication.orientations", lambda dwells: [list(range(len(dwells)))])
    assert replicated(before, ["second-order"]).halves == ()
