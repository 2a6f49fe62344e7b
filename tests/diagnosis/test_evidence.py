"""The evidence of an explanation, against integrals computed in other ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hidden_effects import BENCH, run, source
from helpers.long_runs import slow
from helpers.synthetic import plan_of
from scipy.special import logsumexp
from scipy.stats import chi2, multivariate_normal

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.coefficient_sizes import AddedEffects, size_evidence
from kf_calib.diagnosis.evidence import Evidence, _log_density
from kf_calib.diagnosis.refits import Refits, calibration_of
from kf_calib.effects import Effect, effect_named
from kf_calib.effects.drift import Hysteresis, Sinusoid
from kf_calib.effects.effect import Typical
from kf_calib.effects.frame import EarthRotation
from kf_calib.effects.sensor import SecondOrder
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.noise.reml import OF_ONE
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation


@pytest.mark.parametrize("dof", [1, 3, 6])
def test_noise_gives_an_effect_a_bayes_factor_of_one_on_average(dof: int) -> None:
    """As any two likelihoods do; the average is over chi-squared with nothing missing, on a logarithmic scale."""

    falls = np.exp(np.linspace(-30.0, 36.0, 20_000))
    own = np.exp(chi2.logpdf(falls, dof) + size_evidence(dof, falls)) * falls
    assert np.trapezoid(own, np.log(falls)) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dof", [1, 3])
def test_a_size_is_averaged_over_its_prior(dof: int) -> None:
    """Against the density of k readings with the variance 1 + g, for sizes ln g drawn evenly."""
    readings = np.linspace(2.0, 5.0, dof)
    logs = np.linspace(0.0, np.log(1e14), 4_000)
    own = [multivariate_normal.logpdf(readings, cov=(1.0 + g) * np.eye(dof)) for g in np.exp(logs)]
    none = multivariate_normal.logpdf(readings, cov=np.eye(dof))
    expected = logsumexp(own) - np.log(len(own)) - none
    assert float(size_evidence(dof, float(readings @ readings))) == pytest.approx(expected, abs=0.05)


@pytest.fixture(scope="module")
def before() -> Calibration:
    """A run with an effect of 10 sigma, in which scatter is not stated."""
    found = run("second-order=10sigma", plan=plan_of(18, dwell_s=8.0, seed=3))
    return Refits().of(replace(found, bench=replace(found.bench, scatter_sigma_mps2=None)), ())


def _dense(result: Calibration, scatter_mps2: Floats | float) -> tuple[Floats, Floats]:
    """Whitened columns and readings of the means of dwells, by a dense Cholesky factor of each dwell."""
    noise = replace(result.noise, scatter_mps2=scatter_mps2 * np.ones(3), walk_mps2_per_sqrt_s=0.0)
    means = result.linearised.means
    lower = np.linalg.cholesky(mean_covariances(noise, means, result.linearised.state))
    columns = np.linalg.solve(lower, np.concatenate([means.design, means.readings[:, :, None]], axis=2))
    flat = columns.reshape(-1, columns.shape[2])
    return flat[:, :-1], flat[:, -1]


def _left(columns: Floats, readings: Floats) -> float:
    """Chi-squared that columns leave."""
    scaled = columns / np.linalg.norm(columns, axis=0)
    return float(np.sum((readings - scaled @ np.linalg.lstsq(scaled, readings, rcond=1e-12)[0]) ** 2))


def test_falls_are_those_of_dense_least_squares(before: Calibration) -> None:
    """The effect shows in the means of dwells alone, where dense least squares sees it, too."""
    refit = Refits().with_effects(before, ("second-order",))
    found = [own for own in Evidence(before.fit).of(refit.fit) if "setting" not in own.parts]
    assert {own.parts for own in found} == {(), ("common",)}
    for own in found:
        scatter = dict(zip(own.parts, own.sizes, strict=True)).get("common", 0.0)
        fall = _left(*_dense(before, scatter)) - _left(*_dense(refit, scatter))
        assert own.delta_chi2 == pytest.approx(fall, rel=2e-3) and own.dof == 3


@pytest.mark.parametrize("of_one", [False, True])
def test_scatter_of_unknown_size_is_averaged_out(before: Calibration, of_one: bool) -> None:
    """Against a sum over a grid of sizes, with a flat prior of their logarithm over a factor of 1e4; of all
    accelerometers, or of one of three, which has a tenth of the prior."""
    found = {own.parts: own for own in Evidence(before.fit).of()}
    (part,) = [part for part in OF_ONE if (part,) in found]
    own, still = found[part if of_one else "common",], found[()]
    direction = np.eye(3)[OF_ONE.index(part)] if of_one else np.ones(3)

    def likelihood(scatter: float) -> float:
        columns, readings = _dense(before, scatter * direction)
        noise = replace(before.noise, scatter_mps2=scatter * direction, walk_mps2_per_sqrt_s=0.0)
        spread = mean_covariances(noise, before.linearised.means, before.linearised.state)
        unit = before.linearised.means.design.reshape(-1, columns.shape[1])
        basis = np.linalg.svd(unit / np.linalg.norm(unit, axis=0), full_matrices=False)[2].T
        scaled = columns / np.linalg.norm(unit, axis=0) @ basis
        _, log_det = np.linalg.slogdet(scaled.T @ scaled)
        return float(-0.5 * (np.linalg.slogdet(spread)[1].sum() + log_det + _left(columns, readings)))

    sizes = np.geomspace(own.sizes[0] / 100.0, own.sizes[0] * 100.0, 201)
    grid = logsumexp([likelihood(size) for size in sizes]) - np.log(len(sizes))
    prior = np.log(0.1 / 3.0) if of_one else 0.0
    assert own.log - still.log - prior == pytest.approx(grid - likelihood(0.0), abs=0.08 if of_one else 0.04)


def test_an_effect_that_is_there_beats_one_that_is_not(before: Calibration) -> None:
    refits, evidence = Refits(), Evidence(before.fit)

    def log(name: str) -> float:
        return float(logsumexp([own.log for own in evidence.of(refits.with_effects(before, (name,)).fit)]))

    none = float(logsumexp([own.log for own in evidence.of()]))
    assert log("second-order") > none + 10.0 > log("hysteresis") + 8.0
    walk = refits.with_effects(before, ("bias-walk",))
    assert logsumexp([own.log for own in evidence.of(walk.fit, walk=True)]) < log("second-order") - 10.0


@pytest.mark.slow
def test_coefficients_of_one_field_are_averaged_over_its_directions(before: Calibration) -> None:
    """Against a dense normal density with three columns a direction; no size is known in a MEMS unit, where it is the
    falls of chi-squared that count."""
    refit, effect = Refits().with_effects(before, ("magnetic",)), effect_named("magnetic", before.bench)
    assert [own.shape for own in effect.relations] == [(6, 3)] * 18
    evidence = Evidence(before.fit)
    own, still = (next(each for each in rows if not each.parts) for rows in (evidence.of(refit.fit), evidence.of()))
    (columns, readings), added = _dense(refit, 0.0), before.model.count
    logs = [_averaged(columns[:, :added], columns[:, added:] @ each, readings, effect) for each in effect.relations]
    assert own.log - still.log == pytest.approx(logsumexp(logs) - np.log(len(logs)), abs=0.05) and own.dof == 6
    evidence.grade = "mems"
    own, still = (next(each for each in rows if not each.parts) for rows in (evidence.of(refit.fit), evidence.of()))
    parts = [np.hstack([columns[:, :added], columns[:, added:] @ relation]) for relation in effect.relations]
    falls = np.array([_left(*_dense(before, 0.0)) - _left(each, readings) for each in parts])
    expected = logsumexp(size_evidence(3, falls)) - np.log(len(falls))
    assert own.log - still.log == pytest.approx(expected, abs=0.02) and own.dof == 6
    assert expected > float(size_evidence(6, falls.max()))


def _averaged(columns: Floats, added: Floats, readings: Floats, effect: Effect) -> float:
    """Log Bayes factor of normal coefficients on ``added``, by a sum over standard deviations from 1e-6 to 1e6 times
    the usual, whose density falls by e for each decade beyond these; below one sigma they count as none."""
    beside = np.linalg.qr(columns / np.linalg.norm(columns, axis=0), mode="complete")[0][:, columns.shape[1] :]
    left, seen = beside.T @ readings, beside.T @ added
    low, high = np.log10(np.array(effect.typical.of("navigation")))
    decades = np.linspace(low - 6.0, high + 6.0, 1200)
    density = np.exp(-np.maximum(np.maximum(low - decades, decades - high), 0.0))
    logs = [_log_normal(left, 10.0**each * seen) for each in decades]
    density = density / density.sum() * (10.0**decades > 1.0 / np.linalg.norm(seen, axis=0).max())
    return float(logsumexp(logs, b=density) + 0.5 * left @ left)


def _log_normal(readings: Floats, scaled: Floats) -> float:
    """Log density of readings with the covariance 1 + scaled scaled^T, but for a constant."""
    covariance = np.eye(len(readings)) + scaled @ scaled.T
    return float(-0.5 * (np.linalg.slogdet(covariance)[1] + readings @ np.linalg.solve(covariance, readings)))


def test_the_rate_of_the_earth_is_one_or_it_is_not_the_rotation_of_the_earth() -> None:
    """A drift of the base of the size that bases have, which looks exactly alike: its coefficient would be 6e-5."""
    sigma, root = 6e-6, np.array([[1.0 / 6e-6]])
    log_bayes = {
        name: AddedEffects([effect], "navigation", 1).log_bayes((value / sigma) ** 2, root, np.array([value / sigma]))
        for name, value in (("wrong", 6e-5), ("right", 1.0))
        for effect in [EarthRotation()]
    }
    of_spread = -np.log(0.1 / sigma)
    assert log_bayes["wrong"] == pytest.approx(50.0 - 0.5 * ((1.0 - 6e-5) / 0.1) ** 2 + of_spread, abs=0.01)
    assert log_bayes["right"] == pytest.approx(0.5 * sigma**-2 + of_spread, abs=0.01)


def test_sizes_of_two_effects_are_averaged_each_over_its_own_prior() -> None:
    """Against a sum over a grid of both standard deviations and the dense normal density of the readings."""
    random = np.random.default_rng(5)
    root, effects = np.triu(random.normal(size=(6, 6)) * 1e5), [SecondOrder(), Hysteresis()]
    estimate = np.array([3e-6, -1e-6, 2e-6, 4e-5, -1e-5, 2e-5])
    readings = root @ estimate
    found = AddedEffects(effects, "navigation", 6).log_bayes(float(readings @ readings), root, readings)
    decades, densities = list[Floats](), list[Floats]()
    for effect in effects:
        low, high = np.log10(np.array(effect.typical.of("navigation")))
        decades.append(np.linspace(low - 5.0, high + 5.0, 90))
        densities.append(np.exp(-np.maximum(np.maximum(low - decades[-1], decades[-1] - high), 0.0)))
    for k in range(2):
        smallest = 1.0 / np.linalg.norm(root[:, 3 * k : 3 * k + 3], axis=0).max()
        densities[k] = densities[k] / densities[k].sum() * (10.0 ** decades[k] > smallest)
    logs, weights = list[float](), list[float]()
    for one, a in zip(decades[0], densities[0], strict=True):
        for other, b in zip(decades[1], densities[1], strict=True):
            logs.append(_log_normal(readings, root * 10.0 ** np.repeat([one, other], 3)))
            weights.append(a * b)
    assert found == pytest.approx(float(logsumexp(logs, b=weights)) + 0.5 * readings @ readings, abs=0.1)


@pytest.mark.parametrize("rounding", [0.0, 1e-170])
def test_what_rounding_alone_sees_changes_nothing(rounding: float) -> None:
    """An effect beside another that the readings of a recorded phone do not show at all."""
    alone, effects = np.eye(3) * 1e5, [SecondOrder(), Hysteresis()]
    readings, root = np.array([6.0, -2.0, 4.0]), np.hstack([alone, np.full((3, 3), rounding)])
    one = AddedEffects(effects[:1], "navigation", 3).log_bayes(56.0, alone, readings)
    assert AddedEffects(effects, "navigation", 3).log_bayes(56.0, root, readings) == pytest.approx(one, abs=0.05)


def test_an_oscillation_is_weighed_against_what_needs_no_carrier(monkeypatch: pytest.MonkeyPatch) -> None:
    """The readings that are kept for its sake alone are no loss to it: half the fall of chi-squared, less the price of
    six coefficients and a frequency, of any size."""
    monkeypatch.setattr(Sinusoid, "typical", Typical())
    made = source("sinusoid=15sigma;frequency=0.1", plan=plan_of(16, dwell_s=8.0, seed=5))
    before, refits = calibration_of(made, None)
    refit, evidence = refits.with_effects(before, ("sinusoid",)), Evidence(before.fit)
    assert refit.fit.dwells[0].carrier_hz and not before.fit.dwells[0].carrier_hz
    own, none = (next(each for each in found if not each.parts) for found in (evidence.of(refit.fit), evidence.of()))
    assert own.dof == 6 and 150.0 < own.delta_chi2 < 350.0
    assert own.log - none.log == pytest.approx(float(size_evidence(6, own.delta_chi2)), abs=0.1)


@pytest.mark.parametrize("seeds", [range(1, 4), *slow(range(1, 41))])
def test_one_over_f_noise_is_no_evidence_of_a_temperature_effect(seeds: range) -> None:
    """It goes on within long dwells, where the temperature changes, too, and no setting error hides it."""
    noise = TrueNoise(white_mps2=5e-5, flicker_mps2=1e-5, setting_sigma_deg=2e-3)
    bench = replace(BENCH, angle_sigma_deg=2e-3, scatter_sigma_mps2=noise.dwell_sigma_mps2(12))
    found = list[float]()
    for seed in seeds:
        made = Simulation(
            bench, GRADES["navigation"].sensors(seed), noise, plan_of(12, dwell_s=60.0, seed=seed), sample_hz=40.0,
            angle_hz=4.0, slew_rate_degps=90.0, seed=seed, ambient=Ambient(swing_c=10.0, period_s=1800.0, sigma_c=0.0),
        )  # fmt: skip
        before = calibrate(made)
        evidence, refit = Evidence(before.fit), Refits().with_effects(before, ("thermal-scale",))
        own, none = (logsumexp([each.log for each in rows]) for rows in (evidence.of(refit.fit), evidence.of()))
        found.append(float(own - none))
    assert max(found) < np.log(20.0 * len(found))  # in noise odds exceed 1/p with a probability of p at most


@pytest.mark.parametrize("visits", [2, 3, 4])
def test_differences_of_visits_have_the_density_of_independent_visits(visits: int) -> None:
    rng = np.random.default_rng(visits)
    roots = rng.normal(size=(visits, 3, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2) + np.eye(3)
    from_first = np.hstack([-np.tile(np.eye(3), (visits - 1, 1)), np.eye(3 * (visits - 1))])
    whole = np.zeros((3 * visits, 3 * visits))
    for k, each in enumerate(covariances):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = each
    differences = rng.normal(size=3 * (visits - 1))
    expected = multivariate_normal(cov=from_first @ whole @ from_first.T).logpdf(differences)
    constant = 0.5 * len(differences) * np.log(2.0 * np.pi)
    assert _log_density(differences, covariances) == pytest.approx(expected + constant, rel=1e-9)
