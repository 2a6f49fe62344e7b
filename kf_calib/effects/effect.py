"""What an effect is: a name, coefficients with unit and scale, and columns over the stimulus.

Two kinds cover the catalogue: a ``SensorEffect`` has one coefficient for each accelerometer and says what it adds to a
reading per unit of it; a ``RotationEffect`` (``effects.frame``) turns the platform by a small rotation per unit of each
coefficient, common to the three accelerometers. A new effect is a class with a docstring, and a formula or one method.
"""

from __future__ import annotations

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Literal, Self

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.effects.expression import Expression
from kf_calib.effects.quantities import QUANTITIES
from kf_calib.effects.stimulus import Stimulus
from kf_calib.support.units import STANDARD_GRAVITY_MPS2, field_unit

MICRO_G, MILLI_G = 1e-6 * STANDARD_GRAVITY_MPS2, 1e-3 * STANDARD_GRAVITY_MPS2
MICRO_PER_G, MILLI_PER_G = 1e-6 / STANDARD_GRAVITY_MPS2, 1e-3 / STANDARD_GRAVITY_MPS2
"""ug/g^2 and mg/g^2 in s^2/m."""

Grade = Literal["navigation", "mems"]


@dataclass(frozen=True)
class Typical:
    """Sizes of a coefficient that are usual, from ... to, in SI; from 0 where only the greatest is known.

    navigation, mems: in sensors of either grade, or, of what is the bench's, on a bench that such sensors are tested
    on; None where it is not known.
    """

    navigation: tuple[float, float] | None = None
    mems: tuple[float, float] | None = None

    def of(self, grade: Grade) -> tuple[float, float] | None:
        """The sizes of one grade."""
        return self.mems if grade == "mems" else self.navigation


@dataclass(frozen=True)
class Coefficient:
    """symbol, SI unit; scale: a size a user would call large, for a prior.

    shown_unit, per_si: a unit of the field, and how many of it make one SI unit; left out, they are those of the table
    in ``support.units``.
    """

    symbol: str
    unit: str
    scale: float
    shown_unit: str = ""
    per_si: float = 1.0

    def __post_init__(self) -> None:
        _complete(self)


@dataclass(frozen=True)
class Unknown:
    """A positive constant inside the columns (a time constant, a frequency), estimated with the coefficients.

    low, high: the range it is looked for in. Its state is ln(value / current value), so its sigma is a share of it.
    """

    symbol: str
    unit: str
    low: float
    high: float
    shown_unit: str = ""
    per_si: float = 1.0

    def __post_init__(self) -> None:
        _complete(self)

    def grid(self, ratio: float = 1.5) -> Floats:
        """Values from low to high in equal steps of the logarithm, each at most ``ratio`` times the one before."""
        count = int(np.ceil(np.log(self.high / self.low) / np.log(ratio))) + 1
        return np.geomspace(self.low, self.high, count)


def _complete(parameter: Coefficient | Unknown) -> None:
    """Fill in the unit of the field where none was given."""
    if not parameter.shown_unit:
        unit = field_unit(parameter.unit)
        object.__setattr__(parameter, "shown_unit", unit.label)  # the way for a frozen dataclass
        object.__setattr__(parameter, "per_si", unit.per_si)


@dataclass(frozen=True)
class Regressor:
    """A quantity that an effect is drawn against: an expression over the quantities of formulas, such as ``a*p``.

    words: what it is. unit: SI. Both are left out for a single quantity, which has them. Without an expression it is
    what a sensor effect adds per unit of its coefficient.
    """

    expression: str
    words: str = ""
    unit: str = ""


class Bearer(StrEnum):
    """What can have an effect, by its physics.

    - BENCH: gimbals, encoders, the base, the clock: all sensors on a bench have the same, and none takes it elsewhere.
    - SENSORS: what is inside an accelerometer goes with it from bench to bench.
    - EITHER: a field of the bench that a sensor feels, or what nobody has said.
    """

    BENCH = "bench"
    SENSORS = "sensors"
    EITHER = "either"


def interleaved(count: int) -> tuple[slice, ...]:
    """The places of each of so many bearers among coefficients, or columns, that are theirs in turn; nothing of one
    bearer, which has all."""
    return tuple(slice(k, None, count) for k in range(count)) if count > 1 else ()


PAIRS = tuple(slice(k, k + 2) for k in (0, 2, 4))
"""The places of three bearers, each of which has two that follow each other."""


