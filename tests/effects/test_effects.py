"""Every effect of the catalogue against a truth that was made without its columns."""

import ast
import functools
from functools import partial

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.paths import ROOT
from helpers.synthetic import Run, plan_of
from scipy.optimize import brentq
from scipy.stats import chi2

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Stream
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Bearer, SensorEffect, Stimulus, effect_named, names
from kf_calib.errors import InputError
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.calibration import calibrate, evaluate
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import PRIORS, Settings
from kf_calib.noise.noise_model import Noise as NoiseModel
from kf_calib.noise.terms import RandomWalk
from kf_calib.noise.within_dwells import within_dwells
from kf_calib.online.sequential_test import RecursiveTest
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit, explicit_plan

pytestmark = pytest.mark.usefixtures("unmeasured")

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
PLAN = plan_of(30, dwell_s=6.0, seed=4)
NAMES = [name for name in names(BENCH) if not effect_named(name, BENCH).dynamic]  # tests/diagnosis/test_slew_effects.py
OWN_TEST = {"memory",
    "vibration-rectification", "dead-zone", "bias-walk", "magnetic", "warm-up", "scale-warm-up", "settling",
    "thermal-lag", "sinusoid", "uneven-flexure",
}  # fmt: skip
INVISIBLE = {  # exactly: wrong g is a common scale, the innermost zero a misalignment; a vertical axis turns nothing
    "cross-talk": {"theta1", "phi1", "nu1", "nu2", "theta3", "phi3", "X12", "X13", "X21", "X23", "X31", "X32"},
    "gravity-error": {"K1", "K2", "K3", "epsG"},
    "encoder-offset:x": {"eps_x"},
    "encoder-offset:y": {"eps_y"},
    "encoder-scale:y": {"epsS_y"},
    "encoder-harmonic-1:y": {"s1_y", "c1_y"},
    "encoder-harmonic-2:y": {"s2_y", "c2_y"},
    "backlash:y": {"play_y"},
}
OF_THE_BENCH = (
    "encoder-offset", "encoder-scale", "encoder-harmonic-1", "encoder-harmonic-2", "backlash", "axis-nonorthogonality",
    "base-tilt", "base-tilt-drift", "earth-rotation", "gravity-error", "flexure", "uneven-flexure", "latency",
)  # fmt: skip
OF_EITHER = ("magnetic", "sinusoid", "vibration-rectification", "platform-drift", "lever-arm")
NOT_SIZED = {"vibration-rectification", "dead-zone", "bias-walk"}
"""Needs readings fast enough to resolve vibration; a width; not the same in two runs."""
CHEAP = plan_of(24, dwell_s=8.0, seed=4)
HIDDEN = {
    "warm-up": ("warm-up=5e-3;tau=80", 80.0),
    "scale-warm-up": ("scale-warm-up=5e-4;tau=80", 80.0),
    "settling": ("settling=3e-5;tau=4", 4.0),
    "thermal-lag": ("thermal-lag=5e-4;tau=60", 60.0),
    "bias-walk": ("bias-walk=1e-5", 1e-5),
    "vibration-rectification": ("vibration-rectification=2e-6", None),
}
"""What is hidden, and its constant, where an interval is meant to cover something that is there."""
RESOLVING_HZ = {"vibration-rectification": 50.0}
STEPPED = ("memory", "thermal-hysteresis")
"""Whose constants move their columns by more than a linearisation has: intervals hold 57 to 94 % (docs/limits.md)."""
COVERED = [name for name in NAMES if name not in {*INVISIBLE, "dead-zone", "bias-walk", "sinusoid"}]
"""An oscillation that is not there has no frequency to cover; test_sinusoid.py hides one."""
OF_EACH_KIND = {
    "second-order", "cross-coupling-ip", "warm-up", "hysteresis", "thermal-scale", "base-tilt", "encoder-harmonic-2:z",
}  # fmt: skip
SIZES = {
    "rad": 1e-5, "rad/s": 1e-8, "1": 1e-5, "m/s^2": 1e-4, "s^2/m": 1e-6, "s^4/m^2": 1e-7, "m/s^3": 1e-7, "1/s": 1e-8,
    "m/s^2/K": 1e-5, "m/s^2/K^2": 1e-6, "1/K": 1e-6, "rad/K": 1e-6, "m s^-1/K": 1e-2, "rad s^2/m": 1e-6,
}  # fmt: skip


