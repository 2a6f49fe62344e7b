"""The measurement model: the change of each accelerometer's reading per unit of each state.

The states are the twelve that determine the paper's parameters, followed by the coefficients of effects.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import EXACT, Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.effects import Coefficient, Effect, RotationEffect, Stimulus, effect_named
from kf_calib.effects.effect import KnownEffect
from kf_calib.errors import InputError
from kf_calib.support.text import printed

if TYPE_CHECKING:  # a replay without a bench model does not import what reads one
    from kf_calib.estimation.bench_model import BenchModel

FRAME = tuple(4 * i + j for i, j in itertools.combinations(range(3), 2))
"""s1y, s1z, s2z: without angles the frame is that in which accelerometer 1 is x and 2 lies in the plane of x and y."""
SQUARE = {"nu1": 4, "phi3": 8, "theta3": 9}
"""s2x, s3x, s3y, by the angle that each is: by how much the axes are not square, in that frame."""


@dataclass(frozen=True)
class Model:
    """The twelve parameters and any effects. A model is immutable; + and - return a model with an effect more or
    less."""

    bench: Bench
    effects: tuple[Effect, ...] = ()
    square: tuple[str, ...] = ()
    """Without angles: the angles of ``SQUARE`` by which the input axes are taken for square to each other."""
    known: tuple[KnownEffect, ...] = ()
    """Effects whose coefficients are known, which the readings no longer contain (``without_known``)."""

    @classmethod
    def of(cls, bench: Bench, names: Iterable[str] = (), errors: BenchModel | None = None) -> Model:
        """The model with the effects of these names; errors: those of the bench that are known."""
        if errors is not None and not bench.angles:
            raise InputError("a bench model (--bench-model) is of angles, which --no-angles leaves out: omit one.")
        model = cls(bench, known=() if errors is None else errors.on(bench))
        for name in names:
            model += effect_named(name, bench)
        return model

    def __add__(self, effect: Effect) -> Model:
        """The model with one effect more; raises InputError if it, or one of its coefficients, is in the model
        already."""
        taken = {c.symbol: each for each in self.effects for c in each.states}
        if any(str(each) == str(effect) for each in self.effects):
            raise InputError(f"{effect} is in the model already: name it once, or take it out first.")
        for coefficient in effect.states:
            if coefficient.symbol in taken:
                raise InputError(
                    f"{effect} cannot be added: {taken[coefficient.symbol]} in the model already has the coefficient "
                    f"{coefficient.symbol}; take one of the two out."
                )
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, effect: Effect) -> Model:
        """The model without the effect of this name."""
        return replace(self, effects=tuple(each for each in self.effects if str(each) != str(effect)))

    def __str__(self) -> str:
        """A table of the symbols, their units and the size that a prior would call large."""
        return printed(self)

    @property
    def sum(self) -> str:
        """The model written as a sum of its parts, in one line."""
        return " + ".join(["twelve parameters", *map(str, self.effects)])

    @cached_property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """The coefficients of all effects, in the order of the state after the twelve; an effect's unknown constant
        follows its coefficients."""
        return tuple(coefficient for effect in self.effects for coefficient in effect.states)

    @cached_property
    def parts(self) -> dict[str, slice]:
        """The slice of the state that belongs to each effect, by name."""
        ends = np.cumsum([STATE_COUNT, *(len(effect.states) for effect in self.effects)]).tolist()
        return {str(effect): slice(a, b) for effect, (a, b) in zip(self.effects, itertools.pairwise(ends), strict=True)}

    @property
    def intensity(self) -> Coefficient | None:
        """The intensity of the random walk that the biases follow, or None if they follow none."""
        return next((effect.intensity for effect in self.effects if effect.intensity is not None), None)

    @property
    def walks(self) -> bool:
        """Whether an effect makes the biases follow a random walk."""
        return self.intensity is not None

    @property
    def dynamic(self) -> tuple[Effect, ...]:
        """The effects that appear in slews only."""
        return tuple(effect for effect in self.effects if effect.dynamic)

    @property
    def oscillation(self) -> Effect | None:
        """The effect that may oscillate within a piece of a dwell, so that dwells are folded on a carrier, or None."""
        return next((effect for effect in self.effects if effect.oscillates), None)

    @property
    def oscillates(self) -> bool:
        """Whether an effect may oscillate within a piece of a dwell."""
        return self.oscillation is not None

    @property
    def averages(self) -> bool:
        """Whether an effect needs averaged readings. Averaging would remove an oscillation together with the vibration,
        so this is False if the model has one."""
        return any(effect.averages for effect in self.effects) and not self.oscillates

    @property
    def unknowns(self) -> dict[int, Effect]:
        """The effects whose unknown constant is a state, by the index of that state."""
        return {self.parts[str(each)].stop - 1: each for each in self.effects if each.has_constant_in_state}

    @property
    def stepped(self) -> tuple[Effect, ...]:
        """The effects whose unknown constant has no derivative and is therefore not a state."""
        return tuple(each for each in self.constants_beside_state if not each.smooth)

    @property
    def constants_beside_state(self) -> tuple[Effect, ...]:
        """The effects whose unknown constant is no state: it has no derivative, or is held at an end of its range."""
        return tuple(each for each in self.effects if each.unknown and not each.has_constant_in_state)

    def moved(self, state: Floats) -> Model:
        """The model with each unknown constant multiplied by exp of its state in ``state`` (p,)."""
        moved = {str(each): each.at(each.value * math.exp(state[k])) for k, each in self.unknowns.items()}
        return replace(self, effects=tuple(moved.get(str(each), each) for each in self.effects))

    def held_at_ends(self, steps: Floats) -> tuple[Model, list[int]]:
        """The model with each unknown constant held that is at an end of its range and whose step, in steps (p,), leads
        outwards; and the states that these constants were."""
        held = {str(each): each.held_if_beyond(steps[k]) for k, each in self.unknowns.items()}
        model = replace(self, effects=tuple(held.get(str(each), each) for each in self.effects))
        return model, [k for k, each in self.unknowns.items() if held[str(each)].held]

    def with_effect(self, effect: Effect) -> Model:
        """The model in which this effect replaces the one of the same name."""
        return replace(self, effects=tuple(effect if str(each) == str(effect) else each for each in self.effects))

    def natural(self, state: Floats) -> tuple[Floats, Floats]:
        """Values (q,) of the effects' coefficients at ``state`` (p,), and the derivative (q,) of each by its state."""
        values, gains = state[STATE_COUNT:].copy(), np.ones(len(state) - STATE_COUNT)
        for k, effect in self.unknowns.items():
            values[k - STATE_COUNT] = effect.value * (1.0 + state[k])
            gains[k - STATE_COUNT] = effect.value
        return values, gains

    @property
    def count(self) -> int:
        """Number of states p."""
        return STATE_COUNT + len(self.coefficients)

    def nominal_state(self) -> Floats:
        """The state (p,) at nominal parameters and without effects."""
        twelve = paper_parameters.state_of(paper_parameters.nominal(self.bench.nominal))
        twelve[list(self.fixed)] = 0.0
        return np.concatenate([twelve, np.zeros(len(self.coefficients))])

    @property
    def fixed(self) -> tuple[int, ...]:
        """The states that are zero by convention: those of the frame where no angles are used, and those by which axes
        are taken for square."""
        return () if self.bench.angles else (*FRAME, *(SQUARE[angle] for angle in self.square))

    def columns(self, stimulus: Stimulus, state: Floats) -> Floats:
        """The design H (m, 3, p): the change of each accelerometer's reading per unit of each state, linearised at
        ``state`` (p,)."""
        design = np.zeros((len(stimulus), 3, self.count))
        for i in range(3) if not stimulus.part else ():
            design[:, i, 4 * i : 4 * i + 3] = stimulus.force_mps2
            design[:, i, 4 * i + 3] = 1.0
        for effect in self.effects:
            if not effect.shows_in(stimulus):
                continue
            part = self.parts[str(effect)]
            coefficients = slice(part.start, part.start + len(effect.coefficients))
            design[:, :, coefficients] = effect_columns([effect], stimulus)
            if coefficients.stop < part.stop:
                design[:, :, coefficients.stop : part.stop] = effect.derivative(stimulus, state[coefficients])
        design[:, :, list(self.fixed)] = 0.0
        return design

    def turned_rad(self, stimulus: Stimulus, state: Floats) -> Floats:
        """Rotation vectors (m, 3) by which the effects at ``state`` (p,) turn the specific force."""
        rotation_rad = np.zeros((len(stimulus), 3))
        for effect in self.effects:
            if isinstance(effect, RotationEffect) and effect.shows_in(stimulus):
                rotation_rad += effect.turned_rad(stimulus, state[self.parts[str(effect)]])
        return rotation_rad


def effect_columns(effects: Sequence[Effect], stimulus: Stimulus) -> Floats:
    """The change (m, 3, q) of each accelerometer's reading per unit of each coefficient of the effects."""
    counts = [len(each.coefficients) for each in effects]
    columns, last = np.zeros((len(stimulus), 3, sum(counts))), np.cumsum(counts).tolist()
    rounding_mps2 = EXACT * stimulus.bench.gravity_mps2
    for effect, end, count in zip(effects, last, counts, strict=True):
        if not effect.shows_in(stimulus):
            continue
        added, scales = effect.columns(stimulus), np.array([coefficient.scale for coefficient in effect.coefficients])
        # set to zero what even a large coefficient would not raise above rounding, as for the tilt of a vertical axis,
        # and what depends on an attitude that is not known (NaN), of which nothing can be seen
        columns[:, :, end - count : end] = np.where(np.abs(added) * scales >= rounding_mps2, added, 0.0)
    return columns
