"""A small nonlinear bench for the tests, by scipy's rotations: it shares no formula with the package."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.simulation.visit_plans import spread_plan

G = 9.81
plan_of = cache(spread_plan)
"""A plan takes a tenth of a second, and many tests have the same."""

SYMBOLS = ["theta1", "phi1", "K1", "b1", "nu1", "nu2", "K2", "b2", "theta3", "phi3", "K3", "b3"]
NOMINAL = np.array([np.radians(0.5), 0, 1, 0, 0, 0, 1, 0, np.radians(0.5), -np.pi / 2, 1, 0])


def sensitivities(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows K E (3, 3) and biases (3,) from the paper's parameters, by turning unit vectors."""
    rows, biases = [], []
    for i, (p1, p2, scale, bias) in enumerate(truth.reshape(3, 4)):
        if i == 1:
            x, z = np.sin(p1), -np.sin(p2)
            axis = np.array([x, np.sqrt(1 - x * x - z * z), z])
        else:  # elevation theta toward y, then azimuth phi about y
            axis = (Rotation.from_rotvec([0, p2, 0]) * Rotation.from_rotvec([0, 0, p1])).apply([1.0, 0.0, 0.0])
        rows.append(scale * axis)
        biases.append(bias)
    return np.array(rows), np.array(biases)


@dataclass
class Run:
    """A source: ``dwells`` orientations of ``count`` readings at ``rate_hz``, truth drawn from ``seed``."""

    seed: int = 0
    dwells: int = 24
    count: int = 300
    rate_hz: float = 20.0
    white_mps2: float = 1e-4
    phi: float = 0.0
    shared_mps2: float = 0.0  # noise that all accelerometers have in common
    shaken_mps2: float = 0.0  # a base that shakes up and down
    scatter_mps2: float = 0.0
    setting_deg: float = 0.0
    encoder_deg: float = 0.0
    stated: bool = True
    spread: tuple[float, float, float] = (1e-3, 1e-3, 1e-3)  # of angles (rad), K, b
    gap_s: float = 3.0
    poses: np.ndarray | None = None
    batch: int = 1 << 30
    warnings: list[str] = field(default_factory=list)
    fraction: float = 1.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        stated = self.setting_deg if self.stated else None
        self.bench = Bench(axes=axes_of("yzx"), gravity_mps2=G, angle_sigma_deg=stated)
        angle, scale, bias = self.spread
        self.truth = NOMINAL + rng.normal(size=12) * np.array([angle, angle, scale, bias] * 3)
        poses = rng.uniform(-np.pi, np.pi, (self.dwells, 3)) if self.poses is None else self.poses
        rows, biases = sensitivities(self.truth)
        step_ns = round(1e9 / self.rate_hz)
        times, readings, pose_times, pose_values, start = [], [], [], [], 0
        for pose in poses:
            turn = Rotation.identity()
            for axis, angle in zip(np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), pose, strict=True):
                turn = turn * Rotation.from_rotvec(axis * angle)
            force = turn.inv().apply([0.0, G, 0.0])
            if self.setting_deg:
                force = Rotation.from_rotvec(rng.normal(size=3) * np.radians(self.setting_deg)).apply(force)
            level = rows @ force + biases + rng.normal(size=3) * self.scatter_mps2
            stamps = start + np.arange(self.count) * step_ns
            times.append(stamps)
            readings.append(level + self._noise(rng) + self._shared(rng, level - biases))
            pose_times.append(stamps[::10])
            told = np.repeat(pose[None], len(stamps[::10]), axis=0)
            encoders = np.random.default_rng([self.seed, len(pose_values)])
            pose_values.append(told + encoders.normal(size=told.shape) * np.radians(self.encoder_deg))
            start = int(stamps[-1]) + round(self.gap_s * 1e9)
        self.accel = Stream(np.concatenate(times), np.concatenate(readings))
        self.pose = Stream(np.concatenate(pose_times), np.concatenate(pose_values))

    def _noise(self, rng: np.random.Generator) -> np.ndarray:
        if not self.phi:
            return rng.normal(size=(self.count, 3)) * self.white_mps2
        white = rng.normal(size=(self.count + 200, 3)) * np.sqrt(1 - self.phi**2)
        return lfilter([1.0], [1.0, -self.phi], white, axis=0)[200:] * self.white_mps2

    def _shared(self, rng: np.random.Generator, felt: np.ndarray) -> np.ndarray:
        shared = self.shared_mps2 and self.shared_mps2 * rng.normal(size=(self.count, 1))
        return shared + (self.shaken_mps2 and self.shaken_mps2 * rng.normal(size=(self.count, 1)) * felt / G)

    def __iter__(self) -> Iterator[Batch]:
        for first in range(0, len(self.accel), self.batch):
            part = self.accel[first : first + self.batch]
            low = part.time_ns[0] if first else np.iinfo(np.int64).min
            last = first + self.batch >= len(self.accel)
            after = self.accel.time_ns[first + self.batch] if not last else np.iinfo(np.int64).max
            chosen = (self.pose.time_ns >= low) & (self.pose.time_ns < after)
            yield Batch(part, self.pose[chosen])