def run(
    hidden: list[str], white_mps2: float = 0.0, seed: int = 5, plan: list[PlannedVisit] = PLAN, sample_hz: float = 20.0,
    period_s: float = 150.0, angle_hz: float = 10.0, slew_degps: float = 90.0,
) -> Simulation:  # fmt: skip
    made = Simulation(
        BENCH, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=white_mps2), plan,
        sample_hz=sample_hz, angle_hz=angle_hz, slew_rate_degps=slew_degps, seed=seed,
        ambient=Ambient(swing_c=5.0, period_s=period_s, sigma_c=0.0),
    )  # fmt: skip
    return made.hiding(parse(hidden, BENCH.axes, seed=seed, sized=partial(sized, made)))


def values(result: Calibration) -> dict[str, tuple[float | None, float | None]]:
    """Value and sigma of all but the twelve."""
    return {symbol: (p.value, p.sigma) for symbol, p in list(result.parameters.items())[12:]}


def with_effect(name: str, source: Simulation) -> Calibration:
    return calibrate(source, Settings(effects=(name,)))


@pytest.mark.parametrize("name", names(BENCH))
def test_physics_says_what_can_have_an_effect(name: str) -> None:
    """The platform and what turns and tilts it are of the bench, what is in an accelerometer is of sensors."""
    kind = name.partition(":")[0]
    expected = Bearer.BENCH if kind in OF_THE_BENCH else Bearer.EITHER if kind in OF_EITHER else Bearer.SENSORS
    assert effect_named(name, BENCH).borne_by is expected


@pytest.mark.parametrize("name", [name for name in NAMES if name not in {*INVISIBLE, *OWN_TEST}])
def test_coefficients_of_a_nonlinear_truth_are_found(name: str) -> None:
    """Without noise: what the simulator hid comes out, and the model without it fails."""
    effect = effect_named(name, BENCH)
    size = SIZES[effect.coefficients[0].unit]
    truth = [size * (1.0, -0.6, 0.8, 0.5, -0.9, 0.7)[k] for k in range(len(effect.coefficients))]
    dwells = Pass(run([f"{name}={','.join(map(str, truth))}"], plan=PLAN[:18], sample_hz=10.0), Settings()).fold()
    result, without = (evaluate(dwells, BENCH, Settings(effects=effects)) for effects in ((name,), ()))
    got = [result.parameters[c.symbol].value for c in effect.coefficients]
    if name == "axis-nonorthogonality" or name.startswith("axis-"):  # the directions across an axis are free
        assert np.linalg.norm(got) == pytest.approx(np.linalg.norm(truth), rel=0.02)
    else:
        np.testing.assert_allclose(got, truth, rtol=0.02, atol=0.01 * size)
    assert without.consistency.statistic > 100 * max(result.consistency.statistic, 1.0)


@pytest.mark.parametrize("tau_s", [40.0, *slow(80.0)])
def test_what_is_forgotten_over_several_dwells_is_found_with_its_time(tau_s: float) -> None:
    """Against the differential equation, in noise: what the way between two orientations is like is not looked at."""
    truth = (1e-5, -6e-6, 8e-6)
    source = run([f"memory={','.join(map(str, truth))};tau={tau_s}"], white_mps2=1e-5, plan=PLAN[:24])
    found = values(with_effect("memory", source))
    for symbol, expected in (*zip(("c1", "c2", "c3"), truth, strict=True), ("tauMemory", tau_s)):
        value, sigma = found[symbol]
        assert value is not None and sigma is not None and abs(value - expected) < 4.0 * sigma < 0.5 * abs(expected)


