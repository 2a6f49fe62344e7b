"""The terms of the noise beside white noise: changes of the readings by independent errors of 1 sigma each.

A term is to the noise what an effect is to the model: it gives columns at the nodes of all pieces. The errors of a term
are drawn anew for each dwell, once for the run, or along the path of a random walk. Whatever is computed in a noise
(whitened rows, covariances of means, the reference filter) goes over the list of its terms.

A setting error is a small rotation. About the axis t it changes the reading of accelerometer i by t . (f x s_i), with
s_i its sensitivity, to which what effects add per unit of force belongs. Where the attitude of the dwells is not known
at all, nor that it stays the same within a dwell (a hand creeps and trembles), it has no columns: one combination of
the three readings is left at every instant, that along the force, which no rotation changes (``rotations``).

With 1/f noise of spectral density h / f, the component sqrt(2) cos(pi k t / T) of a dwell or a run of length T has the
variance h / k, whatever T is. Scatter from dwell to dwell that is 1/f noise goes on within the dwells, and is similar
in consecutive dwells, so that it looks like a drift; scatter of another cause (a mounting, a creep after each motion)
does not. With it the means of D dwells have the variance s^2 = h ln D about their common mean.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.limits import FEWEST_COMPARED
from kf_calib.dwells.table import DwellTable, FoldedDwells, computed_once
from kf_calib.noise import temperature_course
from kf_calib.noise.means import Means
from kf_calib.noise.rotations import sensitivities_of

Scope = Literal["dwell", "run", "path"]

FLOOR_MPS2 = 1e-9
"""Least sigma of a reading, used where readings are exactly constant; the rounding of a double is about 1e-15 m/s^2."""

ATTITUDE_UNKNOWN_RAD = np.inf
"""The setting error where the attitude of the dwells is not known at all."""

SLOW = np.arange(1, 5)
"""Numbers of half cycles of the slow waves of 1/f noise in a dwell."""

_WANDER = 6  # half cycles of those over the run
_TURNED = 1e4  # sigmas of a mean reading: what an attitude that is not known may change it by


class NoiseTerm(ABC):
    """A term of the noise.

    - scope: whether its errors are drawn anew for each dwell, once for the run, or along a path.
    - stated: False where its size was estimated from the misfit of the dwells, which may be what the model lacks.
    """

    scope: ClassVar[Scope]
    stated: bool = True

    @property
    @abstractmethod
    def sizes(self) -> Floats:
        """The numbers (n,) that say how large it is; zeros where there is none."""

    @abstractmethod
    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        """Changes (pieces, nodes, 3, q) of the readings by 1 sigma of each of its q errors, for a model at ``state``
        (p,)."""

    def covariances(self, means: Means, state: Floats) -> Floats | float:
        """Covariances (D, 3, 3) of the dwells' mean readings by errors that are drawn for each dwell."""
        del means, state
        return 0.0


@dataclass(frozen=True)
class SettingError(NoiseTerm):
    """A small rotation in each dwell that all three accelerometers share, of ``size_rad`` about each axis.

    - size_rad: infinite where the attitude of the dwells is not known at all.
    - judged: whether one that was estimated is so clear that it counts where the misfit is judged.
    - considered: whether it is a considered parameter (Schmidt), which enlarges the covariance but does not change the
      estimate, and dwells are weighted by their scatter alone. Else it is weighted: readings along the specific force,
      which no rotation changes, get more weight. It is only considered where the scatter is not stated and there are
      too few orientations to check that a setting error only turns the specific force.
    """

    size_rad: float = 0.0
    stated: bool = False
    judged: bool = False
    considered: bool = False
    scope: ClassVar[Scope] = "dwell"

    @property
    def is_unknown(self) -> bool:
        """Whether nothing is known of the attitude of a dwell, so that only the size of the force is."""
        return not np.isfinite(self.size_rad)

    @property
    def sizes(self) -> Floats:
        return np.array([self.size_rad])

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        pieces = dwells.folded.ends[-1]
        if not 0.0 < self.size_rad < np.inf:
            return np.zeros((pieces, 3, 3, 0))
        x, y, z = np.moveaxis(self.size_rad * sensitivities_of(dwells, state), 2, 0)
        none = np.zeros_like(x)
        crossing = np.array([[none, -z, y], [z, none, -x], [-y, x, none]])  # (f x s) = f^T [s]: (force, axis, D, 3)
        turning = np.moveaxis(crossing, (0, 2, 3, 1), (1, 0, 2, 3)).reshape(len(x), 3, 9)
        force_mps2 = dwells.felt_force_mps2.reshape(-1, 3, 3)
        changes = force_mps2 @ np.repeat(turning, dwells.folded.piece_numbers, axis=0)
        return np.asarray(changes.reshape(pieces, 3, 3, 3), float)

    def covariances(self, means: Means, state: Floats, largest_mps2: float = 0.0) -> Floats | float:
        """sigma_alpha^2 S (|f|^2 I - f f^T) S^T; an attitude that is not known counts as a sigma_alpha so large, beside
        the largest sigma of a mean by other noise, that it leaves the size of f alone."""
        size_rad = self.size_rad
        if self.is_unknown:
            size_rad = _TURNED * largest_mps2 / np.linalg.norm(means.force_mps2, axis=1).max()
        return size_rad**2 * setting_covariances(means, state) if size_rad else 0.0


