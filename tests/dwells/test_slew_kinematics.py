"""Effects that show in slews only: latency and lever arm, against a truth made without their columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.altered import Altered
from helpers.synthetic import plan_of

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.dwells.blocks import Curve
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation

pytestmark = pytest.mark.usefixtures("unmeasured")

BENCH = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
ARMS_M = [0.01, -0.02, 0.03, 0.015, 0.012, -0.011, 0.02, -0.01, 0.03]
ARMS = "lever-arm=" + ",".join(map(str, ARMS_M))


def run(
    hidden: list[str], seed: int = 5, dwells: int = 10, sample_hz: float = 100.0, bench: Bench = BENCH,
    rate: float = 20.0, angle_hz: float = 10.0, batch: int = 65536, **noise: float,
) -> Simulation:  # fmt: skip
    return Simulation(
        bench, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5, **noise),
        plan_of(dwells, dwell_s=6.0, seed=4),
        sample_hz=sample_hz, angle_hz=angle_hz, slew_rate_degps=rate, seed=seed, batch_samples=batch,
        hidden=parse(hidden, BENCH.axes, seed=seed),
    )  # fmt: skip


def values(result: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the effects and their sigmas."""
    found = list(result.parameters.values())[12:]
    return np.array([p.value for p in found], float), np.array([p.sigma for p in found], float)


@pytest.mark.parametrize("angle_hz", [10.0, 50.0])
def test_latency_is_found(angle_hz: float) -> None:
    value, sigma = values(calibrate(run(["latency=5ms"], angle_hz=angle_hz), Settings(effects=("latency",))))
    assert abs(value[0] - 5e-3) < 2.0 * sigma[0] and sigma[0] < 1e-5


@pytest.mark.slow
def test_lever_arms_are_found() -> None:
    value, sigma = values(calibrate(run([ARMS]), Settings(effects=("lever-arm",))))
    assert np.abs(value - ARMS_M).max() < 1e-4 and (np.abs(value - ARMS_M) < 4.0 * sigma).all()


@pytest.mark.slow
def test_both_at_once_and_with_other_effects() -> None:
    source = run(["latency=2ms", ARMS, "second-order=1e-5,-1e-5,2e-5"], dwells=16)
    value, sigma = values(calibrate(source, Settings(effects=("latency", "lever-arm", "second-order", "bias-drift"))))
    truth = [2e-3, *ARMS_M, 1e-5, -1e-5, 2e-5, 0.0, 0.0, 0.0]
    assert (np.abs(value - truth) < 4.0 * sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("text, truth", [(ARMS, ARMS_M), ("latency=1ms", [1e-3])])
def test_intervals_cover(text: str, truth: list[float]) -> None:
    """Coefficients over their sigmas, half the runs with noise of the encoders (which correlates a slew's readings)."""
    runs, low, high = 300, 0.92, 0.98
    ratios = list[float]()
    for seed in range(100, 100 + runs):
        source = run([text], seed, sample_hz=50.0, encoder_sigma_deg=2e-4 * (seed % 2))
        value, sigma = values(calibrate(source, Settings(effects=(text.partition("=")[0],))))
        ratios += ((value - truth) / sigma).tolist()
    share = float(np.mean(np.abs(ratios) < 1.96))
    print(f"\n{text}: {share:.3f}, mean {np.mean(ratios):+.2f}, std {np.std(ratios):.2f}", end="")
    assert low <= share <= high


@pytest.mark.slow
def test_channels_have_the_noise_in_slews_that_the_model_leaves_in_each() -> None:
    """That of the second is eight times that of the others."""

    def noisier(_: Floats, values: Floats) -> Floats:
        return values + np.random.default_rng(1).normal(size=(len(values), 1)) * [0.0, 4e-4, 0.0]

    source = Altered(run(["latency=1ms"], dwells=8, batch=1 << 30), noisier)
    fitted = calibrate(source, Settings(effects=("latency",))).fit
    sigma = fitted.noise.of(moving=True).effective_sigma_mps2
    assert sigma[[0, 2]] == pytest.approx([5e-5, 5e-5], rel=0.25)
    assert sigma[1] == pytest.approx(np.hypot(5e-5, 4e-4), rel=0.25)


def test_engines_and_batch_agree() -> None:
    compared = compare(run(["latency=1ms"], dwells=5, sample_hz=10.0), Settings(effects=("latency",)))
    assert compared.result.linearised.slews
    assert compared.max_difference_sigma <= 1e-6
    assert all(way.max_relative_variance <= 1e-8 for way in compared.ways.values())


@pytest.mark.slow
def test_slews_do_not_depend_on_batches() -> None:
    settings = Settings(effects=("latency",))
    whole, chopped = (Pass(run([], dwells=5, batch=batch), settings) for batch in (1 << 30, 37))
    for one, other in zip((whole.fold(), whole.folder.slews), (chopped.fold(), chopped.folder.slews), strict=True):
        assert [each.number for each in one] == [each.number for each in other]
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.pieces.triangles, b.pieces.triangles)


