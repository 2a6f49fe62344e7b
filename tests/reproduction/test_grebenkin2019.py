"""The paper's experiment: its matrices against finite differences, its Table 2 against runs and closed form."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.synthetic import NOMINAL, sensitivities
from scipy.spatial.transform import Rotation

from kf_calib.bench import paper_parameters
from kf_calib.bench.bench import Bench
from kf_calib.estimation.settings import PRIORS
from kf_calib.reproduction import grebenkin2019, grebenkin2019_conditions
from kf_calib.reproduction import text as views
from kf_calib.reproduction.grebenkin2019 import NONOPTIMAL_PRINTED, OPTIMAL_PRINTED, Conditions

ANGLES = np.array([0.01, 0.3, 1.1, 0.0, 0.2, 0.3, 0.9, 0.0, 0.02, -1.4, 1.05, 0.0])
"""Away from the nominal, where several misprints happen to vanish."""


def slopes(i: int, at: np.ndarray) -> np.ndarray:
    """H (3, 3) of accelerometer i by differences of axes that scipy turned."""
    rows, h = [], 1e-6
    for k in range(3):
        step = np.zeros(12)
        step[4 * i + k] = h
        rows.append((sensitivities(at + step)[0][i] - sensitivities(at - step)[0][i]) / (2 * h))
    return np.array(rows)


@pytest.mark.parametrize("at", [NOMINAL, ANGLES], ids=["nominal", "elsewhere"])
def test_h_and_d_by_finite_differences(at: np.ndarray) -> None:
    force = np.random.default_rng(1).normal(size=(3, 7, 3))
    design = paper_parameters.design(force, at)
    for i in range(3):
        np.testing.assert_allclose(paper_parameters.h_rows(at)[i], slopes(i, at), atol=1e-9)
        np.testing.assert_allclose(design[i], np.column_stack([force[i] @ slopes(i, at).T, np.ones(7)]), atol=1e-9)
    np.testing.assert_array_equal(
        paper_parameters.design(force[0], at)[2], paper_parameters.design(force[[0, 0, 0]], at)[2]
    )


def print_8(theta: float, psi: float, k: float) -> np.ndarray:
    sin, cos = np.sin, np.cos
    return np.array([
        [-k * cos(psi) * sin(theta), k * cos(theta), -k * sin(psi) * sin(theta)],
        [-k * cos(theta) * sin(psi), 0.0, k * cos(psi) * cos(theta)],
        [cos(psi) * cos(theta), sin(theta), -sin(psi) * cos(theta)],
    ])  # fmt: skip


def print_9(nu1: float, nu2: float, k: float) -> np.ndarray:
    sin, cos = np.sin, np.cos
    root = np.sqrt(1 - sin(nu1) - sin(nu2))
    return np.array([
        [k * cos(nu1), -k * cos(nu1) * sin(nu1) / root, 0.0],
        [0.0, -k * cos(nu2) * sin(nu2) / root, -k * cos(nu2)],
        [sin(nu1), root, -sin(nu2)],
    ])  # fmt: skip


def print_10(theta: float, psi: float, k: float) -> np.ndarray:
    sin, cos = np.sin, np.cos
    root = np.sqrt(1 - sin(psi) ** 2)
    return np.array([
        [-k * cos(psi) * sin(theta), k * cos(theta), -k * root * sin(theta)],
        [-k * sin(psi) * cos(theta), 0.0, k * cos(theta) * cos(psi) * sin(psi) / root],
        [cos(psi) * cos(theta), sin(theta), np.sqrt(1 - cos(psi) ** 2) * cos(theta)],
    ])  # fmt: skip


MISPRINTS = {
    "(8) sign of both derivatives of E_z": (0, print_8, [(0, 2), (1, 2)]),
    "(9) squares under the root": (1, print_9, [(0, 1), (1, 1), (2, 1)]),
    "(10) sqrt(1 - sin^2) for sqrt(1 - cos^2)": (2, print_10, [(0, 2), (1, 2)]),
}


@pytest.mark.parametrize("name", MISPRINTS)
def test_the_print_is_wrong_where_the_docstring_says_and_right_elsewhere(name: str) -> None:
    i, printed, wrong = MISPRINTS[name]
    found, true = printed(*ANGLES[4 * i : 4 * i + 3]), slopes(i, ANGLES)
    differs = np.abs(found - true) > 1e-3
    assert sorted(map(tuple, np.argwhere(differs).tolist())) == wrong
    np.testing.assert_allclose(found[~differs], true[~differs], atol=1e-8)


def test_10_at_the_nominal_has_nothing_where_sin_theta3_stands() -> None:
    """And the printed K3 says that the computation had it: without, K3 would be off by 2.5 % more."""
    theta, psi = NOMINAL[8:10]
    with np.errstate(divide="ignore"):  # the other derivative is 0/0 there
        printed = print_10(theta, psi, 1.0)
    assert abs(printed[0, 2]) < 1e-12 and slopes(2, NOMINAL)[0, 2] == pytest.approx(-np.sin(theta))
    assert not abs(printed[1, 2]) < 1 and abs(slopes(2, NOMINAL)[1, 2]) < 1e-9
    column = grebenkin2019.optimal()
    clean = (
        np.einsum("nj,j->n", column.force_mps2[2], np.sin(theta) * np.array([0, 0, -1.0])) * grebenkin2019.DEVIATIONS[8]
    )
    bias = np.linalg.lstsq(column.design[2], clean, rcond=None)[0] / grebenkin2019.DEVIATIONS[8:]
    assert abs(100 * bias[2]) > 2 * OPTIMAL_PRINTED["K3"]


def test_5_repeats_the_expected_reading() -> None:
    """The reading less g_j is D dp, to second order in the deviations; with g_j on the right it is off by g_j."""
    found, state = grebenkin2019.optimal(), paper_parameters.state_of(NOMINAL).reshape(3, 4)
    expected = np.einsum("inj,ij->in", found.force_mps2, state[:, :3]) + state[:, 3:]
    rows, biases = sensitivities(NOMINAL + grebenkin2019.DEVIATIONS)
    left = np.einsum("inj,ij->in", found.force_mps2, rows) + biases[:, None] - expected
    linear = (found.design @ grebenkin2019.DEVIATIONS.reshape(3, 4, 1))[..., 0]
    np.testing.assert_allclose(left, linear, atol=1e-6)
    assert np.abs(left - (expected + linear)).max() > 9.8


def test_optimal_set_excites_one_parameter_at_a_time() -> None:
    found = grebenkin2019.optimal()
    blocks = found.design[:, :: grebenkin2019.READINGS_PER_DWELL, :3] / grebenkin2019.GRAVITY_MPS2
    off = blocks[:, :3] - np.einsum("iaa,ab->iab", blocks[:, :3], np.eye(3))
    assert np.abs(off).max() < 1e-12
    np.testing.assert_allclose(blocks[:, 3], -blocks[:, 2], atol=1e-12)
    np.testing.assert_allclose(found.condition_numbers_in_g, 3.2255, atol=1e-3)
    np.testing.assert_allclose(found.condition_numbers, 9.9135, atol=1e-3)


def test_optimal_expectation_is_the_closed_form_and_the_print() -> None:
    n, sigma, g = grebenkin2019.READINGS_PER_DWELL, 1e-4, 9.81
    angle = np.sqrt(1 / n + 1 / (2 * n)) * sigma / g
    expected = np.sqrt(2 / np.pi) * np.array([angle, angle, sigma / g / np.sqrt(2 * n), sigma / np.sqrt(2 * n)] * 3)
    found = grebenkin2019.optimal().expected
    np.testing.assert_allclose(found, 100 * expected / grebenkin2019.DEVIATIONS, rtol=2e-4)
    assert np.abs(grebenkin2019.printed_column(OPTIMAL_PRINTED) / found - 1).max() < 3 * grebenkin2019.scatter(200)


def test_scatter_is_that_of_means_of_normal_sizes() -> None:
    sizes = np.abs(np.random.default_rng(5).normal(size=(4000, 200)))
    means = sizes.mean(axis=1)
    assert means.std() / means.mean() == pytest.approx(grebenkin2019.scatter(200), rel=0.05)


@pytest.fixture(scope="module")
def found() -> grebenkin2019.Experiment:
    return grebenkin2019.repeat()


@pytest.fixture(scope="module")
def searched() -> grebenkin2019_conditions.ConditionSearch:
    return grebenkin2019_conditions.search()


def test_optimal_column_is_the_print_within_its_scatter(found: grebenkin2019.Experiment) -> None:
    printed = grebenkin2019.printed_column(OPTIMAL_PRINTED)
    for figures in (found.optimal.least_squares, found.optimal.kalman):
        assert np.abs(figures / printed - 1).max() < 0.15


@pytest.mark.parametrize("seed", [3, 4])
def test_runs_of_any_seed_scatter_about_the_expectation(seed: int) -> None:
    again = grebenkin2019.repeat(repetitions=2000, seed=seed)
    for column in (again.optimal, again.nonoptimal):
        assert np.abs(column.least_squares / column.orientations.expected - 1).max() < 4.5 * grebenkin2019.scatter(2000)


def test_filter_is_least_squares_but_for_the_linearisation(found: grebenkin2019.Experiment) -> None:
    for column in (found.optimal, found.nonoptimal):
        assert 0 < column.difference_sigma < 0.05
        np.testing.assert_allclose(column.kalman, column.least_squares, rtol=0.01)


def test_nonoptimal_set_is_singular_with_gravity_fixed(found: grebenkin2019.Experiment) -> None:
    assert found.fixed.rank.tolist() == [3, 3, 3] and found.fixed.same_vector == [(1, 2)]
    assert np.isinf(found.fixed.sigma).all() and np.isinf(found.fixed.condition_numbers).all()
    assert "orientations 1 and 2 share the vertical" in views.rank_sentence(found)
    distinct = np.unique(np.round(found.fixed.directions[0], 9), axis=0)
    assert len(distinct) == 3
    singular = np.linalg.svd(found.fixed.design, compute_uv=False)
    assert (singular[:, 3] < 1e-12 * singular[:, 0]).all()


def test_nonoptimal_set_is_finite_with_the_earths_rotation(found: grebenkin2019.Experiment) -> None:
    printed = grebenkin2019.printed_column(NONOPTIMAL_PRINTED)
    assert found.nonoptimal.orientations.rank.tolist() == [4, 4, 4]
    assert grebenkin2019.log_ratio(found.nonoptimal.orientations.expected, printed) < 0.25
    assert grebenkin2019.log_ratio(found.nonoptimal.least_squares, printed) < 0.25


@pytest.mark.parametrize("turns, sampled", [("platform", "together"), ("bench-after-2", "312")])
def test_vectors_are_those_of_scipys_rotations(turns, sampled: str) -> None:
    """Gravity turned about the Earth's axis and seen from the platform, without the bench's code."""
    own = Conditions(20.0, 40.0, 30.0, turns, sampled)
    y, z = (
        (lambda deg: Rotation.from_euler("y", deg, degrees=True)),
        (lambda deg: Rotation.from_euler("z", deg, degrees=True)),
    )
    third = y(33) * z(70) if turns == "platform" else z(70) * y(33) * y(40)
    attitudes = [y(0), y(40), third, third * y(70) if turns == "platform" else y(70) * third]
    latitude = np.radians(40.0)
    rate = 7.292115e-5 * y(30).apply([np.cos(latitude), np.sin(latitude), 0.0])  # North, Up, East seen from the bench
    assert rate == pytest.approx(own.bench.earth_rate_radps, abs=1e-12)
    force = grebenkin2019.nonoptimal(own).force_mps2
    for i, k in ((0, 0), (1, 150), (2, 399)):
        place, within = divmod(k, 100)
        count = k if sampled == "together" else (3 * place + sampled.index(str(i + 1))) * 100 + within
        up = Rotation.from_rotvec(rate * count * 20.0).apply([0.0, 9.81, 0.0])
        np.testing.assert_allclose(force[i, k], attitudes[place].inv().apply(up), atol=1e-9)


@pytest.mark.slow
def test_search_is_the_closed_form_at_what_it_found(searched: grebenkin2019_conditions.ConditionSearch) -> None:
    printed = grebenkin2019.printed_column(NONOPTIMAL_PRINTED)
    for each in (searched.together, searched.in_turn):
        assert each.log_ratio == pytest.approx(
            grebenkin2019.log_ratio(grebenkin2019.nonoptimal(each.conditions).expected, printed)
        )
    assert searched.tried == 24 * 48 * 4 * 7
    assert searched.floor < searched.together.log_ratio < 0.25
    near = replace(searched.together.conditions, period_s=Conditions.period_s)
    assert near == Conditions(), "the defaults are what the search finds, the period rounded"


def test_nothing_read_together_comes_below_the_floor(searched: grebenkin2019_conditions.ConditionSearch) -> None:
    rng, printed = np.random.default_rng(7), grebenkin2019.printed_column(NONOPTIMAL_PRINTED)
    for _ in range(100):
        vectors = Rotation.random(400, random_state=rng).apply([0.0, 9.81, 0.0]) * [1.0, rng.uniform(0.02, 1), 1.0]
        vectors *= 9.81 / np.linalg.norm(vectors, axis=1, keepdims=True)
        expected = grebenkin2019.OrientationSet(np.stack([vectors] * 3)).expected
        best = grebenkin2019.log_ratio(expected, printed * np.exp(np.log(expected / printed).mean()))
        assert best > 0.98 * searched.floor  # even if all its figures were scaled at will


def test_bias_excess_is_at_most_one_for_any_vectors() -> None:
    rng = np.random.default_rng(8)
    for spread in np.geomspace(0.05, 1, 30):
        vectors = rng.normal(size=(3, 400, 3)) * spread + rng.normal(size=3)
        vectors *= 9.81 / np.linalg.norm(vectors, axis=2, keepdims=True)
        assert (grebenkin2019_conditions.bias_excess(grebenkin2019.OrientationSet(vectors).expected) <= 1).all()
    assert grebenkin2019_conditions.bias_excess(grebenkin2019.printed_column(NONOPTIMAL_PRINTED))[2] > 1.1


def test_covariance_shrinks_from_the_prior_to_the_sets_sigma() -> None:
    prior = PRIORS["navigation"].covariance(paper_parameters.nominal())
    found = grebenkin2019.optimal()
    covariances = grebenkin2019.shrinking(found, prior)
    np.testing.assert_allclose(covariances[0], prior)
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    assert covariances.shape == (401, 12, 12) and (np.diff(variance, axis=0) <= 1e-12 * variance[:-1]).all()
    jacobian = paper_parameters.jacobian(paper_parameters.state_of(paper_parameters.nominal()))
    last = np.sqrt(np.diag(jacobian @ covariances[-1] @ jacobian.T))
    np.testing.assert_allclose(last, found.sigma, rtol=1e-3)


def test_gravity_fixed_is_what_a_base_bench_gives() -> None:
    assert grebenkin2019.FIXED == Bench((), 9.81)
    np.testing.assert_allclose(np.linalg.norm(grebenkin2019.optimal().directions, axis=2), 1.0)
    np.testing.assert_allclose(
        grebenkin2019.optimal().directions, paper_parameters.optimal_directions(NOMINAL), atol=1e-12
    )


@pytest.mark.slow
def test_command_prints_the_agreed_keys_and_saves_the_figures(run: Any, tmp_path: Path) -> None:
    result = run.json("paper", "--repetitions", 50, "--seed", 4, "--pdf", tmp_path / "paper.pdf")
    assert len(result["table2"]) == 12
    for row in result["table2"]:
        assert row["optimal_printed"] == OPTIMAL_PRINTED[row["parameter"]]
        assert row["nonoptimal_printed"] == NONOPTIMAL_PRINTED[row["parameter"]]
        assert row["optimal"] == pytest.approx(row["optimal_expected"], rel=0.5)
        assert row["nonoptimal"] == pytest.approx(row["nonoptimal_kalman"], rel=0.02)
    assert result["conditions"]["inferred"] is True and result["nonoptimal_gravity_fixed"]["rank"] == [3, 3, 3]
    assert result["optimal"]["condition_numbers"] == pytest.approx([9.9135] * 3, abs=1e-3)
    assert (tmp_path / "paper.pdf").stat().st_size > 50_000


@pytest.mark.parametrize(
    "words, says",
    [(["--repetitions", 0], "repetitions"), (["--period-s", 0], "period"), (["--latitude", 90], "latitude"),
     (["--png", "/no/such/folder/x.png", "--repetitions", 1], "no folder")],
)  # fmt: skip
def test_bad_usage_is_one_sentence(run: Any, words: list[object], says: str) -> None:
    assert says in run.refused("paper", *words)
