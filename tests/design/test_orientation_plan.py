"""Plans against closed forms, the equivalence theorem, brute force and simulated runs."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.optimize import minimize

from kf_calib.bench import paper_parameters
from kf_calib.bench.bench import Bench, axes_of, axis_names
from kf_calib.bench.keys import ranges
from kf_calib.bench.paper_parameters import targets_of
from kf_calib.design import optimality_criteria
from kf_calib.design.exact_design import Scheme, Search
from kf_calib.design.gimbal_limits import GimbalLimits, Timing, middles_s, order, slews_s, time_correlation
from kf_calib.design.orientation_plan import fewest, papers_sigma, plan
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.dwells.qr import triangle
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.calibration import calibrate

G, SIGMA, READINGS = 9.81, 1e-4, 100
BENCH = Bench(axes_of("yzx"), G)
TIMING = Timing(30.0, 20.0)
ANGLES = [k for k, unit in enumerate(paper_parameters.UNITS) if unit == "rad"]
SCALES = [k for k, unit in enumerate(paper_parameters.UNITS) if unit == "1"]
BIASES = [k for k, unit in enumerate(paper_parameters.UNITS) if unit == "m/s^2"]
TABLE_2_OPTIMAL = [0.7152, 0.6555, 1.1370, 12.0713, 0.6982, 0.6816, 1.2563, 10.7666, 0.7201, 0.6652, 1.0919, 11.4856]


def information(**keys: float) -> PredictedInformation:
    return PredictedInformation.of_bench(Bench(axes_of("yzx"), G, **keys), SIGMA, READINGS, 30.0)


def search(
    limits: GimbalLimits | None = None,
    aim: optimality_criteria.Aim = optimality_criteria.D,
    scheme: Scheme | None = None,
    **keys: float,
) -> Search:
    return Search(information(**keys), limits or GimbalLimits(BENCH), aim, scheme or Scheme())


def up(poses: np.ndarray) -> np.ndarray:
    """(0, 1, 0) seen from the platform, axes y z x, by plain trigonometry."""
    z, x = poses[:, 1], poses[:, 2]
    return np.column_stack([np.sin(z), np.cos(z) * np.cos(x), -np.cos(z) * np.sin(x)])


def d_efficiency(poses: np.ndarray) -> float:
    """(det M / det M*)^(1/4) of [u, 1], M* = N diag(1/3, 1/3, 1/3, 1)."""
    design = np.column_stack([up(poses), np.ones(len(poses))])
    return float((np.linalg.det(design.T @ design / len(poses)) * 27.0) ** 0.25)


@pytest.mark.parametrize("count", [4, 6, 12, *slow(8, 20, 24)])
def test_without_limits_the_plan_is_d_optimal(count: int) -> None:
    made = plan(search(), count, TIMING)
    assert d_efficiency(made.poses) > 0.999 and made.d_efficiency == pytest.approx(d_efficiency(made.poses), abs=1e-5)
    assert made.largest_variance == pytest.approx(12.0, abs=0.02)  # the equivalence theorem
    assert made.condition_number == pytest.approx(math.sqrt(3), rel=1e-3)
    np.testing.assert_allclose(made.directions, up(made.poses), atol=1e-12)
    every = count * READINGS
    for places, closed in (
        (ANGLES + SCALES, SIGMA * math.sqrt(3 / every) / G),
        (BIASES, SIGMA / math.sqrt(every)),
    ):
        np.testing.assert_allclose(made.balanced_sigma[places], closed, rtol=1e-4)
        np.testing.assert_allclose(made.sigma[-1, places], closed, rtol=2e-3)


def test_five_orientations_cannot_be_balanced_and_the_efficiency_says_so() -> None:
    made = plan(search(), 5, TIMING)
    assert made.d_efficiency == pytest.approx(d_efficiency(made.poses), abs=1e-5) and 0.99 < made.d_efficiency < 0.995
    assert made.largest_variance > 12.5


@pytest.mark.parametrize("name", ["A", "E", "minimax", "condition"])
def test_every_criterion_has_the_balanced_set_for_its_optimum(name: str) -> None:
    made = plan(search(aim=optimality_criteria.NAMED[name]), 6, TIMING)
    balanced = optimality_criteria.NAMED[name](triangle(made.information.balanced(6).reshape(-1, 12)))
    assert made.cost == pytest.approx(math.exp(float(balanced)), rel=5e-3)


def test_four_orientations_for_three_accelerometers_beat_the_papers_sets() -> None:
    """Angles, biases and generalised variance of Table 2's optimal column; its scale factors it does not."""
    made = plan(search(), 4, TIMING)
    deviations = np.array([{"rad": math.radians(30 / 3600)}.get(unit, 5e-5) for unit in paper_parameters.UNITS])
    percent = 100 * math.sqrt(2 / math.pi) * made.sigma[-1] / deviations
    assert (percent < TABLE_2_OPTIMAL)[ANGLES + BIASES].all()
    theirs = papers_sigma(made.information)
    for places, closed in (
        (ANGLES, SIGMA * math.sqrt(1 / 100 + 1 / 200) / G),
        (SCALES, SIGMA / math.sqrt(200) / G),
        (BIASES, SIGMA / math.sqrt(200)),
    ):
        np.testing.assert_allclose(theirs[places], closed, rtol=1e-3)
    assert made.generalised_sigma < 0.95 * made.papers_generalised_sigma
    np.testing.assert_allclose(100 * math.sqrt(2 / math.pi) * theirs / deviations, TABLE_2_OPTIMAL, rtol=0.15)


