"""Arrays: their types, named by what they hold; lengths of vectors; sequences whose items are made when they are asked
for; and how many threads the linear algebra may take.
"""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import TypeVar, overload

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

Times = NDArray[np.int64]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

ROUNDING = 1e-9
"""Share of the largest of numbers below which another is what rounding leaves of zero."""
LAST_DIGITS = 1e-12
"""The same of a difference of two numbers, which has lost nothing but its last digits."""
EXACT = 1e-14
"""The same of a number that lost nothing: a few units of its last place."""
DIFFERENCE = float(np.finfo(float).eps) ** (1.0 / 3.0)
"""Step of central differences, of what counts from 1: rounding and curvature then leave errors alike."""
AT_ONCE = 1024
"""Rows that are worked on together, so that they and their copies stay in the cache of a processor."""
IN_CACHE = 1 << 17
"""Numbers that are worked on together for the same reason."""
IN_MEMORY = 1 << 22
"""Numbers that are made together: 32 MB."""


def lengths(vectors: Floats) -> Floats:
    """The length (n,) of each row (n, k) of numbers as they stand in a file; infinite where it is beyond a double."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=1))


def sign(values: Floats, least: float = ROUNDING) -> Floats:
    """The sign of numbers in SI; 0 of those that are no larger than what rounding leaves of zero."""
    return np.sign(np.where(np.abs(values) > least, values, 0.0))


def portions(count: int, most: int) -> Iterator[slice]:
    """Slices of at most ``most``, one after another, that hold ``count`` together."""
    return (slice(k, min(k + most, count)) for k in range(0, count, most))


def first_least(values: Floats, tie: float = ROUNDING) -> int:
    """Index of the least of numbers (n,); the first of those that are as small but for rounding.

    Processors round differently. By ``argmin`` one of several equal choices would be another on each.
    """
    least = float(values.min())
    return int(np.argmax(values <= (least + tie * max(abs(least), 1.0) if np.isfinite(least) else least)))


def crossed(one: Floats, other: Floats) -> Floats:
    """The cross products (n, 3) of vectors (n, 3); ``np.cross`` takes several times as long."""
    (a, b, c), (x, y, z) = one.T, other.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)


Computed = TypeVar("Computed", covariant=True)


class ComputedSequence(Sequence[Computed]):
    """A sequence that makes its items by ``item``; a slice is a list of them."""

    @abstractmethod
    def item(self, k: int) -> Computed:
        """The item at an index from 0 to the length less one."""

    def __iter__(self) -> Iterator[Computed]:
        return map(self.item, range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Computed: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Computed]: ...
    def __getitem__(self, index: int | slice) -> Computed | Sequence[Computed]:
        if isinstance(index, slice):
            return [self.item(k) for k in range(*index.indices(len(self)))]
        return self.item(range(len(self))[index])


def one_blas_thread() -> AbstractContextManager[object]:
    """A context in which BLAS uses one thread: with several, small decompositions take three times as long and may give
    different bits every time."""
    return _controller("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


@cache
def _controller(scipy: bool) -> ThreadpoolController:
    """The controller of the loaded libraries, cached because finding them takes a millisecond; scipy brings its own."""
    return ThreadpoolController()