def test_an_uneven_flexure_is_found_as_products_of_compliances_and_offsets() -> None:
    """The torque leaves no turn about the axis of its offset, and equal compliances are a flexure, which is not enough
    for these."""
    offset, compliance = {"X": 1e-6, "Y": -6e-7, "Z": 8e-7}, {"X": 2.0, "Y": 0.1, "Z": 0.7}
    hidden = ",".join(map(str, offset.values())) + "".join(f";c{i.lower()}={own}" for i, own in compliance.items())
    dwells = Pass(run([f"uneven-flexure={hidden}"], plan=PLAN[:18], sample_hz=10.0), Settings()).fold()
    result, even = (evaluate(dwells, BENCH, Settings(effects=(name,))) for name in ("uneven-flexure", "flexure"))
    got = {symbol: value for symbol, (value, _) in values(result).items()}
    truth = {f"c{i}d{j}": c * d for j, d in offset.items() for i, c in compliance.items() if i != j}
    assert got == pytest.approx(truth, rel=0.01, abs=1e-8)
    assert even.consistency.statistic > 100 * max(result.consistency.statistic, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden, constant",
    [
        ("settling=30ug/g;tau=20", 20.0),
        ("warm-up=200ug;tau=300", 300.0),
        ("scale-warm-up=100ppm;tau=300", 300.0),
        ("thermal-lag=20ug/K;tau=200", 200.0),
    ],
)
def test_time_constants_are_found_with_their_sigma(hidden: str, constant: float) -> None:
    name = hidden.partition("=")[0]
    plan = plan_of(24, dwell_s=30.0, seed=4)
    for seed in (5, 6):
        source = run([hidden], 5e-5, seed, plan, sample_hz=50.0, period_s=600.0)
        result = with_effect(name, source)
        found, truth = values(result), [*source.hidden[0].sizes, constant]
        assert list(found)[-1] == effect_named(name, BENCH).unknown.symbol
        for (value, sigma), true in zip(found.values(), truth, strict=True):
            assert abs(value - true) < 4.0 * sigma < 0.1 * abs(true)
        assert result.consistency.p_value > 1e-4
        assert calibrate(source).consistency.p_value < 1e-9


@pytest.mark.slow
def test_magnetic_sensitivity_is_found_as_its_product_with_the_field() -> None:
    """A field of 2e-5 T to the North; its vertical part is along gravity, and so hidden in the scale factors."""
    source = run(["magnetic=0.05,-0.03,0.04;north=2e-5;east=0"])
    result, bare = with_effect("magnetic", source), calibrate(source)
    for i, m in enumerate(source.hidden[0].sizes, start=1):
        assert result.parameters[f"mBN{i}"].value == pytest.approx(2e-5 * m, rel=1e-3)
        assert result.parameters[f"mBE{i}"].value == pytest.approx(0.0, abs=1e-3 * 2e-5 * abs(m))
        scale = result.parameters[f"K{i}"].value - source.sensors.parameters[f"K{i}"]
        assert scale == pytest.approx(-4.5e-5 * m / BENCH.gravity_mps2, rel=1e-2)
    assert bare.consistency.statistic > 100 * max(result.consistency.statistic, 1.0)


@pytest.mark.slow
def test_a_walk_of_the_biases_is_found_with_its_sigma() -> None:
    """Its intensity within 4 sigma, and without it the model fails; the effect has no coefficient else."""
    source = run(["bias-walk=1e-5"], 5e-5, plan=plan_of(60, dwell_s=10.0, seed=4))
    result = with_effect("bias-walk", source)
    assert list(values(result)) == ["qb"] and result.model.count == 12
    value, sigma = values(result)["qb"]
    assert abs(value - 1e-5) < 4.0 * sigma < 3e-6
    assert result.consistency.consistent and calibrate(source).consistency.p_value < 1e-9
    still = with_effect("bias-walk", run([], 5e-5, plan=plan_of(60, dwell_s=10.0, seed=4)))
    assert still.parameters["qb"].value is None


