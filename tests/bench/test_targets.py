"""What ``--target`` of live and plan says."""

import math

import pytest

from kf_calib.bench.paper_parameters import targets_of
from kf_calib.errors import InputError


def test_targets_by_symbol_by_kind_and_for_all_angles() -> None:
    found = targets_of(("angles=2arcsec", "theta1 = 1 arcsec", "K=5ppm", "b2=1e-4", "b3=20µg"))
    assert found["phi3"] == found["nu2"] == pytest.approx(math.radians(2 / 3600)) == 2 * found["theta1"]
    assert found["K2"] == pytest.approx(5e-6) and found["b2"] == 1e-4 and found["b3"] == pytest.approx(20e-6 * 9.80665)
    assert "b1" not in found and len(found) == 6 + 3 + 2


def test_of_two_targets_for_a_parameter_the_last_counts() -> None:
    assert targets_of(("K1=1ppm", "K=2ppm")) == {"K1": 2e-6, "K2": 2e-6, "K3": 2e-6}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("Q=2ppm", "names no parameter: write NAME=SIGMA"),
        ("K", "names no parameter"),
        ("K=2arcsec", "give a number in one of 1, ppm, permille, %"),
        ("theta=2ug", "one of rad, mrad, urad, deg, arcmin, arcsec"),
        ("b=ug", "one of m/s\\^2, g, mg, ug"),
        ("K=-1ppm", "no sigma above zero"),
        ("K=0", "no sigma above zero"),
        ("K=2,5ppm", "write 2.5 with a point"),
    ],
)
def test_what_is_no_target_is_refused_in_a_sentence(text: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        targets_of([text])
