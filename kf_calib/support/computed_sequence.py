"""Sequences whose items are made when they are asked for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import TypeVar, overload

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
    def __getitem__(self, index: slice) -> list[Computed]: ...
    def __getitem__(self, index: int | slice) -> Computed | list[Computed]:
        if isinstance(index, slice):
            return [self.item(k) for k in range(*index.indices(len(self)))]
        return self.item(range(len(self))[index])
