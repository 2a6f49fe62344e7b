"""What a script may write: paths for open recordings, one effect by its name; and sentences for what cannot be."""

import math
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import ROOT

import kf_calib
from kf_calib.dwells.stationarity import Stillness
from kf_calib.errors import InputError
from kf_calib.estimation.settings import Prior

RECORDING = ROOT / "recordings" / "mems_faces.mcap"


@pytest.fixture(scope="module")
def run() -> kf_calib.Calibration:
    return kf_calib.calibrate(kf_calib.open_recording(RECORDING))


@pytest.mark.parametrize("path", [RECORDING, str(RECORDING)])
def test_a_path_is_a_recording(run: kf_calib.Calibration, path: str | Path) -> None:
    np.testing.assert_array_equal(kf_calib.calibrate(path).estimate.state, run.estimate.state)


@pytest.mark.usefixtures("unmeasured")
def test_a_path_can_be_compared_diagnosed_and_improved(run: kf_calib.Calibration) -> None:
    np.testing.assert_array_equal(kf_calib.compare(RECORDING).result.estimate.state, run.estimate.state)
    assert kf_calib.diagnose(str(RECORDING)).verdict == kf_calib.diagnose(run).verdict
    assert kf_calib.improve(RECORDING).effects == kf_calib.improve(run).effects


@pytest.mark.parametrize("effects", ["hysteresis", ["hysteresis"], ("hysteresis",)])
def test_one_effect_goes_by_its_name(effects: str | list[str] | tuple[str, ...]) -> None:
    settings = kf_calib.Settings(effects=effects)
    assert settings.effects == ("hysteresis",) and settings == kf_calib.Settings(effects=("hysteresis",))
    assert [str(each) for each in kf_calib.calibrate(RECORDING, settings).model.effects] == ["hysteresis"]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"engine": "blok"}, "engine 'blok' is not known: use block or filterpy."),
        ({"prior": "mems"}, "prior is 'mems': give a Prior"),
        ({"stillness": 0.1}, "stillness is 0.1: give a"),
        ({"gate_sigma": 1.0}, "gate_sigma .--gate-sigma. is 1.0: give a number of at least 3."),
        ({"gate_sigma": math.nan}, "gate_sigma .* is nan"),
        ({"walk_mps2_per_sqrt_s": -1e-6}, "walk_mps2_per_sqrt_s .* is -1e-06: give a number of at least 0."),
        ({"walk_mps2_per_sqrt_s": math.inf}, "is inf"),
        ({"window_s": "1"}, "window_s is '1'"),
    ],
)
def test_settings_that_cannot_be_are_refused_when_made(given: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        kf_calib.Settings(**given)


@pytest.mark.parametrize(
    "given", [{"tolerance_deg": 0.0}, {"tolerance_deg": math.nan}, {"settle_s": -1.0}, {"window_s": 0}, {"lead_s": ""}]
)
def test_margins_that_cannot_be_are_refused_when_made(given: dict[str, object]) -> None:
    with pytest.raises(InputError, match="give a number"):
        Stillness(**given)


def test_a_prior_that_cannot_be_is_refused_when_made() -> None:
    with pytest.raises(InputError, match="the prior's scale is -1"):
        Prior(misalignment_rad=0.1, scale=-1, bias_mps2=1.0)
