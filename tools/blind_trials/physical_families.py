"""The physical families of hidden effects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from kf_calib.effects import effect_named
from kf_calib.sources.files.recording import Recording


def families_of(path: Path, effects: Sequence[dict[str, Any]], same: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Return the families of hidden effects, as the side file of a recording describes them, each once.

    An effect of the catalogue has the family that is told there, and those of the names that mean the same in this run.
    """
    bench = Recording(path).bench
    names = [name for effect in effects if effect["in_catalogue"] for true, name in same if true == effect["name"]]
    told = [effect["family"] for effect in effects if not effect["in_catalogue"]]
    return tuple(dict.fromkeys([*told, *(effect_named(name, bench).family for name in names)]))
