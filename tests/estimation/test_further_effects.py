"""Groups of effects, each tested for itself, give what one scan of all gives; and known effects are recognised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import plan_of

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.diagnosis.refits import Refits
from kf_calib.effects import effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_columns import candidate_columns, piece_columns, stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import Frame, FurtherEffects
from kf_calib.estimation.whitened_rows import MisfitColumns, misfit_rows
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=1e-3, scatter_sigma_mps2=1e-5)
GROUPS = [["mine = a*p*o"], ["mine = sin(3*q1)", "mine2 = cos(3*q1)"], ["mine = a*a"], ["mine = a*a", "mine2 = T"]]


@pytest.fixture(scope="module")
def before() -> Calibration:
    base = Simulation(
        BENCH, GRADES["navigation"].sensors(5), TrueNoise(white_mps2=5e-5), plan_of(12, dwell_s=8.0, seed=5),
        sample_hz=20.0, angle_hz=20.0, slew_rate_degps=90.0, seed=5,
    )  # fmt: skip
    return calibrate(base.hiding(parse(["second-order=40ug/g^2"], BENCH.axes, seed=5)))


@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_groups_give_what_one_scan_gives(before: Calibration, walk_mps2: float) -> None:
    noise = replace(before.noise.for_goodness_of_fit, walk_mps2_per_sqrt_s=walk_mps2)
    known = [effect_named(name, BENCH) for name in ("second-order", "settling", "cross-coupling-io")]
    frame = Frame(before.linearised, noise, known[:2])
    groups = [[effect_named(text, BENCH) for text in group] for group in GROUPS]
    tests = FurtherEffects(frame, before.linearised, known, 0.99)
    together = frame.scan(before.linearised, [effect for group in groups for effect in group])
    expected, last = iter(together.candidates[2:]), 2
    for group, (found, are_known) in zip(groups, tests.scans(groups), strict=True):
        own = [next(expected) for _ in group]
        first, last = last, last + len(group)
        np.testing.assert_allclose(found.statistics, together.statistics[first:last], rtol=1e-6, atol=1e-9)
        bases = [np.concatenate([each.basis for each in some], axis=1) for some in (found.candidates, own)]
        (fall, rank), (one_fall, one_rank) = found.explained(bases[0]), together.explained(bases[1])
        assert rank == one_rank
        assert fall == pytest.approx(one_fall, rel=1e-6)
        assert are_known == [each.within(together.candidates[0], 0.99) for each in own]
    assert [known for _, known in tests.scans(groups)] == [[False], [False, False], [True], [True, False]]


def test_an_effect_that_the_frame_lacks_is_known_too(before: Calibration) -> None:
    frame = Frame(before.linearised, before.noise.for_goodness_of_fit, [])
    tests = FurtherEffects(frame, before.linearised, [effect_named("second-order", BENCH)], 0.99)
    assert [known for _, known in tests.scans([[effect_named("mine = a*a", BENCH)]])] == [[True]]


def test_an_effect_in_the_model_leaves_nothing_of_its_formula(before: Calibration) -> None:
    fitted = Refits().with_effects(before, ("second-order",)).fit
    frame = Frame(fitted.linearised, fitted.noise.for_goodness_of_fit, candidates(Model(BENCH)))
    ((found, are_known),) = FurtherEffects(frame, fitted.linearised, [], 0.99).scans(
        [[effect_named("mine = a*a", BENCH)]]
    )
    assert found.candidates[0].dof == 0
    assert are_known == [False]


@pytest.mark.parametrize("scatter_mps2", [0.0, 1e-5])
def test_columns_alone_are_those_of_all_rows(before: Calibration, scatter_mps2: float) -> None:
    """Also where the readings of dwells have unequal weights."""
    linearised, noise = (
        before.linearised,
        replace(before.noise.for_goodness_of_fit, scatter_mps2=np.full(3, scatter_mps2)),
    )
    dwells = [dwell.weighted(1.0 + 0.5 * (k % 3)) for k, dwell in enumerate(linearised.dwells)]
    effects = candidates(Model(BENCH))[:9]
    added = candidate_columns(dwells, effects, BENCH, linearised.state)
    rows, width = misfit_rows(dwells, added, noise, linearised.state, 0, reduced=False)
    found = MisfitColumns(dwells, noise, linearised.state)
    columns = found.of(piece_columns(effects, stimulus_of(dwells, BENCH, linearised.state)))
    np.testing.assert_allclose(
        columns, np.concatenate(rows)[:, width:-1], rtol=1e-12, atol=1e-12 * np.abs(columns).max()
    )
    assert found.ends[-1] == len(columns)