class Effect(ABC):
    """A physical effect the readings may contain besides the twelve parameters.

    unknown: a constant inside the columns; ``value`` is where it stands, and ``at(value)`` the effect with another.
    smooth: the columns change smoothly with it; where not it is no state, and is averaged over its likelihood.
    intensity: of the random walk (process noise) that the biases take, estimated by likelihood; None: they take none.
    dynamic: it shows in slews only, so these are evaluated too.
    oscillates: its columns may be faster than a piece of a dwell, so the dwells are folded on a carrier, and
    ``columns`` gives the part that the stimulus asks for (``Stimulus.part``).
    averages: vibration goes with it, so readings are averaged over windows first, and their variance in these is known.
    step: of ln(value) in the differences of ``derivative``.
    formulas: what an accelerometer reads more per unit of each coefficient that it has, of ``QUANTITIES``, ``before``
    and ``after`` (readings of the two other accelerometers, in their order) and ``constant``. Empty where it cannot be
    written so.
    typical: usual sizes of its coefficients. expected: the value that they have by nature, and how far they may be from
    it (sigma); None where nature does not say. family: the physical class to which it belongs.
    prior: how much likelier it is than another effect before anything is measured, 1 for most.
    borne_by: what can have it at all; what nobody knows, as of a user's effect, may be of either.
    symbols: of its coefficients, which have one unit (SI) and scale. shown: a unit of the field and how many of it make
    one SI unit, where it is not that of ``support.units``.
    bearers: the coefficients of each accelerometer, or of each axis of a rotation, where one of these may have the
    effect alone; empty where it is of all or none.
    drawn_against: the quantity over which what it adds to readings has a shape (``effects.axis``); None: what it adds.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    confused_with: ClassVar[str] = ""
    unknown: ClassVar[Unknown | None] = None
    smooth: ClassVar[bool] = True
    intensity: ClassVar[Coefficient | None] = None
    dynamic: ClassVar[bool] = False
    oscillates: ClassVar[bool] = False
    averages: ClassVar[bool] = False
    step: ClassVar[float] = 1e-4
    formulas: ClassVar[tuple[str, ...]] = ()
    typical: ClassVar[Typical] = Typical()
    expected: ClassVar[tuple[float, float] | None] = None
    family: ClassVar[str] = "none of the known"
    prior: ClassVar[float] = 1.0
    borne_by: ClassVar[Bearer] = Bearer.EITHER
    symbols: tuple[str, ...]
    unit: ClassVar[str]
    scale: ClassVar[float]
    shown: ClassVar[tuple[str, float] | None] = None
    bearers: tuple[slice, ...] = ()
    drawn_against: Regressor | None = None
    variant: str = ""
    """The axis of an axis-wise effect (``encoder-harmonic-2:z``)."""
    value: float = 0.0
    held: bool = False
    """Whether its unknown stays where it is: at an end of its range, beyond which the readings would have it."""

    def __str__(self) -> str:
        return f"{self.name}:{self.variant}" if self.variant else self.name

    def at(self, value: float) -> Self:
        """The same effect with its unknown at ``value``, held within its range."""
        other = copy.copy(self)
        if self.unknown is not None:
            other.value = float(min(max(value, self.unknown.low), self.unknown.high))
        return other

    def held_if_beyond(self, step: float) -> Self:
        """The same effect; its unknown is held if it is at an end of its range and ``step`` of ln(value) leads
        outwards, as of a warm-up so slow that it is a straight line in this run, or a lag too short to be seen."""
        assert self.unknown is not None
        other, known = copy.copy(self), self.unknown
        other.held = self.held or (self.value >= known.high if step > 0.0 else step < 0.0 and self.value <= known.low)
        return other

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Its coefficients: ``symbols``, all of one unit and scale."""
        shown = self.shown or field_unit(self.unit)
        return tuple(Coefficient(symbol, self.unit, self.scale, *shown) for symbol in self.symbols)

    @abstractmethod
    def columns(self, s: Stimulus) -> Floats:
        """What each accelerometer reads more per unit of each coefficient: (m, 3, q), m/s^2."""

    def added(self, s: Stimulus, coefficients: Floats) -> Floats:
        """What each accelerometer reads more with these ``coefficients`` (q,): (m, 3), m/s^2."""
        return self.columns(s) @ coefficients

    @property
    def parameters(self) -> tuple[Coefficient, ...]:
        """The parameters that state its size: its coefficients, or the intensity of a random walk."""
        return self.coefficients if self.intensity is None else (self.intensity,)

    @property
    def states(self) -> tuple[Coefficient, ...]:
        """The coefficients that are states: its own and, where that is one, its unknown."""
        unknown = self.unknown
        if unknown is None or not self.has_constant_in_state:
            return self.coefficients
        return *self.coefficients, Coefficient(unknown.symbol, unknown.unit, 1.0, unknown.shown_unit, unknown.per_si)

    @property
    def has_constant_in_state(self) -> bool:
        """Whether its unknown is estimated as a state: its columns have a derivative by it, and it is not held."""
        return self.unknown is not None and self.smooth and not self.held

    @property
    def relations(self) -> Sequence[Floats]:
        """Matrices (q, k), all as likely: the coefficients are one of them times k free numbers. Empty where they may
        have any values."""
        return ()

    @property
    def walks(self) -> bool:
        """Whether the biases take a random walk."""
        return self.intensity is not None

    @property
    def no_columns(self) -> str:
        """Why dwells show no columns of it, in words; empty where they do."""
        if self.dynamic:
            return "shows in slews only, which are not looked at here"
        return "is noise of the biases, not a column: fit it to see it" if self.walks else ""

    @property
    def scannable(self) -> bool:
        """Whether it shows in dwells at a coarse grid of its unknown: an oscillation needs its frequency, or a line."""
        return not (self.no_columns or self.oscillates)

    def shows_in(self, s: Stimulus) -> bool:
        """Whether it has columns in the part of a carrier that the stimulus asks for."""
        return not s.part or self.oscillates

    def grid(self, s: Stimulus) -> Floats:
        """Values of the unknown among which it is looked for first."""
        assert self.unknown is not None
        return self.unknown.grid()

    def log_share(self, s: Stimulus) -> float:
        """Log of the prior of the value of its constant in this run, over that of values that are its own: a time
        constant longer than it goes on without a break would be another effect's."""
        return -math.log(max(self.value / self.acts_for_s(s), 1.0)) if self.unknown is not None else 0.0

    def acts_for_s(self, s: Stimulus) -> float:
        """How long it goes on without a break."""
        return np.inf

    def edges(self, s: Stimulus) -> Floats:
        """Sorted values of an unknown that is not smooth, from its lowest to its highest: between two of them the
        columns are the same, or nearly so."""
        assert self.unknown is not None
        return self.unknown.grid(1.02)

    def reach(self, s: Stimulus) -> float:
        """How far from the truth ln(value) may be for its derivative to lead there: the width of the grid."""
        return 0.4

    def degeneracy(self, bench: Bench) -> str:
        """What the effect is exactly the same as on that bench, in words; empty where no such thing is known."""
        return ""

    def derivative(self, s: Stimulus, coefficients: Floats) -> Floats:
        """What each accelerometer reads more per unit of ln(value) with these ``coefficients`` (q,): (m, 3, 1).

        Central differences: the step leaves 1e-8 of it, and the iteration it serves ends where it no longer matters.
        """
        more, less = (self._free(self.value * factor).columns(s) for factor in (np.exp(self.step), np.exp(-self.step)))
        return ((more - less) @ coefficients / (2.0 * self.step))[:, :, None]

    def _free(self, value: float) -> Self:
        other = copy.copy(self)
        other.value = value
        return other


