"""Which runs can be diagnosed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from helpers.synthetic import Run

from kf_calib.diagnosis.refits import calibration_of
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.noise.terms import Scatter


def test_a_run_is_diagnosed_where_angles_readings_or_a_statement_tell_its_noise() -> None:
    """Means without angles and without standard deviations leave their noise to the misfit."""
    run = calibrate(Run(seed=1, dwells=6, count=60))
    for angles, within_seen, scatter_stated in itertools.product((False, True), repeat=3):
        noise = replace(run.noise, within_seen=within_seen).with_terms(Scatter(stated=scatter_stated))
        bench = replace(run.bench, angles=angles, axes=run.bench.axes if angles else ())
        given = replace(run, bench=bench, fit=replace(run.fit, noise=noise))
        if angles or within_seen or scatter_stated:
            assert calibration_of(given)[0] is given
        else:
            with pytest.raises(InputError, match="leave one number a pose"):
                calibration_of(given)
