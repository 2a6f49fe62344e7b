"""What a run allows to be predicted of an effect: its look-alikes by least squares on means, its size by scipy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.hidden_effects import run
from scipy.stats import chi2, ncx2

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.coefficient_sizes import detectable
from kf_calib.effects import Effect, effect_named, names
from kf_calib.estimation.dwell_columns import candidate_columns
from kf_calib.estimation.observability import Visibility, smallest_size, visibility_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan
from kf_calib.sources.simulation.visit_plans import PlannedVisit
from kf_calib.support.tail_probabilities import LEVEL


@cache
def result() -> Calibration:
    return run()


@cache
def seen() -> dict[str, Visibility]:
    every = [effect_named(name, result().bench) for name in names(result().bench)]
    return {str(each.effect): each for each in visibility_of(result().fit, every)}


def left_of(effect: Effect) -> tuple[Floats, Floats]:
    """The columns (3 D, q) of an effect in the means of dwells, of equal noise, and what the twelve leave of them."""
    linearised = result().linearised
    model = linearised.means.design.reshape(-1, 12)
    model = model / np.linalg.norm(model, axis=0)
    of_dwells = candidate_columns(linearised.dwells, [effect], result().bench, linearised.state)
    means = [np.tensordot(dwell.pieces.counts / dwell.count, each.mean(axis=1), 1)
             for dwell, each in zip(linearised.dwells, of_dwells, strict=True)]  # fmt: skip
    columns = np.concatenate(means)
    return columns, columns - model @ np.linalg.lstsq(model, columns, rcond=None)[0]


def span(effect: Effect) -> Floats:
    """An orthonormal basis of what the twelve leave of it."""
    columns, left = left_of(effect)
    basis, singular, _ = np.linalg.svd(left / np.linalg.norm(columns, axis=0), full_matrices=False)
    return basis[:, singular > 1e-5]


@pytest.mark.parametrize("name", ["second-order", "encoder-scale:x", "encoder-scale:z", "third-order"])
def test_look_alikes_are_the_three_that_overlap_most(name: str) -> None:
    """The cosine of the smallest angle between what the twelve parameters leave of both."""
    sight = seen()[name]
    assert len(sight.rivals) == 3
    for rival, overlap in sight.rivals:
        if (other := effect_named(rival, result().bench)).unknown is None:
            angles = np.linalg.svd(span(sight.effect).T @ span(other), compute_uv=False)
            assert overlap == pytest.approx(angles[0], abs=0.02), rival
    least = sight.rivals[-1][1]
    for rival in ("second-order", "third-order", "odd-quadratic", "bias-asymmetry", "magnetic", "cross-coupling-ip"):
        if rival != name and rival not in dict(sight.rivals):
            angles = np.linalg.svd(span(sight.effect).T @ span(effect_named(rival, result().bench)), compute_uv=False)
            assert angles[0] < least + 0.02, rival


def test_what_overlaps_by_less_than_half_is_no_look_alike() -> None:
    """An oscillation faster than a dwell is like nothing else: 0.35 at most."""
    overlaps = [overlap for sight in seen().values() for _, overlap in sight.rivals]
    assert len(overlaps) > 80 and min(overlaps) > 0.5 and seen()["sinusoid"].rivals == ()


@pytest.mark.parametrize("name", ["second-order", "cross-axis-square", "base-tilt", "encoder-scale:z"])
def test_the_visible_share_is_what_the_twelve_leave(name: str) -> None:
    """Of the columns, each of unit length, the combination that the twelve imitate worst."""
    columns, left = left_of(effect_named(name, result().bench))
    share = np.linalg.svd(left / np.linalg.norm(columns, axis=0), compute_uv=False)[0]
    assert seen()[name].share == pytest.approx(min(share, 1.0), rel=0.01)


@pytest.mark.parametrize("chance", [1e-3, 2e-5])
def test_the_smallest_size_is_detected_in_nine_of_ten_runs(chance: float) -> None:
    """By the noncentral chi-squared of scipy, for the coefficient whose column is smallest."""
    linearised, noise = result().linearised, result().noise.for_goodness_of_fit
    effects = [effect_named(name, result().bench) for name in ("second-order", "encoder-scale:z", "magnetic")]
    for candidate in scan(linearised, noise, effects).candidates:
        smallest = smallest_size(candidate, chance)
        assert smallest is not None
        coefficient, size = smallest
        lengths = np.linalg.norm(candidate.columns, axis=0)
        assert coefficient == candidate.effect.coefficients[int(np.argmin(lengths))]
        bound = chi2.isf(chance, candidate.dof)
        assert ncx2.sf(bound, candidate.dof, (size * lengths.min()) ** 2) == pytest.approx(0.9, abs=1e-6)


def test_the_smallest_size_allows_for_the_number_of_tests() -> None:
    """Half of the level is that of the misfit as a whole; the effects that are visible share the other half."""
    linearised, noise = result().linearised, result().noise.for_goodness_of_fit
    (candidate,) = scan(linearised, noise, [effect_named("second-order", result().bench)]).candidates
    tests = sum(sight.visible is True for sight in seen().values())
    smallest = seen()["second-order"].smallest
    assert smallest is not None and tests > 30
    noncentrality = (smallest[1] * np.linalg.norm(candidate.columns, axis=0).min()) ** 2
    assert ncx2.sf(chi2.isf(0.5 * LEVEL / tests, 3), 3, noncentrality) == pytest.approx(0.9, abs=1e-6)


def test_what_no_sensor_could_have_is_not_seen() -> None:
    """Turned about one gimbal, along whose axis nothing changes: of the flexure along it, and of the cube of the
    accelerometer that lies in it, only what is billions or thousands of times large would be found."""
    result = run(plan=[PlannedVisit((0.0, 45.0 * k, 0.0), 8.0) for k in range(8)])
    test = assess_candidates(result.fit)
    found = {each.name: each for each in detectable(test)}
    assert all(each.minimum <= 1000.0 * each.coefficient.scale for each in found.values())
    for name, place in (("flexure", 2), ("third-order", 2)):
        alone = test.effects.candidate(name)
        (sight,) = visibility_of(result.fit, [alone.effect])
        sizes = 5.0 / np.linalg.norm(alone.columns, axis=0) / alone.scales
        assert sizes[place] > 1000.0 and np.delete(sizes, place).max() < 1.0
        assert sight.unseen == (alone.effect.coefficients[place].symbol,)
        assert found[name].minimum < alone.scales[0] and sight.smallest is not None
        assert sight.smallest[1] < alone.scales[0]
    for name in {*test.effects.best} - {*found}:  # or no coefficient is determined by itself
        assert name in test.invisible or test.effects.candidate(name).hidden.all()