class SensorEffect(Effect):
    """One coefficient for each accelerometer; ``terms`` (m, 3) is what each reads more per unit of its own: that is its
    formula, unless a class computes it.

    symbol: of the coefficients, before the number of the accelerometer.
    on_data_sheet: words for it on a data sheet; empty where it is on none. in_polynomial: whether it is estimated there
    together with others of the model equation.
    """

    borne_by = Bearer.SENSORS
    bearers = interleaved(3)
    on_data_sheet: ClassVar[str] = ""
    in_polynomial: ClassVar[bool] = False
    symbol: ClassVar[str]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return _one_each(self.symbol, self.unit, self.scale, self.shown or field_unit(self.unit))

    def terms(self, s: Stimulus) -> Floats:
        formula = own_formula(self.formulas[0])
        values = {name: self.value if name == "constant" else QUANTITIES[name].of(s) for name in formula.names}
        return np.broadcast_to(formula(values), (len(s), 3))

    def columns(self, s: Stimulus) -> Floats:
        return of_each(np.broadcast_to(self.terms(s), (len(s), 3))[:, :, None])

    def added(self, s: Stimulus, coefficients: Floats) -> Floats:
        return self.terms(s) * coefficients


@functools.cache
def own_formula(text: str) -> Expression:
    """One of the ``formulas`` of an effect."""
    return Expression(text, dict.fromkeys((*QUANTITIES, "constant", "before", "after"), ""))


@functools.lru_cache(maxsize=512)
def _one_each(symbol: str, unit: str, scale: float, shown: tuple[str, float]) -> tuple[Coefficient, ...]:
    """Return a coefficient for each accelerometer."""
    return tuple(Coefficient(f"{symbol}{i}", unit, scale, *shown) for i in (1, 2, 3))


def of_each(terms: Floats) -> Floats:
    """Columns (m, 3, 3 k) of coefficients of which each accelerometer has k for itself: what it reads more per unit of
    its own is ``terms`` (m, 3, k)."""
    columns = np.zeros((len(terms), 3, *terms.shape[1:]))
    columns[:, range(3), range(3)] = terms
    return columns.reshape(len(terms), 3, -1)


@dataclass(frozen=True)
class KnownEffect:
    """An effect with its coefficients (q,) and their covariance (q, q), SI. It is subtracted from the readings, and
    that the coefficients are uncertain enlarges the covariance of what is estimated (Schmidt)."""

    effect: Effect
    coefficients: Floats
    covariance: Floats

    @property
    def sentence(self) -> str:
        """What has been done with it, in words without a full stop."""
        return f"{self.effect} of the bench is taken from the bench model: subtracted, and its sigma considered"

    @property
    def root(self) -> Floats:
        """A root (q, q) of the covariance: changes of the coefficients by one sigma in independent directions."""
        values, vectors = np.linalg.eigh(self.covariance)
        return vectors * np.sqrt(np.maximum(values, 0.0))
