"""How units and chances of a fleet are written in tables and figures."""

from __future__ import annotations

_LEAST = 1e-6


def short_name(unit: str) -> str:
    """The name of a unit; of one that goes by its recording, the name of the file."""
    return unit.rsplit("/", 1)[-1] if unit.startswith("/") or "://" in unit else unit


def chance_words(chance: float) -> str:
    """A chance, for a reader who asks no more than how small it is."""
    return f"{chance:.1g}" if chance >= _LEAST else f"< {_LEAST:.0e}"
