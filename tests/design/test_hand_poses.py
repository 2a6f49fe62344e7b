"""Which sides to turn up where there are no angles."""

from typing import Any

import numpy as np
import pytest
from helpers.paths import RECORDINGS
from helpers.synthetic import G

from kf_calib.bench.bench import Bench
from kf_calib.design.sides import SYMBOLS, HandPlan
from kf_calib.estimation.free_attitude import DIRECTIONS
from kf_calib.estimation.measurement_model import Model

MODEL = Model(Bench((), G, angles=False, nominal={"theta1": 0.0, "theta3": 0.0}))


def test_the_predicted_sigmas_are_those_of_least_squares_on_the_size_of_f() -> None:
    made = HandPlan.of(14, MODEL, 1e-3)
    unit = np.array([DIRECTIONS[up] for up in made.up])
    x, y, z = unit.T
    slopes = np.column_stack([G * x * x, x, G * x * y, G * y * y, y, G * y * z, G * x * z, G * z * z, z])
    sigma = 1e-3 * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    order = ["K1", "b1", "nu1", "K2", "b2", "theta3", "phi3", "K3", "b3"]
    assert made.sigma[-1] == pytest.approx([sigma[order.index(symbol)] for symbol in SYMBOLS], rel=1e-4)


def test_six_faces_come_first_and_nine_poses_and_more_determine_all() -> None:
    made = HandPlan.of(12, MODEL, 1e-3)
    assert set(made.up[:6]) == {"+x", "-x", "+y", "-y", "+z", "-z"}
    assert (np.diff(made.sigma, axis=0) < 1e-12).all()
    assert made.sigma[-1].max() < 1e-2 < made.sigma[6].max()


def test_the_command_plans_after_a_run_and_refuses_what_belongs_to_gimbals(run: Any) -> None:
    printed = run.json("plan", "--no-angles", "--recording", RECORDINGS / "mems_faces.mcap")
    assert printed["up"] == ["+x +y +z"] and printed["gimbal_deg"] is None
    assert all(printed["sigma"][symbol] <= printed["sigma_before"][symbol] for symbol in SYMBOLS)
    assert "sides to turn up by hand" in run.refused("plan", "--no-angles", "--grid-deg", "5")