@dataclass(frozen=True)
class Scatter(NoiseTerm):
    """An offset of each accelerometer in each dwell, of ``sizes_mps2`` (3,)."""

    sizes_mps2: Floats = field(default_factory=lambda: np.zeros(3))
    stated: bool = False
    scope: ClassVar[Scope] = "dwell"

    @property
    def sizes(self) -> Floats:
        return self.sizes_mps2

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        channels = np.flatnonzero(self.sizes_mps2 > 0)
        columns = np.zeros((dwells.folded.ends[-1], 3, 3, len(channels)))
        columns[:, :, channels, np.arange(len(channels))] = self.sizes_mps2[channels]
        return columns

    def covariances(self, means: Means, state: Floats) -> Floats | float:
        return np.diag(self.sizes_mps2**2)

    def flicker_mps2(self, dwells: int) -> Floats:
        """sqrt(h) (3,) of the 1/f noise that would produce the scatter over so many dwells."""
        return self.sizes_mps2 / np.sqrt(np.log(max(dwells, 2)))


@dataclass(frozen=True)
class SlowWaves(NoiseTerm):
    """The slow waves of 1/f noise within each dwell, of sqrt(h) = ``flicker_mps2`` (3,)."""

    flicker_mps2: Floats
    scope: ClassVar[Scope] = "dwell"

    @property
    def sizes(self) -> Floats:
        return self.flicker_mps2

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        waves = waves_in_dwells(dwells.folded)
        columns = np.zeros((*waves.shape[:2], 3, 3, len(SLOW)))
        sigmas = np.maximum(self.flicker_mps2, FLOOR_MPS2)[:, None] / np.sqrt(SLOW)
        columns[:, :, range(3), range(3)] = waves[:, :, None] * sigmas
        return columns.reshape(*waves.shape[:2], 3, -1)


@dataclass(frozen=True)
class WavesOverRun(NoiseTerm):
    """Those over the whole run, constant within a dwell, for k = 1 ... 6; none for an accelerometer without it."""

    flicker_mps2: Floats
    scope: ClassVar[Scope] = "run"

    @property
    def sizes(self) -> Floats:
        return self.flicker_mps2

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        channels, folded = np.flatnonzero(self.flicker_mps2 > 0), dwells.folded
        pieces, width = folded.ends[-1], folded.width
        if len(dwells) < FEWEST_COMPARED:
            return np.zeros((pieces, width, 3, 0))
        begin_s, orders = folded.ends_s[0, 0], np.arange(1, _WANDER + 1)
        at = (folded.ends_s.mean(axis=1) - begin_s) / (folded.ends_s[-1, 1] - begin_s)
        waves = np.zeros((pieces, width, 3, len(channels), _WANDER))
        courses = np.sqrt(2.0) * np.cos(np.pi * orders * np.repeat(at, folded.piece_numbers)[:, None])
        sigmas = self.flicker_mps2[channels, None] / np.sqrt(orders)
        waves[:, :3, channels, np.arange(len(channels))] = courses[:, None, None] * sigmas
        return waves.reshape(*waves.shape[:3], -1)