@pytest.mark.parametrize("name", ["D", "A", "minimax"])
def test_exchange_finds_what_brute_force_finds_on_a_small_grid(name: str) -> None:
    limits = GimbalLimits(BENCH, {1: (-60.0, 60.0), 2: (-45.0, 90.0)}, grid_deg=45.0)
    tried = search(limits, optimality_criteria.NAMED[name])
    rows = tried.candidate_rows
    every = np.array(list(itertools.combinations_with_replacement(range(len(rows)), 5)))
    stacked = rows[every].reshape(len(every), -1, 12)
    least = float(np.min(tried.aim(triangle(stacked))))
    assert tried.measure(tried.best(5)) == pytest.approx(least, abs=0.02)


@pytest.mark.slow
def test_the_bound_of_limited_gimbals_is_above_all_designs_and_near_the_best() -> None:
    limited = search(GimbalLimits(BENCH, {1: (-60.0, 60.0), 2: (-60.0, 60.0)}))
    rng = np.random.default_rng(1)
    made = plan(limited, 12, TIMING)
    assert 0.98 < made.d_efficiency_within_reach <= 1.0 and made.d_efficiency < 0.9
    for _ in range(20):
        poses = rng.uniform(-np.pi / 3, np.pi / 3, (12, 3))
        rows = limited.rows(poses)
        assert -2 * float(optimality_criteria.D(limited.factor(rows))) < limited.d_bound(rows)
        assert limited.cost(poses) > limited.cost(made.poses)


def test_limits_zones_grids_and_lists_are_kept() -> None:
    zone = {1: (-40.0, 10.0), 2: (20.0, 80.0)}
    limits = GimbalLimits(BENCH, {1: (-80.0, 110.0), 2: (-100.0, 100.0)}, [zone])
    for chosen in (limits, GimbalLimits(BENCH, limits.limits_deg, [zone], grid_deg=20.0)):
        made = plan(search(chosen), 10, TIMING)
        z, x = made.gimbal_deg[:, 1:].T
        assert z.min() >= -80 and z.max() <= 110 and x.min() >= -100 and x.max() <= 100
        assert not ((z > -40) & (z < 10) & (x > 20) & (x < 80)).any()
        through = chosen.crosses(made.poses[:-1], made.poses[1:]).any()
        assert through == any("forbidden zone" in remark for remark in made.remarks)
    np.testing.assert_allclose(made.gimbal_deg % 20.0, 0.0, atol=1e-9)
    listed = np.random.default_rng(0).uniform(-180, 180, (9, 3)).round(3)
    made = plan(search(GimbalLimits(BENCH, positions_deg=listed.tolist())), 8, TIMING)
    assert all((np.abs(listed - row).max(axis=1) < 1e-9).any() for row in made.gimbal_deg)


