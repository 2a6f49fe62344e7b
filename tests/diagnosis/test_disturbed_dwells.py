"""One dwell of 27 that something disturbed: it is told, and changes neither the noise of the others nor the verdict."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.independent_bench import BENCH, G, IndependentBench, State
from helpers.long_runs import slow
from scipy.spatial.transform import Rotation
from unknown_trials.small_bench import G_MPS2, RATE_HZ, WHITE_MPS2, SmallRun, visits

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.stepwise_selection import improve
from kf_calib.estimation.calibration import calibrate
from kf_calib.views.diagnosis import disturbed_dwells, next_steps, verdict

DWELLS, READINGS, DISTURBED = 27, 240, 10

COURSES: dict[str, Callable[[Floats], Floats]] = {
    "swing of 11 s": lambda u: np.sin(2.0 * np.pi * 0.09 * READINGS / RATE_HZ * u + 1.0),
    "swing of 1.4 s": lambda u: np.sin(2.0 * np.pi * 0.7 * READINGS / RATE_HZ * u),
    "slip": lambda u: 1.0 * (u >= 0.5),
    "late slip": lambda u: 1.0 * (u >= 0.8),
    "creep": lambda u: u,
    "decay": lambda u: np.exp(-4.0 * u),
    "knock": lambda u: np.exp(-(((u - 0.5) / 0.05) ** 2)),
}

FEW = ("late slip",)


def disturbed(course: str, size_mps2: float, seed: int) -> SmallRun:
    """A run in which one dwell has this course beside its level, in each accelerometer by another amount."""
    at = visits(seed, DWELLS)
    hidden = np.zeros((DWELLS, READINGS, 3))
    shape = COURSES[course](np.arange(READINGS) / READINGS)
    hidden[DISTURBED - 1] = size_mps2 * shape[:, None] * np.array([1.0, 0.5, -0.3])
    return SmallRun(at, hidden, seed)


@pytest.mark.parametrize("size_mps2", [3e-3, *slow(3e-4)])
@pytest.mark.parametrize("course", [*FEW, *slow(*(name for name in COURSES if name not in FEW))])
def test_a_disturbed_dwell_is_named_and_nothing_else(course: str, size_mps2: float) -> None:
    """It was a vibration, a warm-up or a walk with 95 % and more, or inflated the noise tenfold and agreed."""
    diagnosis = diagnose(disturbed(course, size_mps2, 3))
    assert diagnosis.missing == () and not diagnosis.noise
    if diagnosis.consistent is False or size_mps2 > 1e-3:
        assert disturbed_dwells(diagnosis) == [DISTURBED]
        assert f"dwell {DISTURBED}" in verdict(diagnosis)


@pytest.mark.parametrize("course", [*COURSES])
def test_the_noise_of_the_others_is_as_without_it(course: str) -> None:
    noise = calibrate(disturbed(course, 3e-3, 4)).noise
    assert noise.inflation.max() < 1.3
    np.testing.assert_allclose(noise.sigma_mps2, WHITE_MPS2, rtol=0.1)


@pytest.mark.slow
def test_a_run_has_one_p_where_its_readings_change_within_a_dwell() -> None:
    """The means agree with p = 0.01 by their misfit: replay said so beside a diagnosis of p < 1e-300."""
    run = calibrate(disturbed("swing of 11 s", 3e-4, 3))
    assert run.consistency.consistent is False
    assert run.consistency.p_value == diagnose(run).test.p_value
    assert any(f"most in dwell {DISTURBED}, accelerometer 1" in remark for remark in run.warnings)
    quiet = calibrate(replace(disturbed("swing of 11 s", 3e-4, 3), hidden_mps2=np.zeros((DWELLS, READINGS, 3))))
    assert quiet.consistency.consistent and quiet.consistency.trend is None


def test_the_parameters_are_as_without_it() -> None:
    run = disturbed("swing of 1.4 s", 3e-3, 5)
    quiet = calibrate(replace(run, hidden_mps2=np.zeros_like(run.hidden_mps2)))
    errors = calibrate(run).estimate.parameters - quiet.estimate.parameters
    assert (np.abs(errors) < 2.0 * quiet.estimate.sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *slow(2, 3, 4)])
def test_a_swing_of_all_dwells_is_one_of_the_run(seed: int) -> None:
    """It is looked for as before: the loudest dwell alone does not decide."""
    at = visits(seed, DWELLS)
    time_s = at.time_s[:, :, None]
    swing = 3e-5 * np.sin(2.0 * np.pi * 0.7 * time_s + np.array([0.0, 1.0, 2.0]))
    assert diagnose(SmallRun(at, swing, seed)).missing == ("sinusoid",)


# A dwell that is off is a term beside all others: what else is missing is told by the other dwells


def second_order(state: State, size_per_mps2: float) -> np.ndarray:
    """In the second channel, by the force there: small angles of its axis change it by nothing that counts."""
    turned = Rotation.from_euler("YZX", state.angles_rad)
    force = turned.inv().apply([0.0, G, 0.0])
    return size_per_mps2 * force[:, [1]] ** 2 * np.array([0.0, 1.0, 0.0])


def burst(state: State, *dwells: int) -> np.ndarray:
    """A door that is slammed 3 s after the arrival in some dwells, from 1."""
    later_s = state.since_s - 3.0
    shakes = np.isin(state.dwell + 1, dwells) & (later_s > 0.0)
    return 4e-4 * (shakes * np.exp(-np.maximum(later_s, 0.0) / 2.0))[:, None] * np.array([1.0, -0.6, 0.3])


@pytest.mark.slow
@pytest.mark.parametrize("size", [8e-6, *slow(1e-6)])
@pytest.mark.parametrize("seed", [1, *slow(2, 3)])
def test_an_effect_is_named_beside_a_disturbed_dwell(seed: int, size: float) -> None:
    """It was dwell 9 alone with over 99.9 %, and nothing was said of the effect."""
    source = IndependentBench(seed, 18, bias=lambda state: second_order(state, size) + burst(state, 9))
    diagnosis = diagnose(source)
    assert diagnosis.missing == ("second-order",) and disturbed_dwells(diagnosis) == [9]
    found = diagnosis.after.parameters["K2_2"] if diagnosis.after else None
    assert found is not None and abs(found.value - size) < 4.0 * found.sigma
    assert "Dwell 9 does not fit" in diagnosis.verdict and diagnosis.disturbed_readings is not None
    assert next_steps(diagnosis, "run.mcap")[0].command.endswith("--leave-out 9")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *slow(3, 4)])
def test_an_effect_is_added_beside_a_mistyped_pose(seed: int) -> None:
    """A dwell 2 deg off, which nothing but another angle explains."""

    def off(state: State) -> np.ndarray:
        return np.radians(2.0) * (state.dwell == 6)[:, None] * np.array([0.0, 0.0, 1.0])

    source = IndependentBench(seed, 18, gimbals=off, bias=lambda state: second_order(state, 8e-6))
    improved = improve(source)
    assert [step.name for step in improved.steps] == ["second-order"] and improved.because == "consistent"
    assert improved.result.settings.left_out == (7,) and "Dwell 7 does not fit" in improved.reason


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *slow(2, 3)])
def test_several_disturbed_dwells_are_told(seed: int) -> None:
    """They were irregular changes with over 99.9 %, and the advice was a random walk of the biases."""
    diagnosis = diagnose(IndependentBench(seed, 18, bias=lambda state: burst(state, 5, 12)))
    assert diagnosis.missing == () and disturbed_dwells(diagnosis) == [5, 12]
    assert "Several dwells are wrong: dwells 5 and 12 alone do not fit" in diagnosis.verdict
    assert diagnose(IndependentBench(seed, 18, bias=lambda state: burst(state, 5, 12)), replicate=False).unknown


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_readings_that_change_in_all_dwells_are_no_disturbed_dwells(seed: int) -> None:
    """They were a random walk of the biases with 99.5 %, or a second-order term with 98 %."""

    def creeping(state: State) -> np.ndarray:
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], 18)[np.minimum(state.dwell, 17)]
        return 2e-4 * (signs * np.exp(-state.since_s / 3.0))[:, None] * np.array([1.0, 1.0, 0.0])

    diagnosis = diagnose(IndependentBench(3 + seed, 18, bias=creeping))
    assert diagnosis.apart == () and diagnosis.test.consistent is False

    def knocked(state: State) -> np.ndarray:
        at_the_end = (state.dwell == 17) & (state.since_s > 15.0)
        return creeping(state) + 2e-4 * at_the_end[:, None] * np.exp(-(state.since_s - 15.0)[:, None] / 3.0)

    diagnosis = diagnose(IndependentBench(3 + seed, 18, bias=knocked), replicate=False)
    assert diagnosis.unknown and not diagnosis.missing, diagnosis.verdict
    assert diagnosis.likeliest is not None
    assert diagnosis.likeliest.driver == "time since arrival (by another amount in each dwell)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau_s", "size_mps2", "accelerometers"),
    [
        (0.7, 3e-4, (0.0, 1.0, 0.0)),
        (2.0, 6e-5, (0.0, 1.0, 0.0)),
        (5.0, 6e-5, (0.0, 1.0, 0.0)),
        (5.0, 2e-3, (0.0, 1.0, 0.0)),
        (12.0, 3e-4, (1.0, 1.0, 1.0)),
        (np.inf, 8e-4, (1.0, 1.0, 1.0)),
    ],
)
def test_what_each_arrival_starts_anew_is_no_effect(
    tau_s: float, size_mps2: float, accelerometers: tuple[float, float, float]
) -> None:
    """In each dwell by another amount: it was a walk, a warm-up, settling or flexure with up to 99.5 %."""

    def creeping(state: State) -> np.ndarray:
        amounts = np.random.default_rng(3).normal(size=(24, 3))[np.minimum(state.dwell, 23)]
        course = np.exp(-state.since_s / tau_s) if np.isfinite(tau_s) else state.since_s / 8.0
        return size_mps2 * amounts * course[:, None] * np.array(accelerometers)

    diagnosis = diagnose(IndependentBench(5, bias=creeping), replicate=False)
    assert diagnosis.unknown and diagnosis.likeliest is not None, diagnosis.verdict
    assert diagnosis.likeliest.driver == "time since arrival (by another amount in each dwell)"


@pytest.mark.slow
def test_a_dwell_that_does_not_follow_what_all_others_do_is_not_walked_around() -> None:
    """A gimbal that creeps after each move, but for one: a random walk of the biases took the difference. It is what
    each arrival changes beside the function that all others follow."""
    after_moves = partial(creeping_gimbal, but=11)
    diagnosis = diagnose(IndependentBench(5, gimbals=after_moves), replicate=False)
    assert diagnosis.unknown and not diagnosis.missing, diagnosis.verdict
    assert diagnosis.likeliest is not None
    assert diagnosis.likeliest.driver == "time since arrival and last move of gimbal 2"


def creeping_gimbal(state: State, but: int) -> np.ndarray:
    """Errors (n, 3) of the second gimbal, which creeps the way that it came from, in all dwells but one."""
    size_rad = -6e-5 * np.sign(state.moves_rad[:, 1]) * np.exp(-state.since_s / 3.0) * (state.dwell != but)
    return size_rad[:, None] * np.eye(3)[1]


UNSTATED = replace(BENCH, angle_sigma_deg=None, scatter_sigma_mps2=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sizes_deg", "dwells", "bench"),
    [((20.0, 5.0), 12, BENCH),
     *slow(*((sizes, dwells, bench) for sizes in ((0.02, 0.05), (0.5, 3.0), (20.0, 5.0), (2.0, 2.0, 2.0))
             for dwells in (12, 20) for bench in (BENCH, UNSTATED)))],
)  # fmt: skip
def test_several_mistyped_poses_hide_neither_each_other_nor_make_an_effect(
    sizes_deg: tuple[float, ...], dwells: int, bench: Bench
) -> None:
    """They were an eccentric encoder with 99.5 %, or agreed if angles were set no better than 2000 arcsec."""
    wrong = [4, 8, 10][: len(sizes_deg)]

    def off(state: State) -> np.ndarray:
        turns = np.zeros((len(state.time_s), 3))
        for dwell, size_deg in zip(wrong, sizes_deg, strict=True):
            turns[state.dwell == dwell, 1 + dwell % 2] = np.radians(size_deg)
        return turns

    diagnosis = diagnose(IndependentBench(1, dwells, gimbals=off, bench=bench), replicate=False)
    assert disturbed_dwells(diagnosis) == [dwell + 1 for dwell in wrong], diagnosis.verdict
    assert diagnosis.missing == () and diagnosis.consistent is False


class Mistyped(SmallRun):
    """A run of which one pose was mistyped, and of whose table nothing was stated, or all."""

    turned_deg = 0.0
    stated = False

    @property
    def bench(self) -> Bench:
        """What the program is told of the bench."""
        stated = {"angle_sigma_deg": 0.0003, "scatter_sigma_mps2": 0.0} if self.stated else {}
        return Bench(axes_of("yzx"), G_MPS2, latitude_deg=50.0, **stated)

    def __iter__(self) -> Iterator[Batch]:
        for batch in super().__iter__():
            begin_ns, end_ns = (1e9 * self.at.time_s[DISTURBED - 1, [0, -1]]).tolist()
            poses = batch.pose.values.copy()
            poses[(batch.pose.time_ns >= begin_ns) & (batch.pose.time_ns <= end_ns), 1] += np.radians(self.turned_deg)
            yield replace(batch, pose=Stream(batch.pose.time_ns, poses))


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, *slow(True)])
@pytest.mark.parametrize("turned_deg", [10.0, *slow(0.3, 0.01)])
@pytest.mark.parametrize("beside", [False, *slow(True)])
def test_a_mistyped_pose_is_named_whatever_its_size_and_beside_a_large_effect(
    beside: bool, turned_deg: float, stated: bool
) -> None:
    """The misfit is of 1e6 sigma: third-order, or a walk of the biases, was said to be missing with 99.5 %."""
    at = visits(7, 24)
    squares = (at.force_mps2[:, None] / G_MPS2) ** 2 * np.array([2e-3, 0.0, 0.0]) * beside
    run = Mistyped(at, np.broadcast_to(squares, (*at.time_s.shape, 3)), 7)
    run.turned_deg, run.stated = turned_deg, stated
    diagnosis = diagnose(run, replicate=False)
    assert disturbed_dwells(diagnosis) == [DISTURBED]
    assert diagnosis.missing == (("second-order",) if beside else ())
    if not beside:
        assert re.search(r"One dwell is wrong \(.*\): dwell 10 .* as if gimbal z stood at", verdict(diagnosis))
