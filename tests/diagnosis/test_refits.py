"""Which runs can be diagnosed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.altered import Altered
from helpers.by_hand import by_hand
from helpers.hidden_effects import noisy_source
from helpers.synthetic import Run, plan_of

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits, calibration_of
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.settings import Settings
from kf_calib.noise.terms import Scatter
from kf_calib.views.diagnosis import disturbed_dwells


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


@pytest.mark.parametrize("source", [Run(seed=1, dwells=12, count=60), by_hand()], ids=["angles", "in the hand"])
def test_a_run_without_dwells_is_that_which_leaves_them_out(source: Source) -> None:
    before = calibrate(source)
    rest, alone = Refits(source).without_dwells(before, (3, 8)), calibrate(source, Settings(left_out=(3, 8)))
    assert rest is not None and len(rest.fit.dwells) == len(before.fit.dwells) - 2
    for symbol, parameter in alone.parameters.items():
        assert rest.parameters[symbol].value == pytest.approx(parameter.value, abs=1e-3 * (parameter.sigma or 1e-9))


def test_a_refit_has_the_dwells_of_its_run_though_some_are_too_short_for_averages() -> None:
    """A real recording of which three poses last 0.4 s ended in a ValueError, and three dwells less are no evidence."""
    plan = plan_of(14, dwell_s=8.0, seed=3)
    source = noisy_source(plan=[replace(visit, dwell_s=0.6 if k == 9 else 8.0) for k, visit in enumerate(plan)])
    before = calibrate(source)
    assert len(calibrate(source, effects="vibration-rectification").fit.dwells) < len(before.fit.dwells) == 14
    refit = Refits(source).with_effects(before, ("vibration-rectification",))
    assert [*refit.fit.dwells.folded.numbers] == [*before.fit.dwells.folded.numbers]


def test_a_disturbed_dwell_in_the_hand_is_told_and_the_others_are_diagnosed() -> None:
    """Left out in words only, it was left out again and again."""
    run = by_hand()
    seventh = calibrate(run).fit.dwells[6]
    moment_s = 0.5 * (seventh.start_s + seventh.end_s)

    def knocked(time_s: Floats, readings: Floats) -> Floats:
        return readings + 0.05 * (np.abs(time_s - moment_s) < 1.0)[:, None]

    found = diagnose(Altered(run, knocked), replicate=False)
    (number,) = disturbed_dwells(found)
    (told,) = [dwell for dwell in found.before.fit.dwells if dwell.number == number]
    assert told.start_s < moment_s + 1.0 and moment_s - 1.0 < told.end_s  # the knock may divide the dwell
    assert not found.missing, found.verdict