def test_ways_through_a_zone_are_seen_by_walking_them() -> None:
    rng = np.random.default_rng(4)
    limits = GimbalLimits(BENCH, {}, [{1: (20.0, 50.0), 2: (-30.0, 30.0)}])
    ends = rng.uniform(-np.pi, np.pi, (2, 200, 3))
    share = np.linspace(0, 1, 2001)[:, None, None]
    walked = ends[0] + share * (ends[1] - ends[0])
    hit = ~limits.allowed(walked.reshape(-1, 3)).reshape(2001, 200).all(axis=0)
    assert hit.sum() > 10
    np.testing.assert_array_equal(limits.crosses(*ends), hit)


@pytest.mark.parametrize(
    ("limits", "lost"),
    [
        ({1: (-90.0, 90.0), 2: (0.0, 0.0)}, {"phi1", "nu2", "theta3", "K3"}),  # up stays in the plane x y
        ({1: (0.0, 0.0), 2: (-180.0, 180.0)}, {"theta1", "nu1", "phi3", "K1"}),  # up stays in the plane y z
    ],
)
def test_limits_that_leave_the_set_singular_name_what_is_unseen(limits: dict, lost: set[str]) -> None:
    with pytest.raises(UnobservableError) as raised:
        plan(search(GimbalLimits(BENCH, limits)), 12, TIMING)
    assert set(str(raised.value).split("determines ")[1].split(":")[0].split(", ")) == lost
    with pytest.raises(UnobservableError, match="3 dwells leave"):
        plan(search(), 3, TIMING)


@pytest.mark.slow
def test_setting_errors_count_as_the_noise_model_says() -> None:
    """With 0.002 deg a reading across gravity is 3e-4 m/s^2 off, thirty times the noise: six faces are not enough."""
    exact, loose = (plan(search(angle_sigma_deg=each), 6, TIMING) for each in (0.0, 0.002))
    assert loose.sigma[-1, 0] > 10 * exact.sigma[-1, 0]
    turned = math.radians(0.002)
    across = math.sqrt(SIGMA**2 / READINGS + (turned * G) ** 2)
    assert loose.sigma[-1, 0] < across / G * math.sqrt(3 / 6) * 1.2
    twelve = plan(search(angle_sigma_deg=0.002), 12, TIMING)
    assert twelve.d_efficiency > 0.99 > 0.5 > loose.d_efficiency


def test_the_order_keeps_slews_short_and_time_apart_from_gravity() -> None:
    poses = plan(search(), 24, TIMING).poses
    forces = BENCH.specific_force(np.zeros(24), poses)
    loose, tight = (
        poses[order(poses, forces, Timing(30.0, 20.0, limit), GimbalLimits(BENCH), None)] for limit in (1.0, 0.05)
    )
    spent = [slews_s(each[1:], each[:-1], 20.0).sum() for each in (loose, tight)]
    rng = np.random.default_rng(0)
    usual = [slews_s(own[1:], own[:-1], 20.0).sum() for own in (rng.permutation(poses) for _ in range(200))]
    assert spent[0] <= spent[1] < 0.6 * np.mean(usual)
    assert time_correlation(middles_s(tight, TIMING), up(tight)) < 0.055
    # the number is the square root of R^2 of the least-squares fit
    at, design = middles_s(loose, TIMING), np.column_stack([np.ones(24), up(loose)])
    left = at - design @ np.linalg.lstsq(design, at, rcond=None)[0]
    share = 1 - left @ left / np.sum((at - at.mean()) ** 2)
    assert time_correlation(at, up(loose)) == pytest.approx(math.sqrt(share))


def test_repeats_and_antipodes() -> None:
    for limits in ({}, {1: (-100.0, 100.0)}):
        limits = GimbalLimits(BENCH, limits)
        scheme = Scheme.of(limits, 2, True)
        made = plan(search(limits, scheme=scheme), 16, TIMING)
        directions = made.directions
        assert made.d_efficiency > 0.999 and limits.allowed(made.poses).all()
        for own in directions:
            assert (directions @ own < -1 + 1e-6).sum() == 2 and (directions @ own > 1 - 1e-6).sum() == 2
        assert np.abs(np.diff(made.poses, axis=0)).max(axis=1).min() > 0  # it leaves what it comes back to
    with pytest.raises(InputError, match="multiple of 4"):
        plan(search(limits, scheme=scheme), 10, TIMING)