def test_vibration_rectification_is_found_at_the_size_white_noise_allows() -> None:
    """Vibration of 3 m/s^2, 60 000 times the noise, leaves nothing in averages over smooth windows: sigma is 2e-7
    to 4e-7, how these are correlated being known from 14 a dwell."""
    for seed in (5, 6):
        source = run(["vibration-rectification=4e-6,-3e-6,2e-6"], 5e-5, seed, CHEAP, sample_hz=50.0)
        result, bare = with_effect("vibration-rectification", source), calibrate(source)
        for (value, sigma), truth in zip(values(result).values(), source.hidden[0].sizes, strict=True):
            assert abs(value - truth) < 4.0 * sigma < 1.6e-6
        assert result.consistency.p_value > 1e-3 and result.noise.effective_sigma_mps2.max() < 2e-5
        assert bare.noise.sigma_mps2.min() > 0.5  # folded as they are, the quiet dwells most


def test_windows_are_as_long_as_the_vibration_that_is_seen_needs() -> None:
    """33.7 Hz read 6 times a second show as 2.3 Hz: windows of a second would let a thousandth of 3 m/s^2 through."""
    hidden, seed = ["vibration-rectification=4e-5,-3e-5,2e-5"], 3
    source = run(hidden, 5e-5, seed, plan_of(24, dwell_s=60.0, seed=4), sample_hz=6.0)
    result = with_effect("vibration-rectification", source)
    assert 8.0 < result.settings.window_s < 9.0
    for (value, sigma), truth in zip(values(result).values(), source.hidden[0].sizes, strict=True):
        assert abs(value - truth) < 4.0 * sigma < 8e-6


@pytest.mark.slow
def test_averages_of_still_readings_say_the_same_with_hardly_less_information() -> None:
    source = run([], 5e-5, plan=plan_of(24, dwell_s=15.0, seed=4))
    whole, means = calibrate(source), calibrate(source, Settings(window_s=1.0))
    ratio = means.estimate.sigma / whole.estimate.sigma
    assert 0.98 < ratio.min() and ratio.max() < 1.1 and means.consistency.consistent
    assert (np.abs(means.estimate.parameters - whole.estimate.parameters) < whole.estimate.sigma).all()
    assert compare(run([], 5e-5, plan=CHEAP), Settings(window_s=1.0)).max_difference_sigma <= 1e-6


def sweep_plan(source: Simulation, step_rad: float = 2e-4) -> list[PlannedVisit]:
    """Orientations spread over the sphere, and 16 about the zero of each accelerometer.

    The three in turn: a pose and the next about the same zero would pass for one, standing still.
    """
    zeros = []
    for i, (gimbal, start) in enumerate([(1, 0.0), (1, np.pi / 2), (2, 0.0)]):

        def along(angle: float, i: int = i, gimbal: int = gimbal) -> float:
            pose = np.zeros((1, 3))
            pose[0, gimbal] = angle
            return float(source.sensors.input_axes[i] @ BENCH.specific_force(np.zeros(1), pose)[0])

        zeros.append((gimbal, brentq(along, start - 0.2, start + 0.2)))
    rows = [visit.gimbal_deg for visit in plan_of(24, seed=4)]
    for k in range(16):
        for i, (gimbal, zero) in enumerate(zeros):
            pose = [20.0 + 40.0 * i, 0.0, 0.0]
            pose[gimbal] = float(np.degrees(zero + step_rad * (k - 7.5)))
            rows.append(tuple(pose))
    return explicit_plan(rows, 6.0)


@pytest.mark.slow
def test_a_dead_zone_is_found_from_poses_that_sweep_through_it() -> None:
    """A share of one of the input is not felt; the width of the zone lies between two poses, and its sigma says so."""
    widths = [4.3e-3, 5.0e-3, 5.7e-3, 6.6e-3]
    inside = []
    for seed, width in enumerate(widths):
        source = run([f"dead-zone={width}"], 5e-5, seed, plan=sweep_plan(run([], seed=seed)))
        result = with_effect("dead-zone", source)
        found = values(result)
        assert list(found) == ["Dz1", "Dz2", "Dz3", "dZone"] and not result.warnings
        for symbol in ("Dz1", "Dz2", "Dz3"):
            value, sigma = found[symbol]
            assert abs(value - 1.0) < 4.0 * sigma < 0.4
        value, sigma = found["dZone"]
        assert 0.0 < sigma < 0.2 * width
        inside.append(abs(value - width) / sigma)
        assert result.consistency.consistent and calibrate(source).consistency.p_value < 1e-9
    assert max(inside) < 2.5 and float(np.median(inside)) < 1.5  # uniform between two poses: 1.7 at most


