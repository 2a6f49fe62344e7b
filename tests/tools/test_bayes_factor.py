"""Odds averaged over directions, against plain averages."""

import numpy as np
import pytest
from blind_trials.bayes_factor import log_odds


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
def test_log_odds_are_those_of_a_plain_average(dof: int) -> None:
    """exp(n u w - n^2 / 2) over directions u drawn evenly."""
    rng = np.random.default_rng(dof)
    along = rng.standard_normal(dof) + 1.0
    drawn = rng.standard_normal((400_000, dof))
    parts = np.exp(2.0 * drawn @ along / np.linalg.norm(drawn, axis=1) - 2.0)
    found = np.exp(log_odds(dof, float(along @ along), 2.0))
    assert found == pytest.approx(parts.mean(), abs=4.0 * parts.std() / np.sqrt(len(parts)))
