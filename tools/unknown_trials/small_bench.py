"""A small bench by numpy and scipy: three accelerometers on three gimbals that stand in one orientation after another.

Angles are exact, and the noise is white: whatever else the residuals hold was hidden.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream

G_MPS2 = 9.81
WHITE_MPS2 = 5e-5
RATE_HZ = 20.0
_DWELL_S, _SLEW_S = 12.0, 4.0
_PATH = 20  # places of a slew at which the force on its way is known


@dataclass(frozen=True)
class Visits:
    """What the block feels in D dwells of n readings.

    - angles_rad (D, 3): of the gimbals, outer first. force_mps2 (D, 3): along x, y, z of the block.
    - path_mps2 (D, m, 3): the force on the way to each dwell, its own last; that of the first all alike.
    - time_s, temperature_c (D, n): of each reading.
    """

    angles_rad: Floats
    force_mps2: Floats
    path_mps2: Floats
    time_s: Floats
    temperature_c: Floats

    @property
    def step_mps2(self) -> Floats:
        """Change (D, 3) of the force from the dwell before; 0 in the first."""
        return np.diff(self.force_mps2, axis=0, prepend=self.force_mps2[:1])


def _forces(angles_rad: Floats) -> Floats:
    """Specific force (m, 3) in a block that is turned about y, then z, then x."""
    return np.asarray(Rotation.from_euler("YZX", angles_rad).inv().apply([0.0, G_MPS2, 0.0]))


def visits(seed: int, dwells: int, repeated: int = 0) -> Visits:
    """Orientations at random, the last ``repeated`` of them those of the first, in a room whose temperature swings."""
    rng = np.random.default_rng([seed, 1])
    attitudes = Rotation.from_quat(rng.normal(size=(dwells, 4))).as_euler("YZX")
    angles = np.vstack([attitudes[: dwells - repeated], attitudes[:repeated]])
    forces, share = _forces(angles), np.linspace(0.0, 1.0, _PATH + 1)[1:, None]
    ways = [_forces(before + share * (after - before)) for before, after in itertools.pairwise(angles)]
    path = np.array([np.repeat(forces[:1], _PATH, axis=0), *ways])
    starts = np.arange(dwells) * (_DWELL_S + _SLEW_S)
    time = starts[:, None] + np.arange(int(_DWELL_S * RATE_HZ)) / RATE_HZ
    swing, period, phase = rng.uniform(2.0, 5.0), time.max() * rng.uniform(0.4, 0.9), rng.uniform(0.0, 2.0 * np.pi)
    warm = 25.0 + rng.uniform(-3.0, 3.0) + swing * np.sin(2.0 * np.pi * time / period + phase)
    return Visits(angles, forces, path, time, warm)


@dataclass
class SmallRun:
    """A source of kf_calib: the visits, read by three sensors of random errors, with something ``hidden`` (D, n, 3).

    With ``scatter_mps2`` the dwells scatter, although the bench says that they do not. ``altered`` makes other readings
    (D, n, 3) of these by a generator of random numbers; the clock is ``late_s`` (D, n) behind.
    """

    at: Visits
    hidden_mps2: Floats
    seed: int
    scatter_mps2: float = 0.0
    altered: Callable[[Floats, np.random.Generator], Floats] = lambda readings, rng: readings
    late_s: Floats | float = 0.0
    warnings: list[str] = field(default_factory=list[str])
    fraction: float = 1.0

    @property
    def bench(self) -> Bench:
        """What the program is told of the bench."""
        return Bench(axes_of("yzx"), G_MPS2, latitude_deg=50.0, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)

    @cached_property
    def readings_mps2(self) -> Floats:
        """Readings (D, n, 3)."""
        rng = np.random.default_rng([self.seed, 2])
        rows = np.eye(3) + rng.normal(size=(3, 3)) * 1e-3
        level = self.at.force_mps2 @ rows.T + rng.normal(size=3) * 1e-3
        level = level + rng.normal(size=level.shape) * self.scatter_mps2
        noise = rng.normal(size=self.hidden_mps2.shape) * WHITE_MPS2
        return self.altered(level[:, None] + self.hidden_mps2 + noise, rng)

    def __iter__(self) -> Iterator[Batch]:
        times = np.round((self.at.time_s + self.late_s) * 1e9).astype(np.int64)
        every = max(1, times.shape[1] // 30)
        poses = np.repeat(self.at.angles_rad[:, None], times.shape[1], axis=1)
        yield Batch(
            Stream(times.ravel(), self.readings_mps2.reshape(-1, 3)),
            Stream(times[:, ::every].ravel(), poses[:, ::every].reshape(-1, 3)),
            Stream(times[:, ::every].ravel(), self.at.temperature_c[:, ::every].reshape(-1, 1)),
        )


def hidden_run(formula: Callable[[Visits], Floats], sigmas: float, seed: int, dwells: int = 24) -> SmallRun:
    """A run with an effect (D, n, 3) of this size hidden, its coefficients random.

    The size is the norm of what the means of the dwells are moved by, less what bias and sensitivities of each
    accelerometer take of it, over the noise of a mean.
    """
    at = visits(seed, dwells)
    shape = formula(at) * np.random.default_rng([seed, 3]).normal(size=3)
    columns = np.column_stack([at.force_mps2, np.ones(dwells)])
    basis = np.linalg.qr(columns)[0]
    means = shape.mean(axis=1)
    left = means - basis @ (basis.T @ means)
    size = float(np.linalg.norm(left)) / (WHITE_MPS2 / np.sqrt(shape.shape[1]))
    return SmallRun(at, shape * (sigmas / size), seed)
