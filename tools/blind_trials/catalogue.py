"""Effects that can be hidden."""

from __future__ import annotations

from kf_calib.effects.sensor import DeadZone
from kf_calib.sources.simulation.injected import EffectKind, catalogue


def known_kinds() -> list[EffectKind]:
    """Return the kinds of effects that the program knows and that have a size in sigma."""
    return [kind for kind in catalogue().values() if kind.known and kind.stage != "record"]


def largest_size(kind: EffectKind) -> float:
    """Return a size at which the effect shows if it ever does; for a dead zone the widest that the program tries."""
    widest = DeadZone.unknown.high if kind.name == DeadZone.name and DeadZone.unknown else None
    return widest or kind.typical("navigation")[1]


def outside_effects() -> list[str]:
    """Return the names of the effects that are in no catalogue of the program."""
    kinds = [kind for kind in catalogue().values() if not kind.known]
    return [
        f"{kind.name}:{axis}" if axis else kind.name for kind in kinds for axis in ("zx" if kind.per_axis else [""])
    ]