@dataclass(frozen=True)
class SquareAxes(NoiseTerm):
    """Angles between axes that the dwells do not tell, and that are taken for square (``free_attitude``).

    sigmas (3, 3): of the sensitivity of each channel to the force along each axis.
    """

    sigmas: Floats
    scope: ClassVar[Scope] = "run"

    @property
    def sizes(self) -> Floats:
        return self.sigmas.ravel()

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        places = np.argwhere(self.sigmas > 0.0)
        changes = np.zeros((len(dwells.force_mps2), 3, len(places)))
        for k, (channel, axis) in enumerate(places.tolist()):
            changes[:, channel, k] = dwells.force_mps2[:, axis] * self.sigmas[channel, axis]
        return dwells.folded.at_nodes(changes).values


@dataclass(frozen=True)
class ThermometerError(NoiseTerm):
    """The smooth error of the temperature that noise of the thermometer leaves (``temperature_course``).

    sensitivity_mps2_per_k (3, 8): change of the readings per K on the regressors 1, f and T, T f.
    """

    sensitivity_mps2_per_k: Floats
    scope: ClassVar[Scope] = "run"

    @property
    def sizes(self) -> Floats:
        return self.sensitivity_mps2_per_k.ravel()

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        return temperature_course.thermometer_errors(dwells, self.sensitivity_mps2_per_k).values


@dataclass(frozen=True)
class RandomWalk(NoiseTerm):
    """A random walk of each bias of intensity q, whose standard deviation after the time t is q sqrt(t).

    Its steps are states of the filter (``random_walk``), and no columns.

    - intensities_mps2_per_sqrt_s (3,): q of each accelerometer; all are zero, or none is.
    - spreads (3,): the sigmas of their logarithms; zeros where they were stated or are not seen.
    """

    intensities_mps2_per_sqrt_s: Floats = field(default_factory=lambda: np.zeros(3))
    spreads: Floats = field(default_factory=lambda: np.zeros(3))
    scope: ClassVar[Scope] = "path"

    @property
    def sizes(self) -> Floats:
        return self.intensities_mps2_per_sqrt_s

    @property
    def rms_mps2_per_sqrt_s(self) -> float:
        """The root mean square of the three intensities."""
        return float(np.sqrt(np.mean(self.sizes**2)))

    @property
    def is_alike(self) -> bool:
        """Whether all three are one."""
        return not np.ptp(self.sizes)

    @property
    def spread(self) -> float:
        """The sigma of the logarithm of their root mean square."""
        if self.is_alike:
            return float(self.spreads[0])
        return float(np.linalg.norm(self.sizes**2 * self.spreads) / np.sum(self.sizes**2))

    @property
    def steps(self) -> int:
        """Number of columns of the steps that the biases take within a dwell: one for each accelerometer, none where
        they do not walk."""
        return 3 if self.sizes.any() else 0

    def columns(self, dwells: DwellTable, state: Floats) -> Floats:
        return np.zeros((dwells.folded.ends[-1], 3, 3, 0))


@computed_once
def waves_in_dwells(folded: FoldedDwells) -> Floats:
    """sqrt(2) cos(pi k t / T) over a dwell of length T at the nodes of all pieces, (pieces, nodes, k)."""
    starts_s, ends_s = np.repeat(folded.ends_s, 3 * folded.piece_numbers, axis=0).T
    share = (folded.elapsed_s - starts_s) / np.maximum(ends_s - starts_s, 1e-9)
    return (np.sqrt(2.0) * np.cos(np.pi * SLOW * share[:, None])).reshape(-1, 3, len(SLOW))


def setting_covariances(means: Means, state: Floats) -> Floats:
    """Covariances (D, 3, 3) of the mean readings that a random small rotation of unit variance per axis produces."""
    force, sensitivity = means.force_mps2, means.sensitivities(state)
    across = np.einsum("di,di->d", force, force)[:, None, None] * np.eye(3) - force[:, :, None] * force[:, None, :]
    return sensitivity @ across @ np.swapaxes(sensitivity, 1, 2)