def test_of_very_many_slews_some_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second, or fourth ..., from the first on, and what they tell is told."""
    source, settings = run(["latency=1ms"], dwells=9), Settings(effects=("latency",))
    whole = calibrate(source, settings)
    most = sum(len(slew.pieces) for slew in whole.linearised.slews) // 3
    monkeypatch.setattr("kf_calib.dwells.folding.MOST_SLEW_PIECES", most)
    few = calibrate(source, settings)
    assert [slew.number for slew in whole.linearised.slews] == [*range(1, 9)]
    assert [slew.number for slew in few.linearised.slews] == [1, 5]
    one, other = whole.parameters["tau_d"], few.parameters["tau_d"]
    assert one.sigma and other.sigma and one.sigma < other.sigma
    assert abs(other.value - 1e-3) < 4.0 * other.sigma


def test_without_such_an_effect_slews_change_nothing() -> None:
    """Dwells are the same to the last bit, whether slews are folded beside them or not."""
    source = run([], dwells=6)
    without, beside = Pass(source, Settings()), Pass(source, Settings(effects=("latency",)))
    for a, b in zip(without.fold(), beside.fold(), strict=True):
        np.testing.assert_array_equal(a.pieces.triangles, b.pieces.triangles)
    assert not without.folder.slews and len(beside.folder.slews) == 5
    assert without.counts.moving == beside.counts.slewing and not beside.counts.moving


@pytest.mark.parametrize("name", ["latency", "lever-arm"])
def test_without_slews_a_sentence_says_so(name: str) -> None:
    result = calibrate(run([], rate=np.inf), Settings(effects=(name,)))
    assert any(name in said and "needs slew samples" in said for said in result.warnings)
    assert result.parameters["K1"].value is not None
    assert all(result.parameters[c.symbol].value is None for c in Model.of(BENCH, [name]).coefficients)


def test_quaternions_are_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="gimbal angles"):
        calibrate(run([], dwells=4, bench=replace(BENCH, axes=())), Settings(effects=("latency",)))


def test_rates_of_a_curve_are_those_of_the_attitude() -> None:
    """omega x v = -dv/dt of a bench vector seen in the platform, and domega/dt by differences."""
    time_s = np.linspace(0.0, 4.0, 41)
    curve = Curve.through(BENCH, time_s, np.column_stack([np.sin(time_s), 0.3 * time_s**2, np.cos(0.7 * time_s)]))
    at, step, vector = np.linspace(0.5, 3.5, 7), 1e-4, np.array([0.3, -0.8, 0.5])
    seen = [BENCH.to_platform(vector, curve.angles(at + k * step)) for k in (-1, 0, 1)]
    np.testing.assert_allclose(np.cross(seen[1], curve.rate(at)), (seen[2] - seen[0]) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(
        curve.rate_change(at), (curve.rate(at + step) - curve.rate(at - step)) / (2 * step), atol=2e-4
    )


@pytest.mark.slow
def test_slews_have_no_autocovariance_and_no_spectrum() -> None:
    """What moves tells nothing of the noise at rest."""
    whole = Pass(run(["latency=5ms"]), Settings(effects=("latency",)))
    dwells, slews = whole.fold(), whole.folder.slews
    assert len(slews) == 9 and all(dwell.autocovariance.count and dwell.spectrum.sums for dwell in dwells)
    assert all(slew.autocovariance.count == 0 and not slew.spectrum.sums for slew in slews)
    assert all(len(dwell.trace) for dwell in dwells) and not any(len(slew.trace) for slew in slews)


def test_traces_are_of_readings_that_are_not_averaged_and_of_bounded_length(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Pass(run([]), Settings()).fold()
    assert not any(len(dwell.trace) for dwell in Pass(run([]), Settings(window_s=1.0)).fold())
    lengths, last, none = [len(dwell.trace) for dwell in whole], whole[2].trace, [0] * (len(whole) - 3)
    monkeypatch.setattr("kf_calib.dwells.folding.MOST_CELLS", lengths[0] + lengths[1] + 1)
    assert [len(dwell.trace) for dwell in Pass(run([]), Settings()).fold()] == [*lengths[:3], *none]
    monkeypatch.setattr("kf_calib.dwells.coherent_tone._LONGEST_RUN", last.first + 5)
    assert [len(dwell.trace) for dwell in Pass(run([]), Settings()).fold()] == [*lengths[:2], 5, *none]


@pytest.mark.parametrize(("rate_hz", "degps", "count"), [
    (100.0, 0.0, 20), (100.0, 40.0, 4), (10.0, 0.0, 3), (20.0, 0.0, 4), (100.0, 1000.0, 3),
])  # fmt: skip
def test_pieces_of_a_slew_are_two_degrees_and_a_fifth_of_a_second_together_and_three_readings(
    rate_hz: float, degps: float, count: int
) -> None:
    """At a steady rate: 1 / (rate / 2 deg + 5 / s), but at least three readings, in the last piece, too."""
    time_s = np.arange(0.0, 6.0, 1.0 / rate_hz)
    curve = Curve.through(BENCH, time_s, np.radians(degps) * time_s[:, None] * [0.0, 0.0, 1.0])
    cuts = curve.cuts(time_s)
    lengths = np.diff(cuts)
    assert cuts[0] == 0 and cuts[-1] == len(time_s) and lengths.min() >= 3
    assert np.median(lengths) == pytest.approx(max(count, 3), abs=1.0) and lengths[:-1].max() <= count + 2
    if count == 3:
        assert 3 in lengths
    last = [np.diff(curve.cuts(time_s[:size]))[-1] for size in range(7, 60)]
    assert min(last) == 3
