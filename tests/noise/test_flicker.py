"""1/f noise that goes on within the dwells: coefficients are covered by their sigmas, whatever they show in.

The noise has the spectral density h / f, made here from random phases; the readings are made by scipy's rotations.
The coefficients are truly zero.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.synthetic import NOMINAL, G, Run, sensitivities
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.pieces import of_all_pieces
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import effect_named, names
from kf_calib.estimation.calibration import calibrate, evaluate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.settings import Settings
from kf_calib.noise.flicker import _amplitudes, _likeliest
from kf_calib.noise.terms import SLOW, SlowWaves

BENCH = Bench(axes_of("yzx"), G, latitude_deg=50.0, angle_sigma_deg=0.0)
DWELLS, DWELL_S, GAP_S, RATE_HZ, POSE_HZ = 24, 60.0, 5.0, 5.0, 0.5
UG = 1e-6 * G
UNSEEN = {
    "vibration-rectification", "bias-walk", "dead-zone", "sinusoid", "gravity-error", "cross-talk", "encoder-offset:y",
    "encoder-offset:x", "encoder-scale:y", "encoder-harmonic-1:y", "encoder-harmonic-2:y", "backlash:y", "warm-up",
    "thermal-lag",
}  # fmt: skip
"""Without coefficients that such a run shows; or, where the effect is not there, with a constant of which nothing is
known."""
EFFECTS = [name for name in names(BENCH) if name not in UNSEEN and not effect_named(name, BENCH).dynamic]
FEW = ["thermal-scale", "bias-drift", "settling"]


def one_over_f(rng: np.random.Generator, h: float, count: int) -> np.ndarray:
    """Noise (count,) of the one-sided spectral density h / f, four times longer waves included."""
    whole = 4 * count
    hz = np.fft.rfftfreq(whole, 1.0 / RATE_HZ)
    density = np.append(0.0, h / hz[1:])
    amplitudes = np.sqrt(density * whole * RATE_HZ / 4.0)
    return np.fft.irfft(amplitudes * (rng.normal(size=len(hz)) + 1j * rng.normal(size=len(hz))), whole)[:count]


class Source:
    """A run at random orientations with 1/f noise of ``flicker_ug``, or with scatter from dwell to dwell."""

    warnings: tuple[str, ...] = ()
    fraction = 1.0
    bench = BENCH

    def __init__(self, seed: int, flicker_ug: float, scatter_ug: float) -> None:
        rng = np.random.default_rng([5, seed])
        self.truth = NOMINAL + rng.normal(size=12) * 1e-3
        rows, biases = sensitivities(self.truth)
        time_s = np.arange(int(DWELLS * (DWELL_S + GAP_S) * RATE_HZ)) / RATE_HZ
        noise = np.stack([one_over_f(rng, (flicker_ug * UG) ** 2, len(time_s)) for _ in range(3)], axis=1)
        noise += rng.normal(size=noise.shape) * 1e-5 - noise.mean(axis=0)
        readings = np.full((len(time_s), 3), np.nan)
        poses = rng.uniform(-np.pi, np.pi, (DWELLS, 3))
        dwell = (time_s // (DWELL_S + GAP_S)).astype(int)
        still = time_s - dwell * (DWELL_S + GAP_S) < DWELL_S
        forces = Rotation.from_euler("YZX", poses).inv().apply([0.0, G, 0.0])
        levels = forces @ rows.T + biases + rng.normal(size=(DWELLS, 3)) * scatter_ug * UG
        readings = levels[dwell] + noise
        t_ns = np.round(time_s * 1e9).astype(np.int64)
        seldom = still & (np.arange(len(time_s)) % int(RATE_HZ / POSE_HZ) == 0)
        self._batch = Batch(
            Stream(t_ns[still], readings[still]),
            Stream(t_ns[seldom], poses[dwell[seldom]]),
            Stream(t_ns[::5], (25.0 + 5.0 * np.sin(2 * np.pi * time_s[::5] / (0.4 * time_s[-1])))[:, None]),
        )

    def __iter__(self) -> Iterator[Batch]:
        yield self._batch


def ratios(name: str, runs: int, flicker_ug: float, scatter_ug: float) -> np.ndarray:
    """Estimates over their sigmas of the coefficients of an effect that is not there, in so many runs."""
    told = list[float]()
    for seed in range(runs):
        source = Source(seed, flicker_ug, scatter_ug)
        with one_blas_thread():
            result = evaluate(Pass(source, Settings()).fold(), BENCH, Settings(effects=(name,)))
        coefficients = [result.parameters[c.symbol] for c in effect_named(name, BENCH).coefficients]
        told += [c.value / c.sigma for c in coefficients if c.value is not None and c.sigma]
    return np.array(told)


@pytest.mark.slow
@pytest.mark.parametrize(
    "flicker_ug, scatter_ug, name, runs",
    [
        *((2.0, 0.0, name, 60) for name in EFFECTS),
        *((0.0, 2.0, name, 60) for name in FEW),
    ],
)
def test_coefficients_are_covered(flicker_ug: float, scatter_ug: float, name: str, runs: int) -> None:
    """Within 2.6 standard deviations of a count of independent ones, of 95 % (runs share waves: half as many).

    The scatter from dwell to dwell is taken as white. That of 1/f noise is alike in neighbouring dwells, so that the
    sigmas of what changes from each dwell to the next are larger than they need be, by at most a half.
    """
    told = ratios(name, runs, flicker_ug, scatter_ug)
    count = 0.5 * len(told)
    chance = 2.6 * np.sqrt(0.5 / count)
    assert count >= 0.4 * runs
    assert np.mean(np.abs(told) < 1.96) - 0.95 > -2.6 * np.sqrt(0.05 * 0.95 / count)
    assert (2.0 / 3.0 if flicker_ug else 1.0) - chance < np.sqrt(np.mean(told**2)) < 1.0 + chance


@pytest.mark.parametrize("share, seen", [(0.97, False), (1.03, True)])
def test_waves_count_where_their_likelihood_gains_what_chi2_exceeds_once_in_twenty(share: float, seen: bool) -> None:
    """Amplitudes whose squares are their variances v + h / k gain (h / (v k) - log(1 + h / (v k))) / 2 each."""
    dwells, v = 20, 4e-10

    def gain(ratio: float) -> float:
        return 0.5 * dwells * float(np.sum(ratio / SLOW - np.log1p(ratio / SLOW)))

    limit = 0.5 * float(chi2.ppf(0.95, 1))
    h = v * float(brentq(lambda ratio: gain(ratio) - share * limit, 1e-6, 1e3))
    variances = np.full((dwells, len(SLOW)), v)
    assert _likeliest(np.sqrt(variances + h / SLOW), variances) == pytest.approx(np.sqrt(h) if seen else 0.0, rel=0.06)


def test_slow_waves_have_the_variance_of_their_share_of_one_over_f_noise() -> None:
    """h / k of the component sqrt(2) cos(pi k t / T), of noise that is drawn: its waves are at most four dwells
    long, and those that are longer give k = 1 an eighth. Each accelerometer has an h."""
    rng, count, h = np.random.default_rng(11), 600, 4.0
    at = (np.arange(count) + 0.5) / count
    waves = np.sqrt(2.0) * np.cos(np.pi * SLOW[:, None] * at)
    drawn = np.array([waves @ one_over_f(rng, h, count) / count for _ in range(2000)])
    stack = DwellTable.of(Pass(Run(dwells=4, count=60), Settings()).fold())
    columns = SlowWaves(np.array([np.sqrt(h), 0.0, 3.0])).columns(stack, np.zeros(12))[0]  # (nodes, channels, waves)
    own = np.abs(columns[0]).max(axis=0).reshape(3, len(SLOW)) / np.sqrt(2.0)  # the waves begin at their height
    assert drawn.std(axis=0) == pytest.approx(own[0], rel=0.18)
    np.testing.assert_allclose(own[2] * np.sqrt(SLOW), 3.0)
    assert np.all(own[1] > 0.0) and np.all(own[1] < 1.1e-9)


def test_amplitudes_of_white_noise_have_the_variances_that_are_said() -> None:
    """In dwells of 300 readings of two weights; along directions, in which channels of other noise come together."""
    run = Run(seed=3, dwells=200)
    run.accel.values[:, 1] += 2e-4 * np.random.default_rng(1).normal(size=len(run.accel.values))
    result = calibrate(run, Settings(effects=()))
    weights = np.repeat(np.resize([1.0, 2.0], 200), 3).reshape(-1, 3)
    dwells, columns = (
        result.fit.dwells.weighted(weights),
        of_all_pieces(result.linearised.columns) @ result.estimate.state,
    )
    sigma = np.array([1e-4, np.hypot(1e-4, 2e-4), 1e-4])
    for channels in (np.eye(3), np.array([[0.5, 0.5, np.sqrt(0.5)]])):
        amplitudes, variances = _amplitudes(dwells, columns, sigma, np.tile(channels, (200, 1, 1)))
        for first, weight in ((0, 1.0), (1, 2.0)):  # whose noise is said to be less than it is
            ratios = amplitudes[first::2] ** 2 / variances[first::2]
            assert ratios.mean(axis=(0, 1)) == pytest.approx(np.full(len(channels), weight), rel=0.25)
