"""Dwells of unequal noise, drawn by numpy alone: weights, coverage of the sigmas, and the rate of alarms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.estimation.calibration import calibrate
from kf_calib.noise.noise_of_readings import _lost_to_correlation, weights_of

G_MPS2, HZ, DWELLS = 9.81, 20.0, 24
SETTING_RAD = np.radians(0.002)


def drawn(seed: int, shape: float, dwells: int = 2000, freedom: float = 30.0) -> tuple[Floats, Floats]:
    """True variances (D,) of an inverse-gamma distribution, and their estimates (D,)."""
    random = np.random.default_rng(seed)
    true = shape / random.chisquare(shape, dwells) if np.isfinite(shape) else np.ones(dwells)
    return true, true * random.chisquare(freedom, dwells) / freedom


@pytest.mark.parametrize("shape", [3.0, 8.0])
def test_weights_are_nearer_to_the_truth_than_those_of_each_dwell_alone_or_of_all(shape: float) -> None:
    true, estimates = drawn(1, shape)
    weights = weights_of(estimates, np.full(len(true), 30.0))

    def loss(guess: Floats) -> float:
        return float(np.var(np.log(guess * true)))

    assert loss(weights) < 0.95 * min(loss(1.0 / estimates), loss(np.ones(len(true))))
    assert np.mean(weights) == pytest.approx(1.0, rel=0.05)


def test_a_dwell_of_few_readings_keeps_to_the_others() -> None:
    true, estimates = drawn(2, 6.0, dwells=200)
    freedom = np.full(200, 30.0)
    freedom[0], estimates[0] = 2.0, 20.0 * np.median(true)
    many = freedom.copy()
    many[0] = 400.0
    few_weights, many_weights = weights_of(estimates, freedom), weights_of(estimates, many)
    assert few_weights[0] > 3.0 * many_weights[0]
    assert many_weights[0] / np.median(many_weights) == pytest.approx(1.0 / 20.0, rel=0.2)


@pytest.mark.parametrize(("few", "counts"), [(1.9, False), (2.1, True), (3.9, True)])
def test_the_noise_of_a_dwell_counts_from_two_degrees_of_freedom(few: float, counts: bool) -> None:
    """With less its weight is that of a dwell of which nothing is known, however it trembles."""
    _, estimates = drawn(3, 4.0, dwells=100)
    freedom = np.append(np.full(99, 30.0), few)
    weights = [weights_of(np.append(estimates[:99], size * np.median(estimates)), freedom) for size in (1.0, 40.0)]
    relative = [own[-1] / own[0] for own in weights]
    assert (relative[1] < 0.7 * relative[0]) == counts and (relative[1] == pytest.approx(relative[0])) != counts


def test_fewer_than_four_dwells_or_noise_below_rounding_tell_no_weights() -> None:
    variances = np.array([1.0, 30.0, 1.0, 30.0, 1.0, 30.0])
    for known in range(7):
        freedom = np.where(np.arange(6) < known, 50.0, 1.0)
        assert (len(set(weights_of(variances, freedom).tolist())) > 1) == (known >= 4)
    rounded_off = np.where(np.arange(6) < 4, 0.0, variances)
    np.testing.assert_array_equal(weights_of(rounded_off, np.full(6, 50.0)), np.ones(6))


@pytest.mark.parametrize("freedom", [5.0, 300.0])
def test_equal_noise_keeps_one_noise(freedom: float) -> None:
    unequal = sum(
        (weights_of(drawn(k, np.inf, 24, freedom)[1], np.full(24, freedom)) != 1.0).any() for k in range(1000)
    )
    assert unequal <= 3  # of 1000 at a level of 1e-4


def test_correlation_enlarges_the_variance_of_a_variance() -> None:
    """Of AR(1) noise: 1 + 2 sum of phi^(2 l) = (1 + phi^2) / (1 - phi^2); of white noise 1, as of a channel that stands
    still."""
    phi, random = np.array([0.0, 0.6, 0.9]), np.random.default_rng(3)
    total = Autocovariance()
    for _ in range(200):
        white = random.normal(size=(3, 1500))
        readings = np.array([lfilter([1.0], [1.0, -own], each) for own, each in zip(phi, white, strict=True)])[:, 500:]
        total += Autocovariance.of(readings * [[1e-4], [1e-3], [1e-2]])
    assert _lost_to_correlation(total) == pytest.approx((1.0 + phi**2) / (1.0 - phi**2), rel=0.05)
    still = Autocovariance.of(np.zeros((3, 1000)))
    assert _lost_to_correlation(still).tolist() == [1.0, 1.0, 1.0] == _lost_to_correlation(Autocovariance()).tolist()


@dataclass
class Drawn:
    """A run of readings with unequal noise; a source of kf_calib. shape: of the inverse-gamma distribution."""

    seed: int
    shape: float
    angles: bool
    warnings: list[str] = field(default_factory=list[str])
    fraction: float = 1.0

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        sensitivity, bias = np.eye(3) + 0.01 * random.normal(size=(3, 3)), 0.05 * random.normal(size=3)
        self.truth = np.column_stack(
            [sensitivity if self.angles else np.linalg.cholesky(sensitivity @ sensitivity.T), bias]
        )
        stops = np.stack([random.uniform(-np.pi, np.pi, DWELLS), np.arccos(random.uniform(-1, 1, DWELLS))], axis=1)
        pose, sigma, turned = list[Floats](), list[Floats](), list[Floats]()
        for k, stop in enumerate(stops):
            before = stops[max(k - 1, 0)]
            pose += [before + np.linspace(0.0, 1.0, 40)[:, None] * (stop - before), np.repeat(stop[None], 400, axis=0)]
            sigma += [np.full(40, 1e-3), np.full(400, 1e-3 * np.sqrt(self.shape / random.chisquare(self.shape)))]
            turned += [np.zeros((40, 3)), np.tile(SETTING_RAD * random.normal(size=3), (400, 1))]
        self.pose = np.vstack(pose)
        first, second = self.pose.T
        force = G_MPS2 * np.stack(
            [np.sin(first), np.cos(first) * np.cos(second), -np.cos(first) * np.sin(second)], axis=1
        )
        force = Rotation.from_rotvec(np.vstack(turned)).apply(force)
        noise = np.concatenate(sigma)[:, None] * random.normal(size=force.shape)
        self.readings = force @ sensitivity.T + bias + noise

    @property
    def bench(self) -> Bench:
        axes = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)) if self.angles else ()
        stated_deg = float(np.degrees(SETTING_RAD)) if self.angles else None
        return Bench(axes, G_MPS2, angle_sigma_deg=stated_deg, scatter_sigma_mps2=0.0, angles=self.angles)

    def __iter__(self) -> Iterator[Batch]:
        time_ns = (np.arange(len(self.readings)) / HZ * 1e9).astype(np.int64)
        yield Batch(Stream(time_ns, self.readings), Stream(time_ns, self.pose) if self.angles else Stream.empty(4))


@pytest.mark.parametrize("angles", [True, False])
@pytest.mark.parametrize("seeds", [range(3000, 3003), *slow(range(3000, 3012), range(4000, 4200))])
def test_sigmas_cover_and_alarms_are_rare_where_dwells_tremble_unequally(seeds: range, angles: bool) -> None:
    """93 to 97 % within 1.96 sigma, and 0.4 to 2 % of alarms, as far as so many runs can tell."""
    inside, alarms = list[float](), 0
    for seed in seeds:
        run = Drawn(seed, 6.0, angles)
        result = calibrate(run)
        assert {weight for dwell in result.fit.dwells for weight in dwell.weights} != {1.0}
        sigma = np.sqrt(np.diag(result.estimate.covariance)).reshape(3, 4)
        known = sigma > 0.0
        errors = (result.estimate.state.reshape(3, 4) - run.truth)[known] / sigma[known]
        inside += [float(np.mean(np.abs(errors) < 1.96))]
        alarms += result.consistency.consistent is False
    spread = float(np.std(inside, ddof=1)) / len(inside) ** 0.5
    assert 0.93 - 2.0 * spread < np.mean(inside) < 0.97 + 2.0 * spread
    assert binom.sf(alarms - 1, len(seeds), 0.02) > 0.01


@pytest.mark.parametrize("seeds", [range(12), *slow(range(100, 300))], ids=len)
def test_noise_in_proportion_to_the_load_of_each_channel_is_covered(seeds: range) -> None:
    """sigma (0.05 + |a_i| / g): the scale factors have what they need, and the biases no more than that."""
    inside = list[list[bool]]()
    for seed in seeds:
        run = Run(seed=seed, dwells=24, count=240, white_mps2=0.0)
        drawn = np.random.default_rng([7, seed]).normal(size=run.accel.values.shape)
        run.accel.values[:] += 1e-4 * drawn * (0.05 + np.abs(run.accel.values) / 9.8)
        result = calibrate(run)
        assert np.ptp([dwell.weights for dwell in result.fit.dwells], axis=0).min() > 1.0, "each channel has its own"
        intervals = [result.interval(each) for each in result.parameters.values()]
        inside.append([low <= truth <= high for (low, high), truth in zip(intervals, run.truth, strict=True)])  # type: ignore[operator]
    held, scales = np.mean(inside), np.mean(np.array(inside)[:, 2::4])
    rough = 3.0 * np.sqrt(0.05 * 0.95 / len(inside) / 3)
    assert abs(held - 0.95) < 0.02 + rough and scales > 0.93 - rough