def test_fewest_dwells_by_the_closed_form() -> None:
    wanted = SIGMA * math.sqrt(3 / (8.5 * READINGS)) / G
    aim = optimality_criteria.minimax(
        optimality_criteria.tolerated(targets_of((f"K={1e6 * wanted:.6f}ppm", f"angles={wanted!r}rad")), G)
    )
    made = fewest(search(aim=aim), TIMING)
    assert len(made.poses) == 9 and made.cost <= 1.0
    with pytest.raises(InputError, match="need about"):
        fewest(search(aim=optimality_criteria.minimax(optimality_criteria.tolerated({"K1": 1e-9}, G))), TIMING)


def test_targets_in_the_units_of_the_field() -> None:
    out = optimality_criteria.tolerated(targets_of(("K=2ppm", "b2=20ug", "theta1=0.1 arcsec", "nu=1e-6rad")), G)
    named = dict(zip(paper_parameters.SYMBOLS, out, strict=True))
    assert named["K1"] == named["K3"] == 2e-6 and named["b2"] == pytest.approx(20e-6 * 9.80665 / G)
    assert named["theta1"] == pytest.approx(math.radians(0.1 / 3600)) and named["nu2"] == 1e-6
    assert np.isinf(named["b1"]) and np.isinf(named["theta3"])
    with pytest.raises(InputError, match="AXIS=LOW:HIGH"):
        ranges("z=5:2", axis_names(BENCH.axes))
    with pytest.raises(InputError, match="not known"):
        ranges("w=1:2", axis_names(BENCH.axes))


@pytest.mark.parametrize("name", list(optimality_criteria.NAMED))
def test_slopes_by_finite_differences(name: str) -> None:
    rng, aim = np.random.default_rng(2), optimality_criteria.NAMED[name]
    factor, power = triangle(rng.normal(size=(40, 12))), aim.powers[0]
    change = rng.normal(size=(12, 12))
    change = 1e-6 * (change + change.T)

    def cost(sign: float) -> float:
        return float(aim(np.linalg.cholesky(np.eye(12) + sign * change).T @ factor, power))

    got = float(np.sum(optimality_criteria.slope(aim, factor, power) * change))
    assert got == pytest.approx(0.5 * (cost(1) - cost(-1)), rel=1e-4, abs=1e-12)


@pytest.fixture(scope="module")
def eight():
    poses = np.random.default_rng(5).uniform(-0.6, 0.6, (8, 3))
    return calibrate(Run(seed=4, dwells=8, poses=poses))


@pytest.mark.slow
def test_next_orientation_starts_from_the_filters_covariance(eight) -> None:
    ahead = PredictedInformation.after(eight.fit)
    np.testing.assert_allclose(optimality_criteria.sigmas(ahead.start) * ahead.units, eight.estimate.sigma, rtol=1e-6)
    looking = Search(ahead, GimbalLimits(eight.bench), optimality_criteria.NAMED["A"])
    made = plan(Search(ahead, GimbalLimits(eight.bench), optimality_criteria.NAMED["A"]), 1, TIMING)
    cost = looking.measure(made.poses)
    grid = np.radians(np.random.default_rng(0).uniform(-180, 180, (2000, 3)))
    assert cost <= min(looking.measure(pose[None]) for pose in grid) + 1e-3
    nearby = minimize(lambda pose: looking.measure(pose[None]), made.poses[0], method="Nelder-Mead")
    assert cost <= nearby.fun + 1e-5
    assert (made.sigma[-1] < made.sigma[0] * (1 + 1e-9)).all() and made.cost < math.exp(
        float(optimality_criteria.A(ahead.start))
    )


def test_predicted_sigma_after_the_next_dwell_is_what_the_filter_then_has(eight) -> None:
    """The same recording with one more dwell, there."""
    made = plan(
        Search(PredictedInformation.after(eight.fit), GimbalLimits(eight.bench), optimality_criteria.D), 1, TIMING
    )
    poses = np.vstack([np.random.default_rng(5).uniform(-0.6, 0.6, (8, 3)), made.poses])
    after = calibrate(Run(seed=4, dwells=9, poses=poses))
    np.testing.assert_allclose(made.sigma[-1], after.estimate.sigma, rtol=0.03)


