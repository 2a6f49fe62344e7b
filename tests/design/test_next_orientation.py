"""Where to go next: what is predicted of it, against a run that went there."""

import numpy as np
import pytest
from helpers.hidden_effects import noisy_run as run

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.design.next_orientation import (
    ENOUGH,
    STAYS_S,
    Advice,
    SigmaForecast,
    _poses,
    _separations,
    factor_of,
    forecast,
    root_after,
    sigmas_after,
    sigmas_of,
    to_show,
    to_tell_apart,
)
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.effects import Effect, effect_named
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan
from kf_calib.sources.simulation.visit_plans import PlannedVisit, spread_plan

PLAN = spread_plan(12, dwell_s=8.0, seed=5)


def separation(result: Calibration, one: Effect, size: Floats, other: Effect) -> float:
    """What of ``one`` of this size neither the model nor ``other`` explains, in sigma."""
    rival, own = scan(result.linearised, result.noise.for_goodness_of_fit, [other, one]).candidates
    signal = own.columns @ size
    return float(np.linalg.norm(signal - rival.basis @ (rival.basis.T @ signal)))


def advised(one: Effect, other: Effect, sigmas: float = 8.0) -> tuple[Calibration, Floats, Advice]:
    """A run, coefficients of so many sigma in it, and where to go next."""
    result = run(plan=PLAN)
    (alone,) = scan(result.linearised, result.noise.for_goodness_of_fit, [one]).candidates
    even = np.ones(len(one.coefficients))
    size = sigmas * even / np.linalg.norm(alone.columns @ even)
    found = to_tell_apart(result.fit, one, size, [other])
    assert found is not None
    return result, size, found


@pytest.mark.parametrize(
    "names, values, stays",
    [
        (("second-order", "scale-asymmetry"), (None, None), False),
        (("odd-quadratic", "third-order"), (None, None), False),
        (("warm-up", "bias-drift"), (100.0, None), True),
        (("bias-drift", "warm-up"), (None, 150.0), True),
    ],
)
def test_the_separation_predicted_is_that_of_the_run_that_goes_there(
    names: tuple[str, str], values: tuple[float | None, float | None], stays: bool
) -> None:
    """A longer stay is advised for what only time tells apart; of it the last part alone is counted on."""
    bench = run(plan=PLAN).bench
    one, other = (
        effect_named(name, bench) if value is None else effect_named(name, bench).at(value)
        for name, value in zip(names, values, strict=True)
    )
    result, size, found = advised(one, other)
    after = run(plan=[*PLAN, PlannedVisit(found.gimbal_deg, found.stay_s or 8.0)])
    assert found.before == pytest.approx(separation(result, one, size, other), rel=0.02)
    reached = separation(after, one, size, other)
    assert (found.stay_s is not None) == stays
    if stays:
        assert 0.9 * found.after < reached
    else:
        assert found.after == pytest.approx(reached, rel=0.05)
    elsewhere = run(plan=[*PLAN, PlannedVisit((0.0, 0.0, 0.0), 8.0)])
    assert reached >= separation(elsewhere, one, size, other)


@pytest.mark.parametrize("sigmas", [14.0, 20.0])
def test_no_other_stay_gains_much_more_for_its_time(sigmas: float) -> None:
    """A drift from a warm-up: the gain in squared separation, up to the 36 that suffice, over the time that a wait and
    one more visit take, in steps of a sixtieth of the run; to wait not at all or for all of it gains less."""
    bench = run(plan=PLAN).bench
    one, other = effect_named("bias-drift", bench), effect_named("warm-up", bench).at(150.0)
    result, size, found = advised(one, other, sigmas)
    ends_s = np.array([dwell.end_s for dwell in result.fit.dwells])
    dwell_s, waits_s = float(np.median(np.diff(ends_s))), np.linspace(0.0, ends_s[-1], 61)
    poses = np.radians([found.gimbal_deg])
    before, after = _separations(result.fit, one, size, [other], poses, waits_s)
    gains = (np.minimum(after[:, 0], ENOUGH) ** 2 - before**2) / (3.0 * dwell_s + waits_s)
    assert found.stay_s is not None and waits_s[5] < found.stay_s - dwell_s < waits_s[-5]
    own = (min(found.after, ENOUGH) ** 2 - before**2) / (2.0 * dwell_s + found.stay_s)
    assert own > 0.9 * gains.max() and max(gains[0], gains[-1]) < 0.85 * gains.max()


