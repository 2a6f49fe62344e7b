"""The quantities that formulas name: what the bench does at each instant, constants, and units."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Vector
from kf_calib.effects.stimulus import Stimulus


@dataclass(frozen=True)
class FormulaQuantity:
    """A name in formulas: its SI unit, its meaning, and its values (m, 1), (m, 3) or a number."""

    unit: str
    meaning: str
    of: Callable[[Stimulus], Floats | float]


QUANTITIES: dict[str, FormulaQuantity] = {
    "fx": FormulaQuantity("m/s^2", "specific force along x of the platform", lambda s: s.force_mps2[:, 0:1]),
    "fy": FormulaQuantity("m/s^2", "specific force along y of the platform", lambda s: s.force_mps2[:, 1:2]),
    "fz": FormulaQuantity("m/s^2", "specific force along z of the platform", lambda s: s.force_mps2[:, 2:3]),
    "a": FormulaQuantity("m/s^2", "specific force along the input axis", lambda s: s.along),
    "p": FormulaQuantity("m/s^2", "specific force along the pendulous axis", lambda s: s.pendulous),
    "o": FormulaQuantity("m/s^2", "specific force along the output axis", lambda s: s.output),
    "da": FormulaQuantity("m/s^2", "last step of a from dwell to dwell", lambda s: s.step),
    **{
        f"play{width:g}": FormulaQuantity(
            "m/s^2", f"a through a play of {width:g} m/s^2", partial(Stimulus.played, half_width_mps2=width)
        )
        for width in (1.0, 3.0, 6.0)
    },
    "T": FormulaQuantity("K", "temperature less 25 degC", lambda s: s.warmth[:, None]),
    "dT": FormulaQuantity("K/s", "rate of the temperature", lambda s: s.warming[:, None]),
    "t": FormulaQuantity("s", "time since the first sample", lambda s: s.elapsed_s[:, None]),
    "tau": FormulaQuantity("s", "time since the arrival in the dwell", lambda s: s.since_arrival_s[:, None]),
    "g": FormulaQuantity("m/s^2", "local gravity", lambda s: s.bench.gravity_mps2),
    "s": FormulaQuantity("s", "one second", lambda s: 1.0),
    "m": FormulaQuantity("m", "one metre", lambda s: 1.0),
    "K": FormulaQuantity("K", "one kelvin", lambda s: 1.0),
    "rad": FormulaQuantity("rad", "one radian", lambda s: 1.0),
    "deg": FormulaQuantity("rad", "one degree", lambda s: math.pi / 180.0),
    "pi": FormulaQuantity("", "3.14159...", lambda s: math.pi),
}


def gimbal_letters(axes: tuple[Vector, ...]) -> str:
    """A letter for each gimbal: its axis, or ? where it is none of x, y, z."""
    return "".join(
        "xyz"[max(range(3), key=lambda k, a=axis: abs(a[k]))] if 1.0 in map(abs, axis) else "?" for axis in axes
    )


@lru_cache(maxsize=32)
def quantities(axes: tuple[Vector, ...]) -> dict[str, FormulaQuantity]:
    """Everything a formula may name on a bench with these gimbal axes."""
    letters, named = gimbal_letters(axes), dict(QUANTITIES)
    for k, letter in enumerate(letters):
        angle, number = f"angle of gimbal {k + 1}", f"q{k + 1}"
        names = [number, *([f"q_{letter}"] if letter != "?" and letters.count(letter) == 1 else [])]
        names += ["outer"] * (k == 0) + ["inner"] * (k == len(letters) - 1)
        named |= dict.fromkeys(names, FormulaQuantity("rad", angle, lambda s, k=k: s.pose[:, [k]]))
        named[f"{number}_before"] = FormulaQuantity(
            "rad", f"{angle} in the dwell before", lambda s, k=k: s.previous_pose[:, [k]]
        )
        named[f"{number}_move"] = FormulaQuantity(
            "rad", f"last move of gimbal {k + 1}, 0 where it stood still", lambda s, k=k: s.move(k)[:, None]
        )
        named[f"{number}_way"] = FormulaQuantity(
            "rad", f"way that gimbal {k + 1} has turned since the first dwell", lambda s, k=k: s.way(k)[:, None]
        )
    return named