@pytest.mark.parametrize("runs", [3, *slow(30)])
def test_a_plan_is_run_by_the_simulator_and_its_sigmas_hold(run, tmp_path: Path, runs: int) -> None:
    """Errors over predicted sigma of simulated runs of the CSV file: chi-squared of 12 a run, within 3.3 sigma."""
    file, out = tmp_path / "plan.csv", tmp_path / "run.mcap"
    words = ["--count", 6, "--dwell-s", 5, "--sample-hz", 50, "--angle-sigma", 0.001, "--white", 1e-3]
    made = run.json("plan", *words, "--csv", file, "--limit", "z=-100:100")
    assert made["axes"] == "y z x"
    for key in ("gimbal_deg", "sigma", "condition_number", "d_efficiency"):
        assert key in made
    code, _, err = run("simulate", out, "--plan", file, "--dwell-s", 5, "--slew-degps", 1000, "--json")
    assert code == 0, err
    dwells = calibrate_file(out).fit.dwells
    np.testing.assert_allclose(np.degrees([each.pose for each in dwells]), made["gimbal_deg"], atol=0.01)

    from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
    from kf_calib.sources.simulation.simulator import Simulation
    from kf_calib.sources.simulation.visit_plans import explicit_plan

    bench = Bench(axes_of("yzx"), G, angle_sigma_deg=0.001, scatter_sigma_mps2=0.0)
    visits, ratios = explicit_plan(made["gimbal_deg"], 5.0), []
    for seed in range(runs):
        noise = TrueNoise(white_mps2=1e-3, setting_sigma_deg=0.001)
        sensors = GRADES["navigation"].sensors(seed)
        source = Simulation(bench, sensors, noise, visits, sample_hz=50.0, slew_rate_degps=1000.0, seed=seed)
        found = calibrate(source)
        truth = [sensors.parameters[symbol] for symbol in paper_parameters.SYMBOLS]
        ratios.append(
            (found.estimate.parameters - truth) / [made["sigma"][symbol] for symbol in paper_parameters.SYMBOLS]
        )
    total = float(np.sum(np.square(ratios)))
    assert abs(total / (12 * runs) - 1.0) < 0.25 * math.sqrt(30 / runs)


def calibrate_file(path: Path):
    from kf_calib.sources.files.recording import Recording

    return calibrate(Recording(path))


def test_the_command_in_words_and_its_refusals(run, tmp_path: Path) -> None:
    code, out, _ = run("plan", "--count", 4, "--readings", 100, "--beside-paper")
    assert code == 0 and "D-efficiency 1.0000" in out and "0.484 %" in out and "0.685 %" in out
    for words, said in (
        (["--fewest"], "target"),
        (["--limit", "z=5:2"], "AXIS=LOW:HIGH"),
        (["--limit", "x=0:0"], "phi1"),
        (["--axes", "y z"], "K3"),
        (["--positions", tmp_path / "none.csv"], "none.csv"),
        (["--grid-deg", 10, "--positions", tmp_path / "none.csv"], "choose one"),
        (["--with", "second-order"], "--recording"),
        (["--grid-deg", 1], "coarser"),
    ):
        assert said in run.refused("plan", *words)


def test_a_plan_says_where_it_leaves_little_to_go_by(run) -> None:
    few = run.json("plan", "--count", 4)["remarks"]
    assert any("4 directions of gravity × 3 readings = 12 for 12 parameters: nothing is" in said for said in few)
    twice = run.json("plan", "--count", 8, "--repeats", 2)["remarks"]
    assert any(said.startswith("4 directions of gravity") for said in twice)
    limits = [word for axis in "yzx" for word in ("--limit", f"{axis}=0:1")]
    narrow = run.json("plan", "--count", 6, *limits)["remarks"]
    assert any("times worse than by as many dwells in directions that are spread" in said for said in narrow)
    plenty = run.json("plan", "--count", 12)["remarks"]
    assert not any("left over" in said or "times worse" in said for said in plenty)
