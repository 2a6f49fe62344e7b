"""What a stated prior says of the sensors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import NOMINAL

from kf_calib.estimation.settings import PRIORS, Prior


@pytest.mark.parametrize(("grade", "sigmas"), [
    ("navigation", (5e-3, 2e-3, 5e-3, 2e-2)), ("mems", (0.1, 0.1, 0.1, 1.0)),
])  # fmt: skip
def test_a_prior_is_twice_as_wide_as_sensors_of_the_grade_are_sold(grade: str, sigmas: tuple[float, ...]) -> None:
    """2.5 mrad, 1000 ppm and 1 mg, or 50 mrad, 5 % and 50 mg: of accelerometer 2, whose axis is y, sensitivities along
    x and z are misalignments, and that along y is the scale factor."""
    covariance = PRIORS[grade].covariance(NOMINAL)[4:8, 4:8]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigmas, rtol=1e-12)
    assert not PRIORS[grade].diffuse


def test_a_diffuse_prior_has_no_covariance() -> None:
    assert PRIORS["diffuse"].diffuse and Prior(misalignment_rad=1e-3, scale=1e-3).diffuse
    with pytest.raises(ValueError, match="a diffuse prior has no covariance"):
        PRIORS["diffuse"].covariance(NOMINAL)
