"""What a hidden effect is: a kind, known by its name, and its sizes on one bench. The registry of kinds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, Vector
from kf_calib.errors import InputError
from kf_calib.sources.simulation.physics import TrueState, TrueStep, adding
from kf_calib.sources.simulation.sensors import Sensors, generator
from kf_calib.sources.simulation.visit_plans import Motion
from kf_calib.support.units import si

Stage = Literal["angles", "attitude", "force", "input", "reading", "record"]
"""Where in the chain a step stands: it changes the true gimbal angles and axes, the attitude, the specific force in the
platform, the acceleration along the input axes, the readings before noise, the readings as they are recorded."""

SENSORS = ("1", "2", "3")
TypicalSizes = tuple[str, str]
"""Typical ones of an effect, from ... to, in units of data sheets."""


class NoSizeError(InputError):
    """An effect has no size in sigma in this run."""


@dataclass(frozen=True)
class SimulatedBench:
    """The bench an effect is at work on."""

    bench: Bench
    axes: Sequence[Vector]
    sensors: Sensors
    motion: Motion
    period_s: float  # between readings
    duration_s: float
    seed: int

    def generator(self, name: str) -> np.random.Generator:
        """Random numbers of one effect, apart from those of anything else."""
        return generator(self.seed, f"hidden {name}")


@dataclass(frozen=True)
class InnerConstant:
    """A constant of an effect beside its coefficients. free: ``random`` draws it within a factor of 2."""

    unit: str
    positive: bool = True
    free: bool = True


INNER_CONSTANTS: Mapping[str, InnerConstant] = {
    "tau": InnerConstant("s"),
    "slow": InnerConstant("s"),
    "period": InnerConstant("s"),
    "frequency": InnerConstant("Hz"),
    "chirp": InnerConstant("Hz/s"),
    "rms": InnerConstant("m/s^2"),
    "rate": InnerConstant("1"),
    "share": InnerConstant("1"),
    "cx": InnerConstant("1"),
    "cy": InnerConstant("1"),
    "cz": InnerConstant("1"),
    "play": InnerConstant("K", free=False),
    "phase": InnerConstant("rad", positive=False),
    "threshold": InnerConstant("m/s^2", free=False),
    "reference": InnerConstant("degC", positive=False, free=False),
    "latitude": InnerConstant("rad", positive=False, free=False),
    "north": InnerConstant("T", positive=False, free=False),
    "up": InnerConstant("T", positive=False, free=False),
    "east": InnerConstant("T", positive=False, free=False),
}
"""Names of constants and what they are."""


@dataclass(frozen=True)
class EffectKind:
    """A kind of effect.

    unit: of a coefficient. navigation, mems: typical sizes of these grades. make: (coefficients, bench, gimbal axis if
    ``per_axis``, inner constants) -> step. stage: where in the chain it stands. coefficients: their names, one for each
    size. signed: false where one cannot be negative. known: it is in the catalogue of the diagnosis. counted: makes
    the part that counts to its size in sigma, where something comes with the effect whatever its size. driver: of an
    effect outside the catalogue, the quantity it goes with. family: of an effect outside the catalogue, the physical
    class to which it belongs; that of an effect of the catalogue is told there.
    """

    name: str
    unit: str
    navigation: TypicalSizes
    mems: TypicalSizes
    make: Callable[..., TrueStep] = field(repr=False)
    inner: Mapping[str, float]
    title: str
    physics: str
    stage: Stage = "reading"
    coefficients: tuple[str, ...] = SENSORS
    signed: bool = True
    per_axis: bool = False
    known: bool = True
    counted: Callable[..., TrueStep] | None = field(default=None, repr=False)
    driver: str = ""
    family: str = ""

    def typical(self, grade: str) -> tuple[float, float]:
        """Typical sizes, least and greatest, in SI; the paper's sensors are of navigation grade."""
        least, greatest = self.mems if grade == "mems" else self.navigation
        return si(least), si(greatest)