def test_a_dead_zone_that_is_not_there_has_no_width() -> None:
    found = values(with_effect("dead-zone", run([], 5e-5, plan=sweep_plan(run([])))))
    assert found["dZone"] == (None, None)


@pytest.mark.parametrize("name", INVISIBLE)
def test_exact_degeneracies_are_said_by_name(name: str) -> None:
    result = with_effect(name, run([], white_mps2=5e-5))
    unseen = {symbol for symbol, p in result.parameters.items() if p.value is None}
    assert unseen >= INVISIBLE[name]
    assert any("do not determine" in warning and sorted(INVISIBLE[name])[0] in warning for warning in result.warnings)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in {"dead-zone", "bias-walk"}])
def test_rank_of_the_information_lacks_what_is_degenerate(name: str) -> None:
    """Every coefficient of a visible effect adds one to the rank of twelve, those of a degenerate one none."""
    fitted = fit(still_dwells_once(5), Model.of(BENCH, (name,)))
    nothing = {*INVISIBLE, "vibration-rectification"}  # nothing vibrates in this run
    seen = 0 if name in nothing else len(effect_named(name, BENCH).coefficients)
    unknown = effect_named(name, BENCH).unknown is not None  # its derivative is nothing where the coefficients are
    rank = square_root_information.rank(square_root_information.accumulate(fitted.rows())[:-1])
    assert 12 + seen <= rank <= 12 + seen + unknown


@pytest.mark.parametrize(
    "effects",
    [
        ("second-order", "bias-drift", "axis-nonorthogonality:z"),
        ("encoder-harmonic-2:z", "hysteresis", "thermal-scale"),
    ],
)
def test_engines_and_batch_agree_with_effects(effects: tuple[str, ...]) -> None:
    compared = compare(run([], white_mps2=5e-5, plan=PLAN[:14]), Settings(effects=effects))
    assert compared.max_difference_sigma <= 1e-6
    assert all(way.max_relative_variance <= 1e-8 for way in compared.ways.values())


@pytest.mark.parametrize(
    "number, name",
    [
        pytest.param(k, name, marks=[] if name in OF_EACH_KIND else pytest.mark.slow)
        for k, name in enumerate(NAMES)
        if name not in {*INVISIBLE, *NOT_SIZED}
    ],
)
def test_left_out_effect_biases_the_twelve_and_the_effect_in_the_model_mends_it(number: int, name: str) -> None:
    """NEES of the twelve over two runs, the effect hidden at 25 sigma; in its 99.9 % band with the effect in the model.

    Cross couplings are orthogonal to the twelve in orientations spread over the sphere: they raise the misfit, and bias
    nothing; the first harmonic of the inner encoder biases by less than two runs show; an oscillation averages out.
    """
    constants = {"warm-up": ";tau=80", "scale-warm-up": ";tau=80", "settling": ";tau=4", "thermal-lag": ";tau=60",
                 "magnetic": ";up=0"}  # fmt: skip
    plan = plan_of(24, dwell_s=10.0, seed=4)
    hidden = run([f"{name}=25sigma{constants.get(name, '')}"], 5e-5, number, plan, 10.0, 150.0, 2.0, 180.0).hidden
    nees = {(): 0.0, (name,): 0.0}
    for seed in (1000 + 2 * number, 1001 + 2 * number):
        source = run([], 5e-5, seed, plan, 10.0, 150.0, 2.0, 180.0).hiding(hidden)
        dwells = Pass(source, Settings()).fold()
        for effects in nees:
            estimate = evaluate(dwells, BENCH, Settings(effects=effects)).estimate
            error = estimate.parameters - np.array(list(source.sensors.parameters.values()))
            nees[effects] += float(error @ np.linalg.solve(estimate.parameter_covariance, error))
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 24)
    assert low < nees[(name,)] < high
    if not name.startswith("cross-coupling") and name not in {"encoder-harmonic-1:x", "sinusoid"}:
        assert nees[()] > high


