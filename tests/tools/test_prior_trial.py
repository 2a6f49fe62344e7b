"""The trial that draws from the program's own priors: what it reports is so, and what it draws is in the readings."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from helpers.long_runs import slow
from prior_trials.command import main, played
from prior_trials.play import label_of, play
from prior_trials.report import Report, limits
from scipy.stats import binomtest

from kf_calib.diagnosis.hypothesis_table import IRREGULAR, NOTHING, Hypothesis


@pytest.mark.parametrize(("count", "trials"), [(0, 20), (7, 20), (20, 20)])
def test_limits_of_a_share_are_those_of_scipy(count: int, trials: int) -> None:
    exact = binomtest(count, trials).proportion_ci(0.99, "exact")
    np.testing.assert_allclose(limits(count, trials), (exact.low, exact.high), atol=1e-12)


@pytest.mark.parametrize(("said", "are_within"), [(lambda p: p, True), (lambda p: 0.5 + 0.5 * p, False)])
def test_probabilities_that_hold_are_within_the_limits_and_others_are_not(said, are_within: bool) -> None:
    rng, rows = np.random.default_rng(1), []
    for seed, p in enumerate(rng.uniform(0.0, 1.0, 4000).tolist()):
        truth = "a" if rng.random() < p else "b"
        rows.append({"seed": seed, "truth": truth, "labels": ["a", "b"], "probabilities": [said(p), 1.0 - said(p)],
                     "ranks": [], "refused": "", "stated": True})  # fmt: skip
    assert all(each.within for each in Report(rows).bins()) == are_within


def test_a_row_is_labelled_as_a_truth_is() -> None:
    assert label_of(Hypothesis(("b", "a"))) == "a + b"
    assert label_of(Hypothesis(("b",), driver="time")) == "b + unknown"
    assert (
        label_of(Hypothesis(driver="time")) == "unknown"
        and label_of(Hypothesis(driver="x", dwells=(3,))) == "one dwell"
    )
    assert label_of(Hypothesis(families=(NOTHING,))) == "nothing" and label_of(Hypothesis(driver=IRREGULAR)) == "noise"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [10, *slow(13, 16)])
def test_what_is_drawn_is_in_the_readings(seed: int) -> None:
    """A run of one effect that is named: the same seed gives the same row, and the coefficients have ranks."""
    row = play(seed)
    assert row["truth"] in row["labels"] and sum(row["probabilities"]) == pytest.approx(1.0, abs=0.02)
    again = play(seed)
    assert {**row, "seconds": 0} == {**again, "seconds": 0}
    assert all(0.0 < rank < 1.0 for rank in row["ranks"])


@pytest.mark.parametrize("runs", [*slow(3)])
def test_a_trial_that_was_stopped_goes_on(tmp_path, runs: int) -> None:
    assert CliRunner().invoke(main, [str(tmp_path), "--runs", "1", "--jobs", "1"]).exit_code == 0
    first = pq.read_table(next(tmp_path.glob("*.parquet")))
    done = CliRunner().invoke(main, [str(tmp_path), "--runs", str(runs), "--jobs", "1"])
    assert done.exit_code == 0 and f"{runs} runs" in done.output
    assert sorted(played(tmp_path)["seed"].to_pylist()) == [*range(runs)]
    assert played(tmp_path).slice(0, 1).equals(first)
