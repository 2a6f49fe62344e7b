"""Level, drift and the date of the next calibration are as sure as they are said to be."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibrations import simulated
from scipy import stats

import kf_calib
from kf_calib.errors import InputError
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.history import ParameterTrack, _filtered, _pairs, history

REPETITIONS = 200
START = datetime(2024, 1, 1, tzinfo=UTC)
TEMPLATE: list[SavedCalibration] = []


def at(day: float, value: float, sigma: float, serial: str = "") -> SavedCalibration:
    """A calibration of that day which determines K1 alone."""
    if not TEMPLATE:
        TEMPLATE.append(calibration_file.saved(kf_calib.calibrate(simulated(0))))
    own = TEMPLATE[0]
    k1 = next(p for p in own.parameters if p.symbol == "K1").model_copy(update={"value": value, "sigma": sigma})
    began = (START + timedelta(days=day)).isoformat()
    return own.model_copy(
        update={
            "parameters": [k1],
            "conditions": own.conditions.model_copy(update={"began": began}),
            "provenance": own.provenance.model_copy(update={"bench": {"block_serial": serial} if serial else {}}),
        }
    )


def track(
    count: int, drift: float, walk: float, repeatability: float, sigma: float, seed: int
) -> tuple[ParameterTrack, float]:
    """A parameter found every 30 days, and where it is in the end."""
    rng = np.random.default_rng(seed)
    days = 30.0 * np.arange(count)
    steps = rng.normal(0.0, walk * np.sqrt(30.0), count - 1)
    level = 1.0 + np.append(0.0, np.cumsum(steps)) + drift * days
    found = level + rng.normal(0.0, np.hypot(repeatability, sigma), count)
    return history([at(*each, sigma) for each in zip(days, found, strict=True)]).tracks[0], float(level[-1])


@pytest.mark.slow
def test_over_walks_and_repeatabilities_as_likely_as_assumed_sigmas_cover_what_they_say() -> None:
    """Drawn from the prior that the weights have, up to its scale, which is that of the scatter found."""
    rng, scores = np.random.default_rng(8), list[float]()
    for seed in range(REPETITIONS):
        walk, repeatability = np.exp(rng.uniform(np.log(0.1), np.log(3.0), 2)) * [1e-6, 3e-6]
        own, true = track(10, 1e-6, walk, repeatability, 1e-6, seed)
        scores += [(own.level - true) / own.level_sigma, (own.drift - 1e-6) / own.drift_sigma]
    inside = np.sum(np.abs(np.reshape(scores, (-1, 2))) < 1.96, axis=0)
    assert (inside >= stats.binom.ppf(1e-3, REPETITIONS, 0.95)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "walk", "repeatability"), [(8, 2e-6, 5e-6), (20, 2e-6, 5e-6), (12, 0.0, 5e-6), (12, 3e-6, 0.0)]
)
def test_level_and_drift_are_within_their_sigma(count: int, walk: float, repeatability: float) -> None:
    found = [track(count, 1e-6, walk, repeatability, 1e-6, seed) for seed in range(REPETITIONS)]
    level = np.array([(each.level - true) / each.level_sigma for each, true in found])
    drift = np.array([(each.drift - 1e-6) / each.drift_sigma for each, _ in found])
    inside = [float(np.mean(np.abs(scores) < 1.96)) for scores in (level, drift)]
    assert min(inside) > 0.88  # q and r are not known: more where they are small, less where they are large
    assert abs(level.mean()) < 0.25 and abs(drift.mean()) < 0.25
    assert 0.3 < level.std() < 1.4 and 0.3 < drift.std() < 1.4
    if count == 20:
        assert 0.7e-5 > np.median([each.repeatability for each, _ in found]) > 3e-6


@pytest.mark.slow
def test_each_calibration_is_predicted_by_those_before_it() -> None:
    found = [track(10, 1e-6, 1e-6, 4e-6, 1e-6, seed)[0] for seed in range(REPETITIONS)]
    scores = np.array([(each.values - each.predicted) / each.predicted_sigma for each in found])
    assert np.isnan(scores[:, :2]).all() and np.isfinite(scores[:, 2:]).all()
    assert np.mean(np.abs(scores[:, 2:]) < 1.96) > 0.93 and scores[:, 2:].std() > 0.4


def test_the_variance_of_a_prediction_is_that_of_a_mixture_of_all_walks_and_repeatabilities() -> None:
    """E[v + m^2] - E[m]^2 over the pairs, by their probabilities."""
    own, sigmas = track(10, 1e-6, 1e-6, 4e-6, 1e-6, 3)[0], np.full(10, 1e-6)
    values, days = own.values - 1.0, 30.0 * np.arange(10)  # less one: m^2 must not drown the variance in rounding
    of_pairs = _filtered(values, sigmas, days, *_pairs(values, sigmas, days, True), True)
    mean = of_pairs.weights @ of_pairs.predicted
    variance = of_pairs.weights @ (of_pairs.predicted_variances + of_pairs.predicted**2) - mean**2
    assert own.predicted_sigma[2:] == pytest.approx(np.sqrt(variance)[2:], rel=1e-5)
    within = of_pairs.weights @ of_pairs.predicted_variances
    assert (variance[2:] > (1.0 + 1e-4) * within[2:]).any()  # else the mixture would not show


def test_the_sigma_to_come_is_the_closed_form() -> None:
    own = track(8, 1e-6, 2e-6, 5e-6, 1e-6, 1)[0]
    value, sigma = own.known_after(np.array([0.0, 100.0]))
    assert value[1] - value[0] == pytest.approx(100.0 * own.drift)
    np.testing.assert_allclose(
        sigma**2,
        [own.level_sigma**2 + own.repeatability**2,
         own.level_sigma**2 + 200.0 * own.level_drift_covariance + 1e4 * own.drift_sigma**2
         + own.repeatability**2 + 100.0 * own.walk**2],
    )  # fmt: skip


def test_a_line_without_scatter_is_the_least_squares_line() -> None:
    rng = np.random.default_rng(2)
    days, sigma = np.array([0.0, 40.0, 100.0, 130.0, 300.0]), 1e-6
    values = 1.0 + 2e-8 * days + sigma * rng.normal(size=5)
    own = history([at(*each, sigma) for each in zip(days, values, strict=True)]).tracks[0]
    design = np.column_stack([np.ones(5), days - days[-1]])
    line, *_ = np.linalg.lstsq(design, values, rcond=None)
    spread = np.sqrt(np.diag(np.linalg.inv(design.T @ design))) * sigma
    assert abs(own.level - line[0]) < 0.7 * spread[0] and abs(own.drift - line[1]) < 0.7 * spread[1]
    assert own.level_sigma > 0.99 * spread[0] and own.drift_sigma > 0.99 * spread[1]
    weights = np.full(5, 1.0 / sigma**2)
    mean = np.average(values, weights=weights)
    assert own.constant_p == pytest.approx(stats.chi2.sf(np.sum(weights * (values - mean) ** 2), 4), rel=1e-6)


def test_the_next_calibration_is_due_when_two_sigma_reach_the_tolerance() -> None:
    calibrations = [at(30.0 * k, 1.0 + 1e-6 * k, 1e-6) for k in range(8)]
    found = history(calibrations, {"K1": 2e-5})
    assert found.due is not None and found.due_by == "K1"
    own, days = found.tracks[0], (found.due - found.dates[-1]).days
    value, sigma = own.known_after(np.array([days, days + 2.0]))
    reach = np.abs(value - own.values[-1]) + 2.0 * sigma
    assert reach[0] <= 2e-5 < reach[1]
    assert history(calibrations, {"K1": 1.0}).due is None
    assert history(calibrations, {"K1": 1e-9}).due == found.dates[-1]


def test_files_may_come_in_any_order() -> None:
    calibrations = [at(30.0 * k, 1.0 + 1e-6 * k**2, 1e-6) for k in range(5)]
    one, other = history(calibrations), history([calibrations[k] for k in (3, 0, 4, 2, 1)])
    assert one.dates == other.dates and one.tracks[0].level == other.tracks[0].level


def test_two_calibrations_have_no_drift() -> None:
    own = history([at(0.0, 1.0, 1e-6), at(30.0, 1.00001, 1e-6)]).tracks[0]
    assert own.drift is None and own.drift_sigma is None and own.constant_p < 1e-9
    assert own.level_sigma > 3e-6  # repeatability, of which they show something


@pytest.mark.parametrize(("step_day", "says"), [(4 / 1440, "span 12 min"), (0.2, "span 14.4 h")])
def test_runs_of_one_day_show_repeatability_and_no_drift(step_day: float, says: str) -> None:
    values = [1.0, 1.00002, 0.99999, 1.00001]
    found = history([at(step_day * k, value, 1e-6) for k, value in enumerate(values)], {"K1": 1e-3})
    own = found.tracks[0]
    assert own.drift is None and own.drift_sigma is None and own.walk == 0.0
    assert own.repeatability == pytest.approx(np.std(values, ddof=1), rel=0.5)
    assert own.level_sigma == pytest.approx(np.std(values, ddof=1) / 2.0, rel=0.5)
    assert found.due is None and len(found.warnings) == 1 and says in found.warnings[0]
    assert history([at(step_day * k, value, 1e-6) for k, value in enumerate(values)], {"K1": 1e-6}).due_by == "K1"


def test_scatter_within_minutes_is_no_walk_of_a_month() -> None:
    """Three runs at once tell the repeatability; with that, and a run a month before, the drift is that of a line."""
    days, values, sigma = np.array([0.0, 30.0, 30.001, 30.002]), np.array([1.0, 1.00002, 0.99999, 1.00001]), 1e-6
    own = history([at(*each, sigma) for each in zip(days, values, strict=True)]).tracks[0]
    scatter = np.std(values[1:], ddof=1)
    assert own.drift == pytest.approx((values[1:].mean() - 1.0) / 30.0, abs=0.2 * scatter / 30.0)
    assert own.drift_sigma < 3.0 * scatter * np.sqrt(4.0 / 3.0) / 30.0


def test_a_span_of_days_says_how_far_a_year_is() -> None:
    short, long = (history([at(step * k, 1.0 + 1e-6 * k**2, 1e-6) for k in range(4)]) for step in (1.0, 30.0))
    assert short.tracks[0].drift is not None
    assert "span 3.0 days" in short.warnings[0] and "122-fold" in short.warnings[0]
    assert long.warnings == ()


def test_a_file_without_the_date_of_its_run_is_dated_by_its_computation_with_a_sentence() -> None:
    first, second = at(0.0, 1.0, 1e-6), at(400.0, 1.0, 1e-6)
    undated = first.model_copy(
        update={
            "conditions": first.conditions.model_copy(update={"began": None}),
            "provenance": first.provenance.model_copy(
                update={"created": "2024-03-01T00:00:00+00:00", "recording": "old.mcap"}
            ),
        }
    )
    found = history([second, undated])
    assert [f"{date:%Y-%m-%d}" for date in found.dates] == ["2024-03-01", "2025-02-04"]
    assert found.warnings[0].startswith("1 of the 2 calibrations do not say when their runs began")
    assert "old.mcap, 2024-03-01" in found.warnings[0]
    assert "--date" in found.warnings[0]
    assert not any("does not say" in said for said in history([first, second]).warnings)


def test_what_is_no_history_is_refused() -> None:
    first, second = at(0.0, 1.0, 1e-6, "A"), at(30.0, 1.0, 1e-6, "B")
    for given, says in (
        ([first], "needs at least 2 calibrations, 1 is given"),
        ([first, second], r"different blocks \(A, B\)"),
        ([first, first], "two calibrations have the date"),
    ):
        with pytest.raises(InputError, match=says):
            history(given)
    with pytest.raises(InputError, match="b1 has a tolerance"):
        history([first, at(30.0, 1.0, 1e-6, "A")], {"b1": 1e-3})
    undated = first.conditions.model_copy(update={"began": "yesterday"})
    with pytest.raises(InputError, match="'yesterday' is no date"):
        history([first.model_copy(update={"conditions": undated}), second])


def test_a_track_is_replaced_whole() -> None:
    own = track(5, 0.0, 0.0, 1e-6, 1e-6, 0)[0]
    still = replace(own, drift=0.0, drift_sigma=0.0, level_drift_covariance=0.0, walk=0.0)
    sigma = still.known_after(np.array([0.0, 5000.0]))[1]
    assert sigma[0] == sigma[1] == pytest.approx(np.hypot(own.level_sigma, own.repeatability), rel=1e-14)


def test_the_command_tells_the_date_and_draws_a_panel_a_parameter(run: Any, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.json" for k in range(4)]
    for k, path in enumerate(files):
        own = at(30.0 * k, 1.0, 1e-6)
        whole = own.model_copy(update={"parameters": TEMPLATE[0].parameters, "provenance": TEMPLATE[0].provenance})
        calibration_file.write_calibration(path, whole)
    code, out, err = run("history", *files, "--tolerance", "K=1ppm", "--svg", tmp_path / "chart.svg")
    assert code == 0 and err == "" and "4 calibrations, 2024-01-01 to 2024-03-31" in out and "Calibrate again" in out
    found = history([calibration_file.open_calibration(path) for path in files])
    assert len([axes for axes in kf_calib.plot.history(found).axes if axes.get_title(loc="left")]) == 12
    assert (tmp_path / "chart.svg").read_bytes().startswith(b"<?xml")


def test_calibrations_of_other_counts_are_told() -> None:
    """The size of a count is in the scale factors: a history of both would show a step that is none of the block's."""
    one, two = at(0.0, 1.0, 1e-6), at(100.0, 1.0, 1e-6)
    assert not any("raw readings" in sentence for sentence in history([one, two]).warnings)
    bench = {"accel_scale": "4e-6"}
    two = two.model_copy(update={"provenance": two.provenance.model_copy(update={"bench": bench})})
    (told,) = [sentence for sentence in history([one, two]).warnings if "raw readings" in sentence]
    assert "readings in m/s^2, in the order of the accelerometers; raw readings in" in told
