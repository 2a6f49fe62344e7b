"""Lines in which each value has its name before it, as on a serial port: ``aX: -0.06, aY: 0.00, aZ: 8.44``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from kf_calib.sources.text.names import is_unit, meanings_of

_LABELLED = re.compile(
    r"(?<!\w)([^\W\d][^:=,;|\t\"{}]{0,40}?)\s*[:=]\s*([+\-−]?\d[\d.]*(?:[eE][+\-]?\d+)?|[+\-−]?\.\d+)"
    r"(?:\s*((?:[^\s\d:=,;|][^\s:=,;|]*)(?=[\s,;|]|$)(?!\s*[:=])))?"
)
_FEWEST, _MOST_LINES, _LONGEST = 3, 1000, 1000
_READINGS = {"ax", "ay", "az"}


class Labels(NamedTuple):
    """The names in each line that has readings, and with their units those of the columns that they make."""

    names: tuple[str, ...]
    header: list[str]

    @classmethod
    def of(cls, lines: Sequence[str]) -> Labels | None:
        """The labels of lines, of which those count that name an accelerometer; None where none do."""
        seen = dict[tuple[str, ...], Labels]()
        for line in lines[:_MOST_LINES]:
            parts = _LABELLED.findall(line) if (":" in line or "=" in line) and len(line) < _LONGEST else []
            names = tuple(name for name, *_ in parts)
            if len(parts) >= _FEWEST and names not in seen:
                last = parts[-1][2] if is_unit(parts[-1][2]) else ""
                units = [own if is_unit(own) else last for *_, own in parts]
                named = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
                seen[names] = cls(names, named)
        return next((each for each in seen.values() if each._has_readings), None)

    @property
    def _has_readings(self) -> bool:
        return {own.ours for own in meanings_of(self.header, {})} >= _READINGS

    def spans(self, line: str) -> list[tuple[int, int]]:
        """Where the values stand in a line; none where it has other labels."""
        found = list(_LABELLED.finditer(line)) if len(line) < _LONGEST else []
        return [match.span(2) for match in found] if tuple(match[1] for match in found) == self.names else []

    def values(self, line: str) -> list[str]:
        """The values in a line; none where it has other labels."""
        return [line[start:end] for start, end in self.spans(line)]