def estimated(fitted: Fit) -> dict[str, tuple[float, float]]:
    """Value and sigma (NaN: not seen) of all but the twelve, without the rest of a calibration."""
    model = fitted.linearised.model
    factor = square_root_information.accumulate(fitted.rows(), fitted.steps)[:-1]
    estimate = Estimate(*square_root_information.solve(factor, model.nominal_state()))
    found, gains = model.natural(estimate.state)
    out = {c.symbol: own for c, *own in zip(model.coefficients, found, estimate.effect_sigma * gains, strict=True)}
    if (walk := model.intensity) is not None:
        size = fitted.noise.walk.rms_mps2_per_sqrt_s
        out[walk.symbol] = [size, size * (fitted.noise.walk.spread or np.nan)]
    return {symbol: (float(value), float(sigma)) for symbol, (value, sigma) in out.items()}


def ratios_of(name: str, seed: int, still: DwellTable) -> dict[str, float]:
    """Errors over their sigmas of what an effect has; ``still``: dwells of a run that hides nothing."""
    if name not in HIDDEN:
        return {symbol: value / sigma for symbol, (value, sigma) in estimated(fit(still, with_(name))).items()}
    text, constant = HIDDEN[name]
    source = run([text], 5e-5, seed, CHEAP, RESOLVING_HZ.get(name, 10.0), 150.0, 2.0, 180.0)
    found = estimated(fit(Pass(source, Settings(effects=(name,))).fold(), with_(name)))
    truth = [*source.hidden[0].sizes, *([] if constant is None else [constant])][-len(found) :]
    return {symbol: (value - true) / sigma for (symbol, (value, sigma)), true in zip(found.items(), truth, strict=True)}


def dead_zone_ratios(seed: int) -> dict[str, float]:
    """Of the shares that are not felt, over their sigmas; the width is another in every run."""
    width = np.random.default_rng(seed).uniform(4e-3, 7e-3)
    source = run([f"dead-zone={width}"], 5e-5, seed, sweep_plan(run([], seed=seed)), 10.0)
    found = estimated(fit(Pass(source, Settings(effects=("dead-zone",))).fold(), with_("dead-zone")))
    return {symbol: (value - 1.0) / sigma for symbol, (value, sigma) in found.items()}


def with_(name: str) -> Model:
    return Model.of(BENCH, (name,))


def still_dwells(seed: int) -> DwellTable:
    return Pass(run([], 5e-5, seed, CHEAP, 10.0, 150.0, 2.0, 180.0), Settings()).fold()


@pytest.mark.slow
def test_intervals_cover_pooled_over_effects() -> None:
    """A few runs of every effect; the ratios of one run share its noise, so the band is wide."""
    runs, off = 6, 0.03
    ratios = []
    for seed in range(100, 100 + runs):
        still = still_dwells(seed)
        of_effects = (ratios_of(name, seed, still) for name in COVERED if name not in STEPPED)
        ratios += [ratio for own in of_effects for ratio in own.values()]
    assert not np.isnan(ratios).any()
    assert np.mean(np.abs(ratios) < 1.96) == pytest.approx(0.95, abs=off)
    assert np.std(ratios) == pytest.approx(1.0, abs=4.0 * off)