@pytest.mark.parametrize("names", [("cross-coupling-ip", "settling"), ("settling", "bias-drift")])
def test_where_the_platform_is_already_is_no_next_orientation(names: tuple[str, str]) -> None:
    """It is not set anew by staying: another dwell there would tell less than is predicted of it."""
    bench = run(plan=PLAN).bench
    one, other = (effect_named(name, bench) for name in names)
    size = np.full(len(one.coefficients), 1e-4)
    first = to_tell_apart(run(plan=PLAN, setting_sigma_deg=1e-3).fit, one, size, [other])
    assert first is not None
    going_on = run(plan=[*PLAN, PlannedVisit(first.gimbal_deg, 8.0)], setting_sigma_deg=1e-3)
    then = to_tell_apart(going_on.fit, one, size, [other])
    assert then is not None
    turn = np.subtract(then.gimbal_deg, first.gimbal_deg)
    assert np.abs((turn + 180.0) % 360.0 - 180.0).max() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("gimbal", [1, 2])
def test_a_dwell_there_shows_as_many_hidden_effects_as_it_is_said_to(gimbal: int) -> None:
    """After a turn of one gimbal alone."""
    turn = [PlannedVisit(tuple(45.0 * k * np.eye(3)[gimbal]), 8.0) for k in range(8)]
    fitted, rng = run(plan=turn).fit, np.random.default_rng(gimbal)
    test = assess_candidates(fitted)
    hidden = [test.effects.candidate(name).effect for name in test.effects.best if name in test.invisible]
    advice = to_show(fitted, hidden)
    assert advice is not None and advice.shows >= 3

    def shown(gimbal_deg: tuple[float, ...]) -> int:
        further = assess_candidates(run(plan=[*turn, PlannedVisit(gimbal_deg, 8.0)]).fit)
        return sum(str(effect) not in further.invisible for effect in hidden)

    others = [tuple(5.0 * rng.integers(-36, 36, 3)) for _ in range(3)]
    assert shown(advice.gimbal_deg) == advice.shows >= max(map(shown, others))


@pytest.mark.parametrize("unknown", [1.0, 1e3, 1e12])
def test_sigmas_after_a_dwell_are_those_of_the_information_with_its_rows(unknown: float) -> None:
    """Of four combinations of the states so much was not known before the dwell."""
    rng = np.random.default_rng(3)
    root = np.triu(rng.normal(size=(14, 14))) @ np.diag(np.where(np.arange(14) < 4, unknown, 1.0))
    rows, jacobian = rng.normal(size=(5, 3, 14)), rng.normal(size=(12, 12))
    sigmas, roots = sigmas_after(root, rows, jacobian), root_after(root, rows)
    np.testing.assert_allclose(sigmas, sigmas_of(roots, jacobian), rtol=1e-7)
    if unknown < 1e6:  # what an inversion can tell
        known = np.linalg.inv(root @ root.T)
        covariance = np.linalg.inv(known + np.swapaxes(rows, 1, 2) @ rows)
        np.testing.assert_allclose(roots @ np.swapaxes(roots, 1, 2), covariance, rtol=1e-6, atol=1e-6)
        wanted = np.einsum("kp,mpq,kq->mk", jacobian, covariance[:, :12, :12], jacobian)
        np.testing.assert_allclose(sigmas, np.sqrt(wanted), rtol=1e-6)


def test_a_course_goes_where_the_sum_of_squares_is_least() -> None:
    """Of sigmas in units of the targets, against an inversion of the information at each pose."""
    fitted, sizes = run(plan=PLAN[:6]).fit, np.geomspace(1e-7, 1e-5, 12)
    found, poses, factor = forecast(fitted, sizes), _poses(fitted), factor_of(fitted)
    assert found is not None and poses is not None
    rows, jacobian = (
        PredictedInformation.following(fitted).columns([], poses),
        paper_parameters.jacobian(fitted.linearised.state[:12]),
    )
    covariances = np.linalg.inv(factor.T @ factor + np.swapaxes(rows, 1, 2) @ rows)
    sigmas = np.sqrt(np.einsum("kp,mpq,kq->mk", jacobian, covariances, jacobian))
    best = int(np.argmin(np.square(sigmas / sizes).sum(axis=1)))
    assert np.degrees(poses[best]) == pytest.approx(np.array(found.gimbal_deg), abs=0.1)
    np.testing.assert_allclose(found.sigma[1], sigmas[best], rtol=1e-3)


def test_time_that_is_left_is_counted_in_dwells_and_then_by_the_root_of_their_number() -> None:
    sigma = np.array([4.0, 3.0, 2.0])[:, None] * np.ones(12)
    ahead = SigmaForecast((0.0,), sigma, dwells=6, each_s=10.0)
    wanted, now = np.array([5.0, 3.5, 2.0, 1.0] * 3), np.array([4.0, 4.0, np.nan, 4.0] * 3)
    assert ahead.seconds_to(wanted, now).tolist() == [0.0, 10.0, 20.0, 260.0] * 3  # (6 + 2) (2 / 1)^2 - 6 dwells


def test_the_lengths_of_a_stay_that_are_compared_are_no_more_than_half_again_as_long() -> None:
    ratios = np.array(STAYS_S[1:]) / STAYS_S[:-1]
    assert ratios.min() > 1.3 and ratios.max() <= 1.5 and (STAYS_S[0], STAYS_S[-1]) == (2.0, 96.0)
