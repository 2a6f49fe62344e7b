"""The possible interpretations of a run's recorded poses: the bench as stated, or with a few things different.

What may differ is the sense and the order of the gimbals, the order and the unit of their angles and the axis that is
up; for attitude quaternions, their sense and the order of their components.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import UP

_MOST_CHANGES = 2


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
            yield _Alternative("axes", f"the gimbal axes are, outer to inner, {axes}", _reordered_axes(order))
            yield _Alternative("order", f"gimbals {' '.join(letters)} have the angles {columns}", _reordered(order))
    yield _Alternative("unit", "the angles are in degrees", _with_unit(math.radians(1.0)))
    yield _Alternative("unit", "the angles were turned from degrees into radians twice", _with_unit(math.degrees(1.0)))


def _of_up(bench: Bench) -> Iterator[_Alternative]:
    """Yield changes of the axis that points up."""
    for up in UP:
        if up != bench.up:
            yield _Alternative("up", f"{up} is up when all angles are zero", _with_up(up))


def _of_attitude() -> Iterator[_Alternative]:
    """Yield changes of the sense and of the order of components of attitude quaternions."""
    inverted, first = "the attitude is that of the bench in the platform", "the quaternion has its real part first"
    yield _Alternative("sense", inverted, lambda mounting: replace(mounting, conjugate=True))
    yield _Alternative("order", first, lambda mounting: replace(mounting, real_first=True))


def _reversed_gimbals(gimbals: Collection[int]) -> Callable[[Mounting], Mounting]:
    """Return the change that reverses the sense of some gimbals."""

    def apply(mounting: Mounting) -> Mounting:
        axes = list(mounting.bench.axes)
        for k in gimbals:
            x, y, z = axes[k]
            axes[k] = (0.0 - x, 0.0 - y, 0.0 - z)
        return replace(mounting, bench=replace(mounting.bench, axes=tuple(axes)))

    return apply


def _reordered_axes(order: Sequence[int]) -> Callable[[Mounting], Mounting]:
    """Return the change that puts the gimbal axes into another order."""

    def apply(mounting: Mounting) -> Mounting:
        axes = tuple(mounting.bench.axes[k] for k in order)
        return replace(mounting, bench=replace(mounting.bench, axes=axes))

    return apply


def _reordered(order: tuple[int, ...]) -> Callable[[Mounting], Mounting]:
    """Return the change that assigns the recorded angles to the gimbals in another order."""
    return lambda mounting: replace(mounting, order=order)


def _with_unit(angle_unit: float) -> Callable[[Mounting], Mounting]:
    """Return the change of the unit of the recorded angles."""
    return lambda mounting: replace(mounting, angle_unit=angle_unit)


def _with_up(up: str) -> Callable[[Mounting], Mounting]:
    """Return the change of the axis that points up."""
    return lambda mounting: replace(mounting, bench=replace(mounting.bench, up=up))