still_dwells_once = functools.cache(still_dwells)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*COVERED, "bias-walk", "dead-zone"])
def test_intervals_of_an_effect_cover_over_300_runs(name: str) -> None:
    """95 % intervals cover 92-98 % of the effect's coefficients, and of none less than 90 % or more than 99 %.

    Of an honest coefficient 300 runs show a share outside 92-98 % with a probability of 1.3 %: among a hundred one or
    two are; outside 90-99 % it is 0.1 %. Printed by ``-m slow -s``.
    """
    ratios: dict[str, list[float]] = {}
    for seed in range(1000, 1300):
        own = dead_zone_ratios(seed) if name == "dead-zone" else ratios_of(name, seed, still_dwells_once(seed))
        for symbol, ratio in own.items():
            ratios.setdefault(symbol, []).append(ratio)
    shares = {symbol: float(np.mean(np.abs(own) < 1.96)) for symbol, own in ratios.items()}
    for symbol, r in ratios.items():
        print(f"\n{name:26} {symbol:10} {shares[symbol]:.3f}  mean {np.mean(r):+.2f}  std {np.std(r):.2f}", end="")
    if name in STEPPED and not 0.92 <= np.mean(list(shares.values())) <= 0.98:
        pytest.xfail(f"intervals of {name} hold {np.mean(list(shares.values())):.2f}: docs/limits.md")
    assert 0.92 <= np.mean(list(shares.values())) <= 0.98
    outside = {symbol: share for symbol, share in shares.items() if not 0.90 <= share <= 0.99}
    if name in STEPPED and outside:
        pytest.xfail(f"intervals of {name} hold {outside}: docs/limits.md")
    assert not outside


@pytest.fixture(scope="module")
def navigation() -> tuple[DwellTable, NoiseModel, Floats]:
    """Dwells at navigation grade, their noise, and the state at which rotations are linearised."""
    dwells = Pass(run(["second-order=4e-6"], 5e-5), Settings()).fold()
    return dwells, within_dwells(dwells), fit(dwells, Model.of(BENCH, ("thermal-bias",))).linearised.state[:12]


@pytest.mark.parametrize("name", ["second-order", "bias-drift", "settling", "hysteresis", "encoder-harmonic-2:z"])
def test_a_factor_restricted_equals_that_of_fewer_columns(navigation, name: str) -> None:
    """1e-12 sigma at navigation grade; 4e-9 where readings of size g are not counted from a prediction first."""
    dwells, noise, state = navigation
    small = Model.of(BENCH, ("thermal-bias",))
    large = small + effect_named(name, BENCH)

    def factor_of(model: Model) -> Floats:
        at = np.concatenate([state, np.zeros(model.count - 12)])
        rows = whitened_rows.whiten(dwells, LinearisedDwells(dwells, model, at).columns, noise, at, at)
        return square_root_information.accumulate(rows)[:-1]

    few, chosen = factor_of(small), square_root_information.restrict(factor_of(large), list(range(small.count)))
    (one, covariance, _), (other, reference, _) = (
        square_root_information.solve(f, np.zeros(small.count)) for f in (chosen, few)
    )
    sigma = np.sqrt(np.diag(reference))
    assert sigma[:12].all() and np.abs(one - other).max() > 0  # made in two ways
    np.testing.assert_allclose(one / sigma, other / sigma, rtol=0, atol=1e-12)
    np.testing.assert_allclose(covariance, reference, rtol=1e-9, atol=1e-9 * sigma.min() ** 2)


