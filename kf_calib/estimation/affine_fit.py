"""Mean readings of dwells as an affine function of the specific force that the angles state."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask
from kf_calib.bench.bench import Bench
from kf_calib.bench.mountings import Mounting
from kf_calib.bench.raw_input import CHANNELS
from kf_calib.dwells.sufficient_statistics import DwellFactor

Channels = tuple[int, int, int]
_FARTHEST = math.cos(math.radians(45.0))  # largest angle of an axis from nominal
GAIN_RANGE = (0.5, 2.0)  # range of a scale factor over nominal; outside it is another unit or no accelerometer
_SPREAD = 0.2  # least singular value of the directions over sqrt(D); 0.577 if they are spread evenly
_BIAS = 0.3  # g; prior sigma of a bias, which matters if the orientations do not determine it


@dataclass(frozen=True)
class DwellMeans:
    """Means over D dwells.

    - poses (D, k): poses as recorded.
    - readings (D, 3): mean readings.
    - middle_s (D,): middle of each dwell.
    - numbers: numbers of the dwells.
    """

    poses: Floats
    readings: Floats
    middle_s: Floats
    numbers: tuple[int, ...]

    @classmethod
    def of(cls, dwells: Sequence[DwellFactor]) -> DwellMeans:
        """The means of these dwells."""
        return cls(
            np.array([dwell.recorded_pose for dwell in dwells]),
            np.array([dwell.means[4:] for dwell in dwells]),
            np.array([0.5 * (dwell.start_s + dwell.end_s) for dwell in dwells]),
            tuple(dwell.number for dwell in dwells),
        )

    def __getitem__(self, part: Mask) -> DwellMeans:
        numbers = tuple(itertools.compress(self.numbers, part))
        return DwellMeans(self.poses[part], self.readings[part], self.middle_s[part], numbers)

    def force(self, mounting: Mounting) -> Floats:
        """Specific force (D, 3) in the platform in units of gravity, if the poses mean what ``mounting`` says."""
        bench = mounting.bench
        return bench.specific_force(self.middle_s, mounting.poses(self.poses)) / bench.gravity_mps2


@dataclass(frozen=True)
class AffineFit:
    """The least-squares fit of the mean readings by the specific force.

    - sensitivity (3, 3): rows s_i.
    - left: rms of the residuals, g.
    - nominal (3, 3): nominal sensitivities.
    """

    sensitivity: Floats
    left: float
    nominal: Floats

    @cached_property
    def scales(self) -> Floats:
        """|s_i| divided by its nominal value, (3,)."""
        return np.linalg.norm(self.sensitivity, axis=1) / np.linalg.norm(self.nominal, axis=1)

    @cached_property
    def cosines(self) -> Floats:
        """Cosines (3, 3) of the angles between axis i and the nominal axis of accelerometer j."""
        own, nominal = (rows / np.linalg.norm(rows, axis=1)[:, None] for rows in (self.sensitivity, self.nominal))
        return own @ nominal.T

    def is_near(self, channels: Channels = CHANNELS) -> bool:
        """Tell whether all axes and scale factors are near nominal with the channels in this order and with these
        signs."""
        own = np.abs(channels) - 1
        cosines = np.sign(channels) * self.cosines[own, [0, 1, 2]]
        scales = np.linalg.norm(self.sensitivity, axis=1)[own] / np.linalg.norm(self.nominal, axis=1)
        return bool((cosines > _FARTHEST).all() and (scales > GAIN_RANGE[0]).all() and (scales < GAIN_RANGE[1]).all())


def fit_affine(means: DwellMeans, mounting: Mounting) -> AffineFit | None:
    """Return the fit; None if the orientations do not determine all three axes."""
    force = means.force(mounting)
    if not determines_axes(force):
        return None
    readings = means.readings / mounting.bench.gravity_mps2
    columns = np.column_stack([force, np.ones(len(force))])
    held = np.vstack([columns, [0.0, 0.0, 0.0, 0.05 / _BIAS]])  # readings are assumed good to 0.05 g
    solution = np.linalg.lstsq(held, np.vstack([readings, np.zeros((1, 3))]), rcond=None)[0]
    freedom = max(len(force) - 4, 1) / len(force)
    left = math.sqrt(np.mean((readings - columns @ solution) ** 2) / freedom)
    return AffineFit(np.asarray(solution[:3].T, float), left, nominal_sensitivity(mounting.bench))


def determines_axes(force: Floats) -> bool:
    """Tell whether directions (D, 3) determine three axes."""
    return len(force) >= 3 and np.linalg.svd(force, compute_uv=False)[-1] > _SPREAD * math.sqrt(len(force))


def nominal_sensitivity(bench: Bench) -> Floats:
    """Return the nominal sensitivities (3, 3)."""
    return paper_parameters.state_of(paper_parameters.nominal(bench.nominal)).reshape(3, 4)[:, :3]
