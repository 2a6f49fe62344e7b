"""What an effect is: a name, coefficients with unit and scale, and columns over the stimulus.

Two kinds cover the catalogue: a ``SensorEffect`` has one coefficient for each accelerometer and says what it adds to a
reading per unit of it; a ``FrameEffect`` turns the platform by a small rotation per unit of each coefficient,
common to the three accelerometers. A new effect is a class with a docstring and one method.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kf_calib.effects.stimulus import Stimulus
from kf_calib.samples import Floats

G = 9.80665


@dataclass(frozen=True)
class Coefficient:
    """symbol, SI unit; scale: a size a user would call large, for a prior; shown_unit, per_si: a unit of the field."""

    symbol: str
    unit: str
    scale: float
    shown_unit: str
    per_si: float


class Effect(ABC):
    """A physical effect the readings may contain besides the twelve parameters."""

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    confused_with: ClassVar[str] = ""
    variant: str = ""
    """The axis of an axis-wise effect (``encoder-harmonic-2:z``)."""

    def __str__(self) -> str:
        return f"{self.name}:{self.variant}" if self.variant else self.name

    @property
    @abstractmethod
    def coefficients(self) -> tuple[Coefficient, ...]: ...

    @abstractmethod
    def columns(self, s: Stimulus) -> Floats:
        """What each accelerometer reads more per unit of each coefficient: (m, 3, q), m/s^2."""


class SensorEffect(Effect):
    """One coefficient for each accelerometer; ``terms`` (m, 3) is what each reads more per unit of its own."""

    symbol: ClassVar[str]
    unit: ClassVar[str]
    scale: ClassVar[float]
    shown: ClassVar[tuple[str, float]]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"{self.symbol}{i}", self.unit, self.scale, *self.shown) for i in (1, 2, 3))

    @abstractmethod
    def terms(self, s: Stimulus) -> Floats: ...

    def columns(self, s: Stimulus) -> Floats:
        out = np.zeros((len(s), 3, 3))
        out[:, range(3), range(3)] = self.terms(s)
        return out


class FrameEffect(Effect):
    """The platform stands otherwise than its angles say; ``rotations`` (m, q, 3), rad per unit, in the platform frame.

    A rotation alpha turns the specific force by alpha x f, and reading i changes by s_i . (alpha x f).
    """

    @abstractmethod
    def rotations(self, s: Stimulus) -> Floats: ...

    def columns(self, s: Stimulus) -> Floats:
        turned = np.cross(self.rotations(s), s.force_mps2[:, None, :])
        return np.einsum("mqx,ix->miq", turned, s.sensitivity)
