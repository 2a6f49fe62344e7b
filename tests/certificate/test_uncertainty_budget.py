"""The uncertainty budget: sensitivities against recalibrations, degrees of freedom in closed form."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.synthetic import SYMBOLS, Run

from kf_calib import calibrate
from kf_calib.bench import paper_parameters
from kf_calib.bench.streams import Batch, Stream
from kf_calib.certificate.budget import COVERAGE, Budget, Contribution, budget, coverage_factor
from kf_calib.certificate.statement import TypeB
from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration

ARCSEC = math.radians(1.0 / 3600.0)


class Misread(Run):
    """A run whose encoders read otherwise than the gimbals stand."""

    offset_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __iter__(self) -> Iterator[Batch]:
        for batch in super().__iter__():
            yield Batch(batch.accel, Stream(batch.pose.time_ns, batch.pose.values + np.array(self.offset_rad)))


def quiet(**options: Any) -> Misread:
    """A run with next to no noise, whose scatter and setting error are stated as none."""
    run = Misread(seed=3, white_mps2=1e-9, **options)
    run.bench = replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    return run


def values(result: Calibration) -> np.ndarray:
    return np.array([result.parameters[symbol].value for symbol in SYMBOLS])


@pytest.fixture(scope="module")
def saved() -> SavedCalibration:
    return calibration_file.saved(calibrate(quiet()))


@pytest.mark.parametrize(("gimbal", "letter"), list(enumerate("yzx")))
def test_a_shifted_encoder_moves_the_parameters_as_its_sensitivity_says(
    saved: SavedCalibration, gimbal: int, letter: str
) -> None:
    run = quiet()
    run.offset_rad = tuple(np.eye(3)[gimbal] * -ARCSEC)  # the gimbal stands ahead of what the encoder reads
    moved = values(calibrate(run)) - saved.twelve[0]
    _, line = budget(saved, saved.model(), [TypeB(effect=f"encoder-offset:{letter}", size="1 arcsec")]).contributions
    assert line.sensitivity is not None
    assert moved == pytest.approx(line.sensitivity * ARCSEC, abs=2e-3 * ARCSEC)
    assert line.parts == pytest.approx(np.abs(moved), abs=2e-3 * ARCSEC)


def test_a_wrong_gravity_is_a_common_scale(saved: SavedCalibration) -> None:
    run = quiet()
    run.bench = replace(run.bench, gravity_mps2=run.bench.gravity_mps2 / (1 + 1e-5))
    moved = values(calibrate(run)) - saved.twelve[0]
    _, line = budget(saved, saved.model(), [TypeB(effect="gravity-error", size="10 ppm", k=2.0)]).contributions
    assert 2.0 * line.parts == pytest.approx(np.abs(moved), abs=1e-9)
    assert line.parts[[2, 6, 10]] == pytest.approx(saved.twelve[0][[2, 6, 10]] * 5e-6)


def test_what_differs_from_dwell_to_dwell_adds_as_noise_does(saved: SavedCalibration) -> None:
    """A bias of 1 m/s^2 of accelerometer 2, drawn anew in each of the dwells, which weigh by their readings."""
    wild = TypeB(effect="thermal-bias", size="2 mps2/K", temperature="0.5 K", varies="dwell")
    line = budget(saved, saved.model(), [wild]).contributions[2]
    poses = np.radians([dwell.gimbal_deg for dwell in saved.conditions.dwells])
    force = saved.bench.specific_force(np.zeros(len(poses)), poses)
    rows = np.column_stack([force, np.ones(len(force))])
    jacobian = paper_parameters.jacobian(np.array(saved.state.values[:12]))[4:8, 4:8]
    weighted = rows.T * [dwell.readings for dwell in saved.conditions.dwells]
    expected = np.linalg.norm(jacobian @ np.linalg.inv(weighted @ rows) @ weighted, axis=1)
    assert line.parts[4:8] == pytest.approx(expected, rel=1e-6)
    assert line.parts[[0, 1, 2, 3, 8, 9, 10, 11]] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("distribution", "divisor"), [("rectangular", 3.0), ("triangular", 6.0), ("arcsine", 2.0)])
def test_half_a_width_becomes_a_standard_uncertainty(
    saved: SavedCalibration, distribution: Any, divisor: float
) -> None:
    own = TypeB(effect="encoder-offset:z", size="1 arcsec", distribution=distribution)
    assert budget(saved, saved.model(), [own]).contributions[1].standard == pytest.approx(ARCSEC / math.sqrt(divisor))


def test_an_effect_in_the_model_is_no_error_of_the_result_any_more() -> None:
    own = calibration_file.saved(calibrate(quiet(), Settings(effects=("encoder-offset:z",))))
    _, line = budget(own, own.model(), [TypeB(effect="encoder-offset:z", size="1 arcsec")]).contributions
    assert line.parts == pytest.approx(0.0, abs=1e-9 * ARCSEC)


def test_what_needs_temperatures_of_dwells_is_left_out_and_said(saved: SavedCalibration) -> None:
    """A file whose model has an effect of temperature."""
    state = saved.state.model_copy(update={
        "symbols": [*saved.state.symbols, "alpha1", "alpha2", "alpha3"],
        "values": [*saved.state.values, 0.0, 0.0, 0.0],
        "covariance": np.pad(np.array(saved.state.covariance), (0, 3)).tolist(),
    })  # fmt: skip
    effect = calibration_file.SavedEffect(text="thermal-bias")
    alphas = [calibration_file.SavedParameter(symbol=symbol, value=0.0, sigma=None, unit="m/s^2/K", nominal=0.0)
              for symbol in state.symbols[-3:]]  # fmt: skip
    parameters = [*saved.parameters, *alphas]
    own = saved.model_copy(update={"state": state, "effects": [effect], "parameters": parameters})
    found = budget(own, own.model(), [TypeB(effect="gravity-error", size="1 ppm")])
    assert found.left_out == ("thermal-bias",)


def line(parts: float, dof: float) -> Contribution:
    return Contribution("u", "", "B", None, "", "normal", dof, None, parts**2 * np.eye(12))


def test_effective_degrees_of_freedom_are_those_of_welch_and_satterthwaite() -> None:
    assert Budget((line(1.0, 5.0), line(1.0, 5.0))).dof == pytest.approx(10.0)
    three = Budget((line(3.0, 4.0), line(4.0, math.inf), line(0.0, 1.0)))
    assert three.combined == pytest.approx(5.0)
    assert three.dof == pytest.approx(5.0**4 / (3.0**4 / 4.0))
    assert three.expanded == pytest.approx(5.0 * coverage_factor(np.array([30.0]))[0])
    assert np.isinf(Budget((line(1.0, math.inf),)).dof).all()


def test_coverage_factors_are_those_of_the_gum() -> None:
    """Table G.2 for 95.45 %."""
    dof = np.array([1.0, 2.0, 5.0, 10.9, 20.0, 50.0, math.inf])
    assert coverage_factor(dof) == pytest.approx([13.97, 4.53, 2.65, 2.28, 2.13, 2.05, 2.0], abs=0.005)
    assert COVERAGE == pytest.approx(0.9545, abs=1e-5)


@pytest.mark.parametrize(
    ("own", "said"),
    [(TypeB(effect="gravity", size="1 ppm"), "did you mean gravity-error"),
     (TypeB(effect="gravity-error", size="1 arcsec"), "not in a unit of this kind"),
     (TypeB(effect="thermal-bias", size="1 ug/K"), "say by how much the temperature may be off"),
     (TypeB(effect="latency", size="1 ms"), "name an effect that shows in dwells")],
)  # fmt: skip
def test_an_error_that_cannot_be_carried_is_one_sentence(saved: SavedCalibration, own: TypeB, said: str) -> None:
    with pytest.raises(InputError, match=said):
        budget(saved, saved.model(), [own])


def test_a_run_without_anything_left_over_needs_its_noise_stated(saved: SavedCalibration) -> None:
    own = saved.model_copy(update={
        "noise": saved.noise.model_copy(update={"dwell_sigma_stated": False}),
        "consistency": saved.consistency.model_copy(update={"dof": 0}),
    })  # fmt: skip
    with pytest.raises(InputError, match="state --angle-sigma"):
        budget(own, own.model(), [])
