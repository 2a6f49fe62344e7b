"""What was hidden in a trial, and what the program said about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from blind_trials.task import Task


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what the program answered.

    truth: names of the hidden effects. first: the name given first (None: nothing is missing). names: all names given.
    ambiguity: the names that the program cannot tell apart. same: pairs of a hidden name and a name given that mean the
    same in this run. extra: what else the figure needs. seconds: processor time by part. error: why there is no answer
    to judge. refused: whether it was the program that gave no answer, which counts as not right.
    """

    task: Task
    truth: tuple[str, ...] = ()
    first: str | None = None
    names: tuple[str, ...] = ()
    ambiguity: tuple[str, ...] = ()
    same: tuple[tuple[str, str], ...] = ()
    consistent: bool | None = None
    p_value: float | None = None
    invisible: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict[str, Any])
    seconds: dict[str, float] = field(default_factory=dict[str, float])
    error: str = ""
    refused: bool = False

    @property
    def named(self) -> str | None:
        """The effect named first; None for nothing and for unknown."""
        return None if self.first == "unknown" else self.first

    def means_truth(self, name: str | None) -> bool:
        """Tell whether a name means a hidden effect."""
        return name in {given for _, given in self.same}

    @property
    def right(self) -> bool:
        """Whether the name given first is right."""
        return self.named is not None and self.means_truth(self.named)

    @property
    def held(self) -> bool:
        """Whether the ambiguity set holds every hidden effect."""
        return all(any((true, name) in self.same for name in self.ambiguity) for true in self.truth)

    @property
    def wrong(self) -> bool:
        """Whether a name was given, and neither it nor any in its ambiguity set is right."""
        return self.named is not None and not (
            self.means_truth(self.named) or any(map(self.means_truth, self.ambiguity))
        )

    @property
    def found(self) -> bool:
        """Whether every hidden effect was named."""
        return all(any((true, name) in self.same for name in self.names) for true in self.truth)

    @property
    def nothing_else(self) -> bool:
        """Whether only hidden effects were named."""
        return all(map(self.means_truth, self.names))
