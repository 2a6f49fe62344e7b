"""Real recordings with platform angles: each pose of the hand as a pose of two gimbals, with a setting error.

The direction of the force that the body feels is that of its readings, by the nine parameters of the trial, smoothed
over a second; the angles of two gimbals are those at which a platform would feel it. From pose to pose these are off by
a random rotation of the size that is stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from real_trials.recordings import GRAVITY_MPS2, Altered, RealRecording

SETTING_DEG = 0.05
_SMOOTH_S = 1.0
_ANGLE_HZ = 10.0
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class TurnedRecording(RealRecording):
    """A real recording with angles of two gimbals; its readings are those of the recording."""

    @property
    def name(self) -> str:
        return f"{super().name}, angles"

    @cached_property
    def _poses(self) -> Floats:
        return RealRecording(self.path)._poses  # the same poses, whether angles are there or not

    @property
    def still(self) -> bool:
        """Whether the body stands in its poses as still as the angles are set, and does not creep in a hand."""
        moved = [np.diff(self._smooth[[start, end]], axis=0) for start, end in self._ends]
        return float(np.sqrt(np.mean(np.square(moved)))) < np.radians(SETTING_DEG) * GRAVITY_MPS2

    @cached_property
    def _ends(self) -> list[tuple[int, int]]:
        """Numbers of the readings half a smoothing window inside the begin and the end of each pose."""
        inside = self.dwells_s + 0.5 * _SMOOTH_S * np.array([1.0, -1.0])
        return [(int(a), int(b)) for a, b in np.searchsorted(self.time_s, inside)]

    @cached_property
    def _smooth(self) -> Floats:
        rate_hz = len(self.time_s) / self.time_s[-1]
        return uniform_filter1d(self.force_mps2, max(round(_SMOOTH_S * rate_hz), 1), axis=0)

    @cached_property
    def _shown(self) -> Floats:
        """Unit vectors (n, 3) of the force as the angles show it at each reading."""
        smooth, random = self._smooth, np.random.default_rng([ord(letter) for letter in self.name])
        errors = np.radians(SETTING_DEG) * random.normal(size=(len(self.dwells_s), 3))
        ends = self.dwells_s.ravel()
        at_time = [np.interp(self.time_s, ends, np.repeat(error, 2)) for error in errors.T]
        turned = smooth + np.cross(np.stack(at_time, axis=1), smooth)
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    @cached_property
    def _axes(self) -> tuple[Floats, Floats]:
        """Two gimbal axes, outer first: the inner one far from all poses, where the angles would not be determined."""
        poses = self.means(self._shown)

        def nearest(angles: Floats) -> float:
            return float(np.abs(poses @ _unit(angles)).max() + max(abs(_unit(angles) @ _UP) - 0.9, 0.0))

        starts = np.random.default_rng(1).uniform([0.2, -np.pi], [np.pi - 0.2, np.pi], (200, 2))
        best = minimize(nearest, min(starts, key=nearest), method="Nelder-Mead").x
        inner = _unit(best)
        outer = np.cross(_UP, inner)
        return outer / np.linalg.norm(outer), inner

    @cached_property
    def _angles_rad(self) -> Floats:
        """Angles (n, 2) at which a platform of these axes feels the shown force."""
        outer, inner = self._axes
        level = -np.cross(outer, _UP)
        lead = np.arctan2(inner @ level, inner @ _UP)
        first = lead + np.arccos(np.clip(self._shown @ inner, -1.0, 1.0))
        upright = np.cos(first)[:, None] * _UP + np.sin(first)[:, None] * level
        along = (upright @ inner) * (self._shown @ inner)
        second = -np.arctan2(np.cross(upright, self._shown) @ inner, np.sum(upright * self._shown, axis=1) - along)
        return np.stack([first, np.unwrap(second)], axis=1)

    def altered(self, added_mps2: Floats) -> Altered:
        axes = tuple(tuple(axis.tolist()) for axis in self._axes)
        bench = Bench(axes=axes, gravity_mps2=GRAVITY_MPS2, angle_sigma_deg=SETTING_DEG)
        plain, batches, start = super().altered(added_mps2), list[Batch](), 0
        step = max(round(len(self.time_s) / self.time_s[-1] / _ANGLE_HZ), 1)
        for batch in plain.batches:
            places = np.arange(start, start + len(batch.accel))[::step]
            pose = Stream(batch.accel.time_ns[::step], self._angles_rad[places])
            batches.append(Batch(batch.accel, pose, batch.temperature))
            start += len(batch.accel)
        return replace(plain, bench=bench, batches=batches)

    @cached_property
    def _white(self) -> tuple[Floats, Floats]:
        """A basis (3 D, 12) of what the twelve parameters explain of the poses' readings, and roots (D, 3, 3) of the
        weights of these, in the scatter of |f| and the stated setting error."""
        force = GRAVITY_MPS2 * self.means(self._shown)
        sensitivity = np.linalg.lstsq(np.column_stack([force, np.ones(len(force))]), self.means(self.readings_mps2))[0]
        s = sensitivity[:3].T
        across = GRAVITY_MPS2**2 * np.eye(3) - force[:, :, None] * force[:, None, :]
        covariance = self.scatter_mps2**2 * np.eye(3) + np.radians(SETTING_DEG) ** 2 * s @ across @ s.T
        roots = np.linalg.inv(np.linalg.cholesky(covariance))
        columns = np.zeros((len(force), 3, 12))
        for channel in range(3):
            columns[:, channel, 4 * channel : 4 * channel + 3] = force
            columns[:, channel, 4 * channel + 3] = 1.0
        return np.linalg.qr((roots @ columns).reshape(-1, 12))[0], roots

    def seen(self, added_mps2: Floats) -> Floats:
        return self._left(self.means(added_mps2))

    @cached_property
    def left(self) -> Floats:
        return self._left(self.means(self.readings_mps2))

    def _left(self, means: Floats) -> Floats:
        basis, roots = self._white
        white = (roots @ means[:, :, None]).ravel()
        return white - basis @ (basis.T @ white)


def _unit(angles: Floats) -> Floats:
    return np.array([
        np.sin(angles[0]) * np.cos(angles[1]), np.cos(angles[0]), np.sin(angles[0]) * np.sin(angles[1])
    ])  # fmt: skip
