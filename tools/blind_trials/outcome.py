"""What was hidden in a trial, and what the program said about it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from blind_trials.task import Task

NOTHING, NOISE, NONE = "nothing", "unstated noise", "none of the known"
"""Physical families of explanations that name no effect."""


@dataclass(frozen=True)
class Hypothesis:
    """One explanation that the program weighs.

    effects: names of what would be missing (empty: a formula that is no known effect, noise, or nothing). formula: of
    what is no known effect. families: physical families. probability: the program's.
    """

    effects: tuple[str, ...] = ()
    formula: str = ""
    families: tuple[str, ...] = ()
    probability: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what the program answered.

    truth: names of the hidden effects. first: the name given first, ``unknown``, ``noise`` or None (nothing).
    names: all names given. ambiguity: the names that the program cannot tell apart. same: pairs of a hidden name and a
    name given that mean the same in this run. extra: what else the figure needs. seconds: processor time by part.
    error: why there is no answer to judge. refused: whether it was the program that gave no answer, which counts as not
    right.

    outside: those hidden effects that are in no catalogue. alike: sets of names that together mean one of these.
    true_families: physical families of the hidden effects, and those of the names that mean the same. hypotheses: all
    explanations weighed. families: physical families with their probabilities, the likeliest first.
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
    outside: tuple[str, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()
    true_families: tuple[str, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    families: tuple[tuple[str, float], ...] = ()

    @property
    def named(self) -> str | None:
        """The effect named first; None for nothing, for unknown and for noise."""
        return None if self.first in ("unknown", "noise") else self.first

    @property
    def outside_right(self) -> bool:
        """Whether what is in no catalogue is called unknown, or by names that together mean it.

        Noise may be called noise, too, or be estimated where none is stated.
        """
        if self.true_families != (NOISE,):
            return self.first == "unknown" or self.explained_by(self.names)
        estimated = self.first is None and "--unstated" in self.task.options and not self.refused
        return self.first in ("unknown", "noise") or estimated

    @property
    def is_noise(self) -> bool:
        """Whether all that is missing is noise that was not stated, or not stated large enough."""
        unstated = self.task.family == "understated" or "--unstated" in self.task.options
        return self.true_families == (NOISE,) if self.truth else unstated

    @property
    def family_right(self) -> bool:
        """Whether the likeliest physical family is right."""
        return bool(self.families) and self.families[0][0] in self.true_families

    def means_truth(self, name: str | None) -> bool:
        """Tell whether a name means a hidden effect."""
        return name in {given for _, given in self.same}

    @property
    def right(self) -> bool:
        """Whether the name given first is right."""
        return self.named is not None and self.means_truth(self.named)

    def explained_by(self, names: Collection[str]) -> bool:
        """Tell whether names mean every hidden effect and nothing else."""
        if tuple(sorted(names)) in self.alike:
            return True
        every = all(any((true, name) in self.same for name in names) for true in self.truth)
        return every and all(map(self.means_truth, names))

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
