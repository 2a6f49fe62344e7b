"""What effects are made of: axes of the accelerometers, temperature, signs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.physics import TrueState, TrueStep

_NO_SIGN_MPS2 = 1e-9
"""Below this an acceleration is rounding noise and has no sign."""


def pendulous(state: TrueState) -> Floats:
    """a_p of the three accelerometers: platform y, z, x."""
    return state.force_mps2[:, [1, 2, 0]]


def output(state: TrueState) -> Floats:
    """a_o of the three accelerometers: platform z, x, y."""
    return state.force_mps2[:, [2, 0, 1]]


def above(state: TrueState, reference_c: float) -> Floats:
    """T (n, 1), the true temperature above the reference."""
    return column(state.temperature_c - reference_c)


def sign(values: Floats, least: float = _NO_SIGN_MPS2) -> Floats:
    """-1, 0 or 1; 0 below ``least``."""
    return np.where(np.abs(values) < least, 0.0, np.sign(values))


def column(values: Floats) -> Floats:
    """One value a sample (n,) as a column (n, 1)."""
    return values[:, None]


def adding(contribution: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that adds to the readings."""

    def step(state: TrueState) -> None:
        state.reading_mps2 = state.reading_mps2 + contribution(state)

    return step