RICHER = (("thermal-bias", "settling"), ("second-order", "mine = a*a*T"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "prior, walk, models",
    [
        ("navigation", 1e-6, RICHER),
        ("navigation", 1e-6, (("thermal-bias",),)),
        *(
            (prior, walk, (("thermal-bias",), *RICHER))
            for prior, walk in (("diffuse", 0.0), ("diffuse", 1e-6), ("navigation", 0.0))
        ),
    ],
)
def test_a_running_filter_is_a_refit_whatever_it_carries(
    navigation, walk: float, prior: str, models: tuple[tuple[str, ...], ...]
) -> None:
    """At any dwell, with any effects in its model and those of the catalogue carried beside it."""
    dwells, noise, state = navigation
    noise = noise.with_terms(RandomWalk(walk * np.array([1.0, 0.5, 2.0])))
    for names_in in models:
        model = Model.of(BENCH, names_in)
        others = [effect_named(name, BENCH) for name in NAMES if name not in names_in]
        recursive = RecursiveTest.over(dwells[:11], model, noise, state, others, PRIORS[prior])
        for count in range(11, 24):
            if count in (11, 20, 23):
                same(recursive, RecursiveTest.over(dwells[:count], model, noise, state, (), PRIORS[prior]))
            recursive = recursive.after(dwells[count])


def same(recursive: RecursiveTest, expected: RecursiveTest) -> None:
    """The same model, its estimate to 1e-8 sigma (and the last bit of a scale factor of 1), the same covariance."""
    (one, covariance, _), (other, reference, _) = recursive.solved(), expected.solved()
    sigma = np.sqrt(np.diag(reference))
    assert str(recursive.model) == str(expected.model) and (sigma[:12] > 0).all()
    assert (np.abs(one - other) <= 1e-8 * sigma + np.spacing(1.0)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma, rtol=1e-9)


class Twin(SensorEffect):
    """Has the symbols of second-order."""

    name, title, source = "twin", "twin", ""
    symbol, unit, scale, shown = "K2_", "s^2/m", 1e-4, ("s²/m", 1.0)

    def terms(self, s: Stimulus) -> Floats:
        return s.along**2


def test_models_compose() -> None:
    model = Model(BENCH)
    second = effect_named("second-order", BENCH)
    larger = model + second + effect_named("bias-drift", BENCH)
    assert larger.sum == "twelve parameters + second-order + bias-drift" and larger.count == 18
    assert all(symbol in str(larger) for symbol in ("K2_3", "s^2/m", "beta1", "m/s^3"))
    assert (larger - second).sum == "twelve parameters + bias-drift" and model.count == 12
    with pytest.raises(InputError, match="second-order is in the model already: name it once, or take it out first"):
        _ = larger + second
    with pytest.raises(InputError, match=r"twin cannot be added: second-order in the model already has .* K2_1;"):
        _ = larger + Twin()


@pytest.mark.parametrize(
    "text, says", [("second-ordr", "second-order"), ("encoder-offset:q", "y, z, x"), ("wibble", "catalogue")]
)
def test_unknown_names_are_one_sentence(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        effect_named(text, BENCH)


def test_no_other_file_knows_an_effects_name() -> None:
    package = ROOT / "kf_calib"
    known = {name.split(":")[0] for name in NAMES}
    for path in package.rglob("*.py"):
        if {"effects", "injected"} & set(path.relative_to(package).parts):
            continue
        mentions = (known - {"memory"}) & strings(ast.parse(path.read_text()))  # a family, too
        assert not mentions, f"{path} knows {mentions}"
    assert strings(ast.parse('"""settling"""\nx = "settling" if y else f"hysteresis"')) == {"settling", "hysteresis"}


def strings(tree: ast.AST) -> set[str]:
    """The string constants of a program that are not statements of their own, as docstrings are."""
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in alone)
    return {node.value for node in constants if isinstance(node.value, str)}


@pytest.mark.parametrize("seed", [1, *slow(2, 3, 4, 5)])
def test_noise_of_the_angles_is_no_step_of_either_sign(seed: int) -> None:
    """Every second visit turns the platform about the vertical: no accelerometer comes from another side, though the
    angles show a step of a thousandth of a degree."""
    rng = np.random.default_rng(seed)
    poses = np.repeat(rng.uniform(-np.pi, np.pi, (14, 3)), 2, axis=0)
    poses[1::2, 0] += 1.0
    run = Run(seed=seed, dwells=28, count=200, poses=poses, encoder_deg=0.003)
    tilt, turn = poses[:, 1], poses[:, 2]  # specific force G (sin tilt, cos tilt cos turn, -cos tilt sin turn)
    force = np.column_stack([np.sin(tilt), np.cos(tilt) * np.cos(turn), -np.cos(tilt) * np.sin(turn)])
    step = np.vstack([np.zeros(3), np.diff(force, axis=0)])
    sides = np.where(np.abs(step) > 1e-9, np.sign(step), 0.0)
    hidden = np.array([4e-4, -3e-4, 5e-4])
    values = run.accel.values + np.repeat(hidden * sides, 200, axis=0)
    run.accel = Stream(run.accel.time_ns, values)
    result = calibrate(run, Settings(effects=("hysteresis",)))
    sizes = [result.parameters[f"h{k}"] for k in (1, 2, 3)]
    errors = [(each.value - true) / each.sigma for each, true in zip(sizes, hidden, strict=True)]
    assert result.consistency.consistent and np.abs(errors).max() < 3.5, errors