@dataclass(frozen=True)
class Hidden:
    """An effect with its sizes, one for each coefficient of its kind, in SI.

    axis: of the gimbals, 0 is the outer one; axis_name: as people call it.
    """

    kind: EffectKind
    sizes: tuple[float, ...]
    inner: Mapping[str, float] = field(default_factory=dict[str, float])
    axis: int = 0
    axis_name: str = ""

    @property
    def name(self) -> str:
        return f"{self.kind.name}:{self.axis_name}" if self.axis_name else self.kind.name

    @property
    def truth(self) -> dict[str, Any]:
        """For the side file."""
        return {
            "name": self.name,
            "in_catalogue": self.kind.known,
            "driver": self.kind.driver,
            "family": self.kind.family,
            "unit": self.kind.unit,
            "sizes": dict(zip(self.kind.coefficients, self.sizes, strict=True)),
            "inner": {
                name: {"value": value, "unit": INNER_CONSTANTS[name].unit} for name, value in self._inner.items()
            },
            "physics": self.kind.physics,
        }

    def scaled(self, factor: float) -> Hidden:
        """The same with every coefficient times a number."""
        return replace(self, sizes=tuple(factor * size for size in self.sizes))

    def step(self, simulated: SimulatedBench) -> TrueStep:
        """The step in the chain, fresh from its start."""
        axis = (self.axis,) if self.kind.per_axis else ()
        return self.kind.make(np.array(self.sizes), simulated, *axis, **self._inner)

    @property
    def counted(self) -> Hidden:
        """Of it, what counts to its size in sigma."""
        return self if self.kind.counted is None else replace(self, kind=replace(self.kind, make=self.kind.counted))

    @property
    def _inner(self) -> dict[str, float]:
        return {**self.kind.inner, **self.inner}


_KINDS: dict[str, EffectKind] = {}


def catalogue() -> Mapping[str, EffectKind]:
    """Every kind by name, in the order in which they are at work."""
    return _KINDS


def steps_of(effects: Iterable[Hidden], simulated: SimulatedBench) -> dict[Stage, list[TrueStep]]:
    """The steps of those effects that are not of size zero, by stage, in the order of the catalogue."""
    order = list(_KINDS)
    present = [effect for effect in effects if any(effect.sizes)]
    steps: dict[Stage, list[TrueStep]] = {stage: [] for stage in get_args(Stage)}
    for effect in sorted(present, key=lambda effect: order.index(effect.kind.name)):
        steps[effect.kind.stage].append(effect.step(simulated))
    return steps


def made(
    name: str, unit: str, navigation: TypicalSizes, mems: TypicalSizes | None = None, **facts: Any
) -> Callable[[Callable[..., TrueStep]], Callable[..., TrueStep]]:
    """Registers a maker of steps; facts: further fields of its kind. Its docstring is "Title: physics (source)."; its
    keyword-only arguments are the inner constants with their usual values."""

    def register(make: Callable[..., TrueStep]) -> Callable[..., TrueStep]:
        assert name not in _KINDS, name
        title, _, physics = " ".join((make.__doc__ or "").split()).partition(": ")
        parameters = inspect.signature(make).parameters.values()
        inner = {item.name: float(item.default) for item in parameters if item.kind is item.KEYWORD_ONLY}
        _KINDS[name] = EffectKind(name, unit, navigation, mems or navigation, make, inner, title, physics, **facts)
        return make

    return register


def added(
    name: str, unit: str, navigation: TypicalSizes, mems: TypicalSizes | None = None, **facts: Any
) -> Callable[[Callable[..., Floats]], Callable[..., Floats]]:
    """Registers what adds to each reading, a function of three coefficients, the state and inner constants."""

    def register(contribution: Callable[..., Floats]) -> Callable[..., Floats]:
        def make(k: Floats, simulated: SimulatedBench, **inner: float) -> TrueStep:
            return adding(lambda state: contribution(k, state, **inner))

        make.__doc__ = contribution.__doc__
        make.__signature__ = inspect.signature(contribution)  # shows the inner constants
        made(name, unit, navigation, mems, **facts)(make)
        return contribution

    return register


def pendulous(state: TrueState) -> Floats:
    """a_p of the three accelerometers: platform y, z, x."""
    return state.force_mps2[:, [1, 2, 0]]


def output(state: TrueState) -> Floats:
    """a_o of the three accelerometers: platform z, x, y."""
    return state.force_mps2[:, [2, 0, 1]]


def above(state: TrueState, reference_c: float) -> Floats:
    """T (n, 1), the true temperature above the reference."""
    return column(state.temperature_c - reference_c)


def column(values: Floats) -> Floats:
    """One value a sample (n,) as a column (n, 1)."""
    return values[:, None]
