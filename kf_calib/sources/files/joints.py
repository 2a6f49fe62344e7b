"""Which positions of a joint state are the gimbals: a message may give them in any order, and among other joints.

They are told by their names. Stated names (bench key ``joints``, outer to inner) win; else names in which a word is
outer, middle or inner, as recordings made here have, or, where a message gives as many joints as there are gimbals, the
letter of the gimbal's axis. As many joints of other names, or of none, are the gimbals in the order in which they come.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

_USUAL = {2: ("outer", "inner"), 3: ("outer", "middle", "inner")}
_OURS = re.compile(r"outer|middle|inner|axis\d+")
_UNITS = ("deg", "rad")


class JointsError(ValueError):
    """The names do not tell which joints are the gimbals."""


def gimbal_names(count: int) -> tuple[str, ...]:
    """What gimbals are called in a recording, outer to inner."""
    return _USUAL.get(count) or tuple(f"axis{i}" for i in range(count))


def as_columns(text: str) -> Mapping[str, str]:
    """Our names of a table's columns where it names the gimbals as the stated joints are named."""
    joints = text.replace(",", " ").split()
    pairs = list(zip(joints, gimbal_names(len(joints)), strict=True))
    return {f"{joint}_{unit}": f"{usual}_{unit}" for joint, usual in pairs for unit in _UNITS}


class Joints:
    """Finds ``count`` gimbals, outer to inner, in message after message.

    stated: names of theirs. letters: of their axes, where all are different. warn: is told once where gimbals are taken
    by names that nobody stated, and not as they come.
    """

    def __init__(
        self,
        count: int,
        stated: Sequence[str] = (),
        letters: Sequence[str] = (),
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._count, self._stated, self._letters, self._warn = count, tuple(stated), tuple(letters), warn
        self._first: tuple[str, ...] | None = None
        self._is_told = False
        self.found = False
        """Whether any message had the stated joints."""
        self.others: tuple[str, ...] = ()
        """Names in a message that has none of them."""

    def __call__(self, names: tuple[str, ...], width: int) -> tuple[int, ...] | None:
        """Where the gimbals are among ``width`` positions; None: the message is of other joints only.

        Raises JointsError where the names do not tell.
        """
        if self._stated:
            return self._by_statement(names)
        known = self._by_meaning(names)
        if self._first is None:
            self._first = tuple(names[i] for i in known) if known else names
        if known:
            self._refuse_change(tuple(names[i] for i in known))
            self._tell(names, known)
            return known
        if width != self._count:
            raise JointsError(self._unclear(names, width))
        self._refuse_change(names)
        return tuple(names.index(name) for name in self._first) if names else tuple(range(width))

    def _by_statement(self, names: tuple[str, ...]) -> tuple[int, ...] | None:
        missing = [name for name in self._stated if names.count(name) != 1]
        if not missing:
            self.found = True
            return tuple(names.index(name) for name in self._stated)
        if names and len(missing) == len(self._stated):
            self.others = self.others or names
            return None
        given = f"names {', '.join(names)}" if names else "gives joints without names"
        raise JointsError(f"a message {given}, so that {', '.join(missing)} of the stated joints cannot be found in it")

    def _by_meaning(self, names: tuple[str, ...]) -> tuple[int, ...] | None:
        usual = gimbal_names(self._count)
        if any(_OURS.fullmatch(word) and word not in usual for name in names for word in _words(name)):
            return None  # of more gimbals, or fewer, than axes are stated
        for words in (usual, self._letters if len(names) == self._count else ()):
            places = [[i for i, name in enumerate(names) if word in _words(name)] for word in words]
            if places and all(len(own) == 1 for own in places):
                return tuple(own[0] for own in places)
        return None

    def _refuse_change(self, names: tuple[str, ...]) -> None:
        assert self._first is not None
        if sorted(names) != sorted(self._first):
            raise JointsError(
                f"joint names change from {' '.join(self._first)} to {' '.join(names)}: name the gimbals, outer to "
                "inner, by --joints"
            )

    def _tell(self, names: tuple[str, ...], known: tuple[int, ...]) -> None:
        if known != tuple(range(len(names))) and not self._is_told:
            self._is_told = True
            self._warn(
                f"of the joints {', '.join(names)} the gimbals are, by their names and outer to inner, "
                f"{', '.join(names[i] for i in known)}; --joints states others"
            )

    def _unclear(self, names: tuple[str, ...], width: int) -> str:
        if width < self._count or not names:
            return f"it gives {width} positions for {self._count} gimbal axes: state the axes it has"
        return (
            f"it gives {width} joints ({', '.join(names)}) where {self._count} gimbal axes are stated, and their names "
            "do not tell which are the gimbals: name these, outer to inner, for example "
            f'--joints "{" ".join(names[: self._count])}", or state all axes'
        )


def _words(name: str) -> set[str]:
    """``gimbal_outer_joint``, ``GimbalOuter``: their words in small letters, and the whole name."""
    return {name.lower(), *(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))}
