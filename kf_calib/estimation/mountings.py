"""What the recorded poses of a run may mean: the bench as stated, or with a few things different.

What may differ is the sense and the order of the gimbals, the order and the unit of their angles and the axis that is
up; for attitude quaternions, their sense and the order of their components. Which of these it is, an affine fit of the
dwells' mean readings to the specific force tells: under the right one, the axes and scale factors are near nominal.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask
from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import UP
from kf_calib.dwells.table import DwellTable
from kf_calib.support.tail_probabilities import LEVEL

_MOST_CHANGES = 2

Channels = tuple[int, int, int]
FARTHEST = math.cos(math.radians(45.0))
"""Cosine of the largest angle of an axis from nominal."""
GAIN_RANGE = (0.5, 2.0)
"""Range of a scale factor over nominal; outside it is another unit or no accelerometer."""
NOISE = 0.05
"""g; to which mean readings are assumed good: an effect or scatter of this size is a blunder."""
_LOOSE = 0.3  # prior sigma of sensitivities and, in g, biases about nominal
_SPREAD = 0.2  # least singular value of the directions over sqrt(D); 0.577 if they are spread evenly


@dataclass(frozen=True)
class Mounting:
    """One interpretation of the recorded poses.

    - bench: the bench as it would have to be stated.
    - order: the column of the recorded angles that belongs to each gimbal.
    - angle_unit: rad per unit of the recorded angles.
    - conjugate: the recorded quaternions are of the inverse rotation; real_first: their real part comes first.
    - words: the differences in words; changes: how many things differ from what is stated.
    """

    bench: Bench
    order: tuple[int, ...] = ()
    angle_unit: float = 1.0
    conjugate: bool = False
    real_first: bool = False
    words: tuple[str, ...] = ()
    changes: int = 0

    @classmethod
    def stated(cls, bench: Bench) -> Mounting:
        """The interpretation that the bench states."""
        return cls(bench, tuple(range(len(bench.axes))))

    def poses(self, recorded: Floats) -> Floats:
        """Poses (D, k) in rad, or quaternions x y z w, from the poses as recorded."""
        if self.bench.axes:
            return recorded[:, self.order] * self.angle_unit
        x, y, z, w = recorded[:, [1, 2, 3, 0]].T if self.real_first else recorded.T
        sign = -1.0 if self.conjugate else 1.0
        return np.column_stack([sign * x, sign * y, sign * z, w])


def mountings(stated: Mounting) -> Iterator[Mounting]:
    """Yield the possible interpretations, beginning with the stated one, in order of the number of changes."""
    # Another axis up comes first, as it begins with the bench as it is stated.
    possible = [*_of_up(stated.bench), *(_of_gimbals(stated.bench) if stated.bench.axes else _of_attitude())]
    for count in range(_MOST_CHANGES + 1):
        for chosen in itertools.combinations(possible, count):
            if len({change.kind for change in chosen}) == count:
                mounting = stated
                for change in chosen:
                    mounting = change.apply(mounting)
                yield replace(mounting, words=tuple(change.words for change in chosen), changes=count)


@dataclass(frozen=True)
class _Alternative:
    """One thing that may differ from what is stated; changes of the same kind exclude each other."""

    kind: str
    words: str
    apply: Callable[[Mounting], Mounting]


def _of_gimbals(bench: Bench) -> Iterator[_Alternative]:
    """Yield changes of the sense and order of the gimbals and of the order and unit of the recorded angles."""
    gimbals, letters = range(len(bench.axes)), bench.to_metadata()["axes"].split()
    for k in gimbals:
        yield _Alternative(f"sense {k}", f"gimbal {letters[k]} turns the other way", _reversed_gimbals((k,)))
    if len(gimbals) > 1:
        yield _Alternative("sense", "all angles have the opposite sign", _reversed_gimbals(gimbals))
    for order in itertools.permutations(gimbals):
        if order != tuple(gimbals):
            axes, columns = " ".join(letters[k] for k in order), ", ".join(str(k + 1) for k in order)
            yield _Alternative("axes", f"the gimbal axes are, outer to inner, {axes}", _with_axes(order))
            yield _Alternative("order", f"gimbals {' '.join(letters)} have the angles {columns}", _with(order=order))
    yield _Alternative("unit", "the angles are in degrees", _with(angle_unit=math.radians(1.0)))
    yield _Alternative(
        "unit", "the angles were turned from degrees into radians twice", _with(angle_unit=math.degrees(1.0))
    )


def _of_up(bench: Bench) -> Iterator[_Alternative]:
    """Yield changes of the axis that points up."""
    for up in UP:
        if up != bench.up:
            yield _Alternative("up", f"{up} is up when all angles are zero", _with(bench=replace(bench, up=up)))


def _of_attitude() -> Iterator[_Alternative]:
    """Yield changes of the sense and of the order of components of attitude quaternions."""
    inverted, first = "the attitude is that of the bench in the platform", "the quaternion has its real part first"
    yield _Alternative("sense", inverted, _with(conjugate=True))
    yield _Alternative("order", first, _with(real_first=True))


def _reversed_gimbals(gimbals: Collection[int]) -> Callable[[Mounting], Mounting]:
    """Return the change that reverses the sense of some gimbals."""

    def apply(mounting: Mounting) -> Mounting:
        axes = list(mounting.bench.axes)
        for k in gimbals:
            x, y, z = axes[k]
            axes[k] = (0.0 - x, 0.0 - y, 0.0 - z)
        return replace(mounting, bench=replace(mounting.bench, axes=tuple(axes)))

    return apply


def _with_axes(order: Sequence[int]) -> Callable[[Mounting], Mounting]:
    """Return the change that puts the gimbal axes into another order."""

    def apply(mounting: Mounting) -> Mounting:
        return replace(mounting, bench=replace(mounting.bench, axes=tuple(mounting.bench.axes[k] for k in order)))

    return apply


def _with(**changes: Any) -> Callable[[Mounting], Mounting]:
    """Return the change of some of a mounting's fields."""
    return lambda mounting: replace(mounting, **changes)


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
    def of(cls, dwells: DwellTable) -> DwellMeans:
        """The means of these dwells."""
        return cls(
            np.array([dwell.recorded_pose for dwell in dwells]),
            dwells.means[:, 4:],
            dwells.folded.ends_s.mean(axis=1),
            tuple(dwells.folded.numbers.tolist()),
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

    def is_along(self) -> bool:
        """Tell whether all axes are near nominal."""
        return bool((np.diag(self.cosines) > FARTHEST).all())

    def is_near_nominal(self) -> bool:
        """Tell whether all axes and scale factors are near nominal."""
        return self.is_along() and bool((self.scales > GAIN_RANGE[0]).all() and (self.scales < GAIN_RANGE[1]).all())


@dataclass(frozen=True)
class Misfits:
    """How little a mounting explains the readings, with sensitivities and biases as near nominal as they may be.

    Half of chi-squared of each channel's readings z, with either sign, as those of accelerometer j: of the residuals of
    z - F n_j, beside the deviations from the nominal sensitivity n_j and of the bias. F are the directions of gravity.

    - of_axes (3, 2, 3): of channels, signs + and -, and accelerometers.
    - of_none (3,): of channels that feel nothing but their bias.
    - count: number of readings.
    """

    of_axes: Floats
    of_none: Floats
    count: int

    @classmethod
    def of_mounting(cls, means: DwellMeans, mounting: Mounting) -> Misfits:
        """Those of a mounting."""
        force, readings = means.force(mounting), means.readings / mounting.bench.gravity_mps2
        expected, signed = force @ nominal_sensitivity(mounting.bench).T, np.stack([readings, -readings], axis=2)
        ones = np.ones((len(force), 1))
        return cls(
            _half_chi2(signed[..., None] - expected[:, None, None], np.hstack([force, ones])),
            _half_chi2(readings, ones),
            readings.size,
        )

    def of(self, wirings: Sequence[Channels]) -> Floats:
        """The misfits (n,) with these channels; 0 stands for one that is dead."""
        wired = np.asarray(wirings)
        felt = self.of_axes[np.abs(wired) - 1, (wired < 0).astype(int), [0, 1, 2]]
        return np.where(wired == 0, self.of_none, felt).sum(axis=1)

    def within_noise(self, wirings: Sequence[Channels]) -> Floats:
        """The same; infinite where readings would not leave so much by their noise."""
        from scipy.special import chdtri

        misfits = self.of(wirings)
        return np.where(2.0 * misfits < chdtri(self.count, LEVEL), misfits, np.inf)


def _half_chi2(left: Floats, columns: Floats) -> Floats:
    """Return half of the least of |left - columns x|^2 / NOISE^2 + |x|^2 / LOOSE^2 for many left (D, ...)."""
    stacked = left.reshape(len(left), -1)
    along = columns.T @ stacked
    inside = np.linalg.solve(columns.T @ columns + (NOISE / _LOOSE) ** 2 * np.eye(columns.shape[1]), along)
    return ((stacked**2).sum(axis=0) - (along * inside).sum(axis=0)).reshape(left.shape[1:]) / (2.0 * NOISE**2)


def fit_affine(means: DwellMeans, mounting: Mounting) -> AffineFit | None:
    """Return the fit; None if the orientations do not determine all three axes."""
    force = means.force(mounting)
    if not determines_axes(force):
        return None
    readings = means.readings / mounting.bench.gravity_mps2
    columns = np.column_stack([force, np.ones(len(force))])
    held = np.vstack([columns, [0.0, 0.0, 0.0, NOISE / _LOOSE]])
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
