"""A bench of three gimbals, y z x, written anew with scipy's rotations: of the program's own simulator and effects it
knows nothing. What is wrong with it is given as functions of its state.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream

G = 9.81262
HZ, DWELL_S, SLEW_S = 20.0, 8.0, 4.0
BENCH = Bench(axes_of("yzx"), G, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
ROBOT = Bench((), G, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
"""It records its attitude in place of gimbal angles."""


@dataclass(frozen=True)
class State:
    """What goes on at n instants: dwell: number of the orientation, from 0; since_s: time since its arrival, 0 on the
    way; angles_rad: as they are recorded, (n, 3); moves_rad: the last move of each gimbal, (n, 3)."""

    time_s: np.ndarray
    dwell: np.ndarray
    since_s: np.ndarray
    angles_rad: np.ndarray
    moves_rad: np.ndarray


Error = Callable[[State], np.ndarray]


def _none(state: State) -> np.ndarray:
    return np.zeros((len(state.time_s), 3))


@dataclass(frozen=True)
class IndependentBench:
    """A source. gimbals: errors of the angles (n, 3), rad; base, mount: rotation vectors (n, 3) of the base, in the
    bench, and of the block, in the platform; scale: share (n, 3) by which the readings are too large; bias:
    what is added to them, m/s^2. pose_noise_rad: of each recorded angle, or of the attitude about each axis.
    tilts_rad: rotation vectors by which the axis of each gimbal is turned in its parent."""

    seed: int
    dwells: int = 24
    white_mps2: float = 5e-5
    pose_noise_rad: float = 0.0
    gimbals: Error = _none
    base: Error = _none
    mount: Error = _none
    scale: Error = _none
    bias: Error = _none
    bench: Bench = BENCH
    tilts_rad: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),) * 3
    warnings: tuple[str, ...] = ()

    @cached_property
    def poses_rad(self) -> np.ndarray:
        """Directions of a Fibonacci lattice in random order, and quarter turns about the vertical."""
        rng = np.random.default_rng(self.seed)
        k = rng.permutation(self.dwells) + 0.5
        up, turn = 1.0 - 2.0 * k / self.dwells, np.pi * (1.0 + 5.0**0.5) * k
        level = np.sqrt(1.0 - up**2)
        inner = np.arctan2(-level * np.sin(turn), up) % (2.0 * np.pi)
        return np.column_stack([rng.integers(0, 4, self.dwells) * np.pi / 2, np.arcsin(level * np.cos(turn)), inner])

    @property
    def state(self) -> State:
        time_s = np.arange(round(self.dwells * (DWELL_S + SLEW_S) * HZ)) / HZ
        dwell = (time_s / (DWELL_S + SLEW_S) + 1e-9).astype(int)
        since_s = time_s - dwell * (DWELL_S + SLEW_S)
        share = 0.5 - 0.5 * np.cos(np.pi * np.clip(since_s - DWELL_S, 0.0, SLEW_S) / SLEW_S)
        following = self.poses_rad[np.minimum(dwell + 1, self.dwells - 1)]
        angles_rad = self.poses_rad[dwell] + share[:, None] * (following - self.poses_rad[dwell])
        moves_rad = np.diff(self.poses_rad, axis=0, prepend=self.poses_rad[:1])
        for k in range(1, self.dwells):  # a gimbal that stands still has moved before
            moves_rad[k] = np.where(moves_rad[k] == 0.0, moves_rad[k - 1], moves_rad[k])
        stands = (since_s < DWELL_S) | (dwell == self.dwells - 1)  # at the end it stays where it is
        return State(time_s, dwell, np.where(stands, since_s, 0.0), angles_rad, moves_rad[dwell])

    def _sensors(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit input axes (3, 3), scale factors (3,) and biases (3,), m/s^2."""
        axes = np.eye(3) + 1e-3 * rng.standard_normal((3, 3))
        scales, biases = 1.0 + 3e-4 * rng.standard_normal(3), 2e-3 * rng.standard_normal(3)
        return axes / np.linalg.norm(axes, axis=1)[:, None], scales, biases

    def _turned(self, angles_rad: np.ndarray) -> Rotation:
        """The platform in the base: each gimbal turns the next about its axis as it is."""
        nominal = np.eye(3)[[1, 2, 0]]
        axes = [Rotation.from_rotvec(tilt).apply(axis) for tilt, axis in zip(self.tilts_rad, nominal, strict=True)]
        outer, middle, inner = (Rotation.from_rotvec(angles_rad[:, [k]] * axis) for k, axis in enumerate(axes))
        return outer * middle * inner

    @property
    def biases_mps2(self) -> np.ndarray:
        """The true biases (3,)."""
        return self._sensors(np.random.default_rng([self.seed, 1]))[2]

    @property
    def scales(self) -> np.ndarray:
        """The true scale factors (3,)."""
        return self._sensors(np.random.default_rng([self.seed, 1]))[1]

    def __iter__(self) -> Iterator[Batch]:
        state, rng = self.state, np.random.default_rng([self.seed, 1])
        axes, scales, biases = self._sensors(rng)
        turned = self._turned(state.angles_rad + self.gimbals(state))
        in_bench = Rotation.from_rotvec(self.base(state)) * turned * Rotation.from_rotvec(self.mount(state))
        along = in_bench.inv().apply([0.0, G, 0.0]) @ axes.T
        readings = (scales + self.scale(state)) * along + biases + self.bias(state)
        readings += self.white_mps2 * rng.standard_normal(readings.shape)
        time_ns = np.rint(state.time_s * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
        pose, noise_rad = state.angles_rad, self.pose_noise_rad * rng.standard_normal((len(time_ns), 3))
        if not self.bench.axes:
            pose = (Rotation.from_euler("YZX", pose) * Rotation.from_rotvec(noise_rad)).as_quat()
        else:
            pose = pose + noise_rad
        yield Batch(Stream(time_ns, readings), Stream(time_ns, pose))
