"""A name is earned by a coefficient that is seen and by an error of what was left out that falls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.paths import REAL
from real_trials.turned import TurnedRecording

import kf_calib
from kf_calib.diagnosis.hypothesis_table import IRREGULAR, NONE, NOTHING, Hypothesis, table_of
from kf_calib.diagnosis.missing_effect import SEEN, behind_nothing, diagnose, unearned
from kf_calib.effects import walk_named
from kf_calib.estimation.results import Consistency
from kf_calib.views.diagnosis import found_object


class _Effect:
    parameters = coefficients = (SimpleNamespace(symbol="k1"), SimpleNamespace(symbol="k2"))

    def __init__(self, oscillates: bool = False) -> None:
        self.oscillates = oscillates

    def __str__(self) -> str:
        return "bent"


def _result(
    ratio: float | None, held_out: float | None, walk_gain: float = 0.0, correlation: float = 0.0, floor: float = 0.85
) -> Any:
    """A calibration with an effect of two coefficients, of which the second is ``ratio`` sigmas or not determined.

    held_out: the error of orientations left out. floor: what noise gives of it.
    """
    covariance = np.array([[1.0, 2.0 * correlation], [2.0 * correlation, 4.0]])
    second = SimpleNamespace(value=None if ratio is None else -2.0 * ratio, sigma=None if ratio is None else 2.0)
    state = np.array([0.1, -2.0 * (ratio or 0.0)])
    return SimpleNamespace(
        model=SimpleNamespace(effects=[_Effect()], parts={"bent": slice(0, 2)}),
        estimate=SimpleNamespace(state=state, covariance=covariance),
        fit=SimpleNamespace(walk_gain=walk_gain),
        parameters={"k1": SimpleNamespace(value=0.1, sigma=1.0), "k2": second},
        held_out_rms_mps2=held_out,
        held_out_floor_mps2=floor,
        consistency=Consistency(100.0, 100, 1e-6, False),
    )


@pytest.mark.parametrize(
    "ratio, errors, said",
    [
        (3.1, (1.0, 0.9), ""),
        (2.9, (1.0, 0.9), "no coefficient of bent is beyond 3 sigma"),
        (None, (1.0, 0.9), "no coefficient of bent is beyond 3 sigma"),
        (5.0, (1.0, 1.25), "it makes the held-out error 1.25 times as large"),
        (5.0, (1.0, 1.01), ""),  # what shows within dwells alone
        (5.0, (1.0, 1.06), "it makes the held-out error 1.06 times as large"),
        (5.0, (None, 1.25), ""),
    ],
)
def test_what_a_name_is_earned_by(ratio: float | None, errors: tuple[float | None, float], said: str) -> None:
    row = Hypothesis(("bent",), refit=_result(ratio, errors[1]))
    assert unearned(row, _result(None, errors[0]), "bias-walk") == said


@pytest.mark.parametrize(
    "ratio, nis_per_dof, said",
    [
        (5.0, 2.5, ""),
        (5.0, 4.0, "no coefficient of bent is beyond 3 sigma of what is left, which is 2 times the noise"),
        (2.9, 4.0, "no coefficient of bent is beyond 3 sigma"),
        (40.0, 100.0, ""),
    ],
)
def test_a_coefficient_is_measured_by_what_it_leaves(ratio: float, nis_per_dof: float, said: str) -> None:
    row = Hypothesis(("bent",), refit=_result(ratio, 0.9))
    assert row.refit is not None
    row.refit.consistency = Consistency(100.0 * nis_per_dof, 100, 1e-6, False)
    assert unearned(row, _result(None, 1.0), "bias-walk") == said


@pytest.mark.parametrize("held_out, floor, earned", [(0.99, 0.5, False), (0.9, 0.5, True), (0.99, 0.9, True)])
@pytest.mark.parametrize("oscillates, said", [
    (True, "it goes on within the orientations, and leaves the misfit between them as it was"),
    (False, "it leaves the error of orientations left out as it was"),
])  # fmt: skip
def test_what_leaves_the_orientations_unexplained_is_not_named(
    held_out: float, floor: float, earned: bool, oscillates: bool, said: str
) -> None:
    """Where noise alone gives as much, there is nothing left to explain."""
    after = _result(5.0, held_out, floor=floor)
    after.model.effects = [_Effect(oscillates)]
    assert unearned(Hypothesis(("bent",), refit=after), _result(None, 1.0), "bias-walk") == ("" if earned else said)


def test_formulas_that_leave_the_orientations_unexplained_are_not_believed() -> None:
    row = Hypothesis(formulas=("mine = t",), refit=_result(5.0, 0.99, floor=0.5))
    assert unearned(row, _result(None, 1.0), "bias-walk") == "it leaves the error of orientations left out as it was"


@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings of others are not there")
@pytest.mark.slow
def test_creep_of_a_real_unit_is_not_called_an_oscillation() -> None:
    """With its poses stated to 0.05 deg, as gimbals would show them."""
    recording = TurnedRecording(REAL / "xsens_mti.csv.gz")
    diagnosis = diagnose(recording.altered(np.zeros(3)), replicate=False)
    assert diagnosis.missing == () and "sinusoid" not in diagnosis.ambiguity
    assert "In dwell 1 the readings swing with a period of 13 s, as in no other dwell" in diagnosis.verdict
    told = found_object(diagnosis)["disturbed_dwell"]
    assert told["number"] == 1 and told["frequency_hz"] == pytest.approx(1.0 / 13.0, rel=0.1) and told["p_value"] < 1e-4


@pytest.mark.parametrize("nothing, said", [(0.6, "that nothing is missing is likelier (60 %)"), (0.3, "")])
def test_a_name_is_not_earned_where_nothing_missing_is_likelier(nothing: float, said: str) -> None:
    rows = [
        Hypothesis(families=(NOTHING,), log_evidence=np.log(nothing)),
        Hypothesis(("bent",), families=("nonlinearity",), log_evidence=np.log(0.9 * (1.0 - nothing))),
        Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=np.log(0.1 * (1.0 - nothing))),
    ]
    table = table_of(rows)
    assert table.first.effects == ("bent",) and behind_nothing(table.first, table) == said
    assert behind_nothing(Hypothesis(driver=IRREGULAR, families=(NONE,)), table) == ""


@pytest.mark.parametrize("correlation, earned", [(0.8, False), (0.826, False), (0.833, True), (0.97, True)])
def test_coefficients_that_are_alike_earn_their_name_together(correlation: float, earned: bool) -> None:
    """Of 0.1 and -2.9 sigmas: Wald's statistic is 24.7 with a correlation of 0.8, 28.0, 29.1, and 150 with one of 0.97;
    the probability of two normal variates is that of one beyond 5 sigma, 6e-7, at 28.7."""
    row = Hypothesis(("bent",), refit=_result(2.9, 0.9, correlation=correlation))
    assert (unearned(row, _result(None, 1.0), "bias-walk") == "") == earned


@pytest.mark.parametrize("gain, said", [(4.4, "bias-walk is below 3 sigma"), (4.6, "")])
def test_a_walk_is_earned_by_its_likelihood(gain: float, said: str) -> None:
    row = Hypothesis(("bias-walk",), refit=_result(None, 0.9))
    assert unearned(row, _result(None, 1.0, gain), "bias-walk") == said


@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings of others are not there")
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["iPhone4S_d2", "mpu6050", "mpu9150_0", "mpu9150_1", "nexus5_d1", "nexus5_d2", "xsens_mti"]
)
def test_what_is_named_in_a_real_recording_is_seen_in_it(name: str) -> None:
    diagnosis = diagnose(kf_calib.open_log(REAL / f"{name}.csv.gz", {"gravity_mps2": "9.80665"}, angles=False))
    for effect in diagnosis.missing:
        assert diagnosis.after is not None
        if effect == walk_named(diagnosis.before.bench):
            continue
        of_effect = next(each for each in diagnosis.after.model.effects if str(each) == effect)
        known = [diagnosis.after.parameters[coefficient.symbol] for coefficient in of_effect.parameters]
        assert max(abs(p.value) / p.sigma for p in known if p.value is not None and p.sigma) > SEEN
    if name in ("mpu9150_0", "mpu9150_1", "nexus5_d2"):  # |f| agrees by an independent test
        assert diagnosis.test.consistent
    elif not diagnosis.missing and not diagnosis.noise:
        assert diagnosis.unearned or diagnosis.unknown
