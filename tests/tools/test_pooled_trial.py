"""The blind trial of the pooled diagnosis: what it hides is what it counts, and the diagnosis passes it."""

import numpy as np
import pytest
from helpers.run_factors import campaign_of
from pooled_trials.campaigns import KINDS, draw, fitting, linear, signal
from pooled_trials.report import right
from pooled_trials.runs import simulated
from pooled_trials.trial import play

POOL = campaign_of(24)


def test_a_hidden_effect_has_the_size_that_is_stated() -> None:
    rng = np.random.default_rng(1)
    truth = draw("half-large", "hysteresis", POOL, rng)
    sizes = [np.linalg.norm(signal(run, "hysteresis", own)) for run, own in zip(POOL, truth.coefficients, strict=True)]
    assert sorted(np.round(sizes, 9)) == [0.0] * 12 + [6.0] * 12 and len(truth.units) == 12
    made = linear(POOL, truth, rng)
    added = [np.linalg.norm(run.factor[run.width :, -1]) for run in made]
    assert all(len(run.factor) ** 0.5 * 0.2 < size < 12.0 for run, size in zip(made, added, strict=True))


def test_effects_are_hidden_where_they_usually_belong_and_only_if_runs_show_them() -> None:
    assert fitting("bench", POOL) == ["flexure", "base-tilt"]
    assert fitting("sensors", POOL) == ["second-order", "hysteresis"]


@pytest.mark.parametrize("kind", ["noise", "repaired"])
def test_a_trial_is_judged_by_the_truth(kind: str) -> None:
    outcome = play(kind, 3, POOL, 24)
    assert outcome["found"] == [] if kind == "noise" else right(outcome) and outcome["date_within"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_diagnosis_passes_its_blind_trial(kind: str) -> None:
    pool = [simulated(seed) for seed in range(50)]
    outcomes = [play(kind, 90_000 + k, pool, 40) for k in range(10)]
    if kind == "noise":
        assert sum(bool(each["found"]) for each in outcomes) <= 1
    elif kind != "half":  # of which not every one can be found
        assert sum(map(right, outcomes)) >= 8
    assert sum(each["more"] for each in outcomes) <= (10 if kind == "noise" else 1)
