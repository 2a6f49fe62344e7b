"""Turns of the platform that several effects make alike, so that readings tell only what they make together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.hidden_effects import noisy_source
from helpers.long_runs import slow
from scipy.stats import kstest

from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.stepwise_selection import removals
from kf_calib.errors import UnobservableError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.exchange.calibration_file import open_calibration, save_calibration
from kf_calib.sources.simulation.simulator import Simulation

pytestmark = pytest.mark.usefixtures("unmeasured")

MIDDLE, INNER, OFFSET = "axis-nonorthogonality:z", "axis-nonorthogonality:x", "encoder-offset:z"
SIZES_RAD = 2e-6, -3e-6  # of the tilts of both axes, about both of their directions


def tilted(seed: int) -> Simulation:
    """With the outer axis vertical, a tilt of either of the others about it is a heading, less its own turn."""
    return noisy_source(
        *(f"{name}={size}rad" for name, size in zip((MIDDLE, INNER), SIZES_RAD, strict=True)), seed=seed
    )


def fitted(seed: int, *effects: str) -> Calibration:
    return calibrate(tilted(seed), Settings(effects=effects))


def test_one_of_two_that_do_the_same_is_zero_by_convention() -> None:
    """It was estimated from what is of second order in itself: 3e-3 rad, a thousand times the truth, at 140 sigma."""
    both = fitted(1, MIDDLE, INNER)
    assert "tauA_z" in both.parameters and "tauA_x" not in both.parameters
    assert [warning for warning in both.warnings if warning.startswith("tauA_x is zero by convention")]
    assert both.undetermined == () and both.consistency.consistent
    alone = fitted(1, INNER)
    assert {"tauA_x", "tauB_x"} <= {*alone.parameters}  # beside nothing it has both


@pytest.mark.parametrize("seeds", [range(1, 7), *slow(range(1, 41))])
def test_what_both_make_is_found_with_its_sigma(seeds: range) -> None:
    errors = list[float]()
    for seed in seeds:
        source, found = tilted(seed), fitted(seed, MIDDLE, INNER)
        true = source.sensors.parameters | {"tauB_x": SIZES_RAD[1]}
        names = [*(f"{kind}{i}" for kind in "Kb" for i in (1, 2, 3)), "tauB_x"]
        errors += [(abs(found.parameters[name].value) - abs(true[name])) / found.parameters[name].sigma
                   for name in names]  # fmt: skip
    assert kstest(errors, "norm").pvalue > 1e-3
    assert float(np.std(errors)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * len(errors)))


def test_the_engines_agree_on_it() -> None:
    assert compare(tilted(1), Settings(effects=(MIDDLE, INNER))).max_difference_sigma < 1e-5


def test_it_is_saved_and_used_again(tmp_path: Path) -> None:
    path, both = tmp_path / "c.json", fitted(1, MIDDLE, INNER)
    save_calibration(both, path)
    model = open_calibration(path).model(path)
    assert [c.symbol for c in model.coefficients] == ["tauA_z", "tauB_z", "tauB_x"]


def test_an_effect_that_does_nothing_else_is_not_added() -> None:
    """By hand it may be in the model: nothing is taken from the others by it."""
    both, three = fitted(1, MIDDLE, INNER), fitted(1, MIDDLE, INNER, OFFSET)
    assert three.consistency.statistic == pytest.approx(both.consistency.statistic, rel=1e-9)
    assert [each.dof for each in removals(three.fit)] == [2, 1, 0]
    with pytest.raises(UnobservableError, match="encoder-offset:z does what others in the model do"):
        Refits(None).with_effects(both, (OFFSET,))
