"""What the surroundings do to the sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects.effect import MICRO_G, Coefficient, Effect, Typical
from kf_calib.effects.stimulus import Stimulus

_DIRECTIONS = 18
"""Directions of a field that are tried: every 10 degrees, opposite ones are the same."""


class Magnetic(Effect):
    """m_i B . E_i, B the local field: (m_i B_N) N . E_i + (m_i B_E) E . E_i, the products are fitted.

    The vertical part is along gravity, and so a scale factor.
    """

    family = "surroundings"
    name, title, source = "magnetic", "response to the local magnetic field", "IEEE Std 1293, magnetic sensitivity"
    confused_with = "needs turns about the vertical"
    typical = Typical((1 * 0.2 * MICRO_G, 20 * 0.2 * MICRO_G))  # 1 to 20 ug/G in a horizontal field of 0.2 G

    @property
    def relations(self) -> Sequence[Floats]:
        """All sensors are in one field: (m_i B_N, m_i B_E) = m_i B (cos a, sin a), its direction a is not known."""
        directions = np.linspace(0.0, np.pi, _DIRECTIONS, endpoint=False)
        return [np.kron(np.eye(3), [[np.cos(a)], [np.sin(a)]]).astype(float) for a in directions]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"mB{part}{i}", "m/s^2", 1e-3) for i in (1, 2, 3) for part in "NE")

    def columns(self, s: Stimulus) -> Floats:
        columns = np.zeros((len(s), 3, 6))
        along = np.stack([s.to_platform(axis) for axis in s.level_axes], axis=2)  # (m, 3, 2)
        for i in range(3):
            columns[:, i, 2 * i : 2 * i + 2] = np.einsum("x,mxk->mk", s.axes[i], along)
        return columns
