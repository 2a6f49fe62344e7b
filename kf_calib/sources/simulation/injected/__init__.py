"""Hidden physical effects of the simulated bench: part of the truth, in the readings and in no recording's metadata.

    hidden = parse(["second-order=4e-5", "encoder-harmonic-2:z=2e-5", "warm-up=1e-4;tau=600"], axes)
    Simulation(bench, sensors, noise, plan, hidden=hidden)

Conventions, the same for every effect:

* SI throughout: contributions and accelerations in m/s^2, time in s since the first sample, temperature in K from the
  ``reference`` (25 degC unless told otherwise), angles in rad, magnetic flux density in T. A coefficient is what
  multiplies these: the K2 of ``second-order`` is in 1/(m/s^2), and K2 a_i^2 adds to the reading in m/s^2. A unit
  may be written after a number, ``second-order=4ug/g^2``, and is converted (``support.units.si``); g is 9.80665 m/s^2.
* a_i is the true specific force along the true input axis of accelerometer i, E_i . f; a_p and a_o are its parts along
  the platform axes of the nominal triads, (x, y, z), (y, z, x), (z, x, y). Contributions add to the reading as they
  are, not multiplied by the scale factor.
* One number is the size of every coefficient of the effect, with signs drawn from the seed where signs matter; as many
  numbers as coefficients are taken as they stand. A gimbal axis stands after a colon (its letter, its number from the
  outer one, ``outer`` or ``inner``); without one the effect is on every axis. Other constants follow after semicolons.
* A size may be given in sigma, ``second-order=10sigma``: n times what the noise of the run leaves uncertain, after what
  the twelve parameters absorb (``detectability``); ``parse`` then needs ``sized``, which knows the run.
* Size zero: the effect is absent, and the samples are bit for bit those of a run without it.

``gimbal`` (with surroundings), ``sensor`` (with temperature, time and history) and ``electronics`` hold the effects of
the catalogue, ``outside`` those that no catalogue knows. Nothing here is shared with an estimator.

``parse`` reads effects from the words of a command line.
"""

from __future__ import annotations

# Effects are registered when their module is imported; their steps stand in the chain in this order.
# isort: off
from kf_calib.sources.simulation.injected import gimbal, sensor, outside, electronics  # noqa: F401

# isort: on
import contextlib
import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from kf_calib.bench.bench import Vector
from kf_calib.errors import InputError, how_to_write
from kf_calib.sources.simulation.injected.kinds import INNER_CONSTANTS, EffectKind, Hidden, NoSizeError, catalogue
from kf_calib.sources.simulation.sensors import generator
from kf_calib.support.units import si

RANDOM = {"random": (True, False), "random-known": (True,), "random-unknown": (False,)}
"""What may be drawn: effects that are in the catalogue of the diagnosis (True), and those that are not."""

Sizer = Callable[[Hidden, float], Hidden]
"""Makes an effect so many sigma large, all coefficients times one number; raises NoSizeError where none does."""

_DRAWS = 100


def parse(
    texts: Iterable[str],
    axes: Sequence[Vector],
    *,
    seed: int = 0,
    grade: str = "navigation",
    sized: Sizer | None = None,
) -> list[Hidden]:
    """Effects from texts ``NAME[:AXIS]=SIZE[,SIZE...][;CONSTANT=VALUE...]``, or ``random[=SIZE]``.

    axes: of the gimbals. seed: of the signs where one size is given, and of what ``random`` draws, an effect with
    sizes typical of the grade: ``random-known`` one of the catalogue of the diagnosis, ``random-unknown`` another.
    sized: takes sizes in sigma, which need to know the run; ``random`` with one draws until an effect can have it.
    Examples: ``second-order=4e-5``, ``second-order=4ug/g^2,0,0``, ``second-order=10sigma``, ``random=10sigma``,
    ``encoder-harmonic-2:z=2e-5``, ``warm-up=1e-4;tau=600``.
    """
    effects = list[Hidden]()
    for number, text in enumerate(texts):
        pool, equals, size = (part.strip() for part in text.partition("="))
        if pool in RANDOM:
            resized = _resizing(_sigmas(size), sized)
            if equals and resized is None:
                raise InputError(f"{pool} takes a size in sigma or none, not {size!r}: write {pool}=10sigma or {pool}.")
            taken = {effect.name for effect in effects}
            effects.append(_drawn(RANDOM[pool], axes, seed, number, grade, taken, resized))
        else:
            effects += _read(text, axes, seed, grade, sized)
    names = [effect.name for effect in effects]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"hidden effect {twice[0]!r} is given twice: give it once, with all its sizes.")
    return effects


def axis_names(axes: Sequence[Vector]) -> list[str]:
    """A name for each gimbal axis: its letter where it alone lies along x, y or z; else its number from 1."""
    letters = ["xyz"[int(np.argmax(np.abs(axis)))] if np.count_nonzero(axis) == 1 else "" for axis in axes]
    return [
        letter if letter and letters.count(letter) == 1 else str(number)
        for number, letter in enumerate(letters, start=1)
    ]


def _sigmas(text: str) -> float | None:
    """n of ``n sigma``; None of a text that is no such size."""
    number, word, _ = text.partition("sigma")
    if not word:
        return None
    try:
        sigmas = float(number) if text.strip().endswith(word) else math.nan
    except ValueError:
        sigmas = math.nan
    if not 0.0 < sigmas < math.inf:
        raise InputError(
            f"{text.strip()!r} is no size in sigma: give one positive number, for example 10sigma{how_to_write(text)}."
        )
    return sigmas


def _resizing(sigmas: float | None, sized: Sizer | None) -> Callable[[Hidden], Hidden] | None:
    """What makes an effect ``sigmas`` large; None where no size in sigma is given."""
    if sigmas is None:
        return None
    if sized is None:
        raise InputError(f"a size of {sigmas:g} sigma needs a run to be worked out on: give a size with a unit.")
    return lambda effect: sized(effect, sigmas)


def _read(text: str, axes: Sequence[Vector], seed: int, grade: str, sized: Sizer | None) -> list[Hidden]:
    head, *constants = text.split(";")
    label, equals, numbers = head.partition("=")
    name, colon, axis = (part.strip() for part in label.partition(":"))
    if not equals or not numbers.strip():
        raise InputError(f"hidden effect {text!r} has no size: write NAME=SIZE, for example second-order=4e-5.")
    kind = _kind(name)
    if colon and not kind.per_axis:
        raise InputError(f"{name} belongs to no gimbal axis: leave out {':' + axis!r}.")
    resized = _resizing(_sigmas(numbers), sized)
    given = [math.sqrt(math.prod(kind.typical(grade)))] if resized else _given(numbers)
    inner = _inner(kind, constants)
    if kind.per_axis:
        chosen, names = _axes_meant(axis, axes), axis_names(axes)
        effects = [Hidden(kind, _sizes(kind, given, seed, f"{name} {k}"), inner, k, names[k]) for k in chosen]
    else:
        effects = [Hidden(kind, _sizes(kind, given, seed, name), inner)]
    return [resized(effect) for effect in effects] if resized else effects


def _given(text: str) -> list[float]:
    """Sizes in SI; where one has a unit all have one, but for zeros: 4,1arcsec is no 4 rad and 1 arcsec."""
    words = [word.strip() for word in text.split(",")]
    sizes, bare = [si(word) for word in words], [word[-1:] in "0123456789." for word in words]
    if not all(bare) and any(alone and size for alone, size in zip(bare, sizes, strict=True)):
        raise InputError(f"{text.strip()!r} has sizes with a unit and without: give each its unit{how_to_write(text)}.")
    return sizes


def _kind(name: str) -> EffectKind:
    if name in catalogue():
        return catalogue()[name]
    near = difflib.get_close_matches(name, [*catalogue(), *RANDOM], n=3, cutoff=0.4)
    advice = f"did you mean {' or '.join(near)}?" if near else f"use one of {', '.join(catalogue())}."
    raise InputError(f"hidden effect {name!r} is not known: {advice}")


def _sizes(kind: EffectKind, given: Sequence[float], seed: int, quantity: str) -> tuple[float, ...]:
    """Sizes of all coefficients; one number stands for all, with signs drawn where they matter."""
    count = len(kind.coefficients)
    if not kind.signed and min(given) < 0.0:
        raise InputError(f"{kind.name} of {min(given):g} {kind.unit} is not possible: give zero or a positive number.")
    if len(given) == count:
        return tuple(given)
    if len(given) > 1:
        words, point = ", ".join(kind.coefficients), ", and decimals with a point" if len(given) == 2 else ""
        raise InputError(
            f"{kind.name} has {count} coefficients ({words}), {len(given)} are given: give 1 or {count}{point}."
        )
    signs = generator(seed, f"hidden signs {quantity}").choice([-1.0, 1.0], count) if kind.signed else np.ones(count)
    return tuple((given[0] * signs + 0.0).tolist())


def _inner(kind: EffectKind, texts: Iterable[str]) -> dict[str, float]:
    values = dict[str, float]()
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if name not in kind.inner:
            words = ", ".join(kind.inner) or "none"
            raise InputError(f"{kind.name} has no constant {name!r}: it has {words}.")
        values[name] = si(value)
        if INNER_CONSTANTS[name].positive and values[name] <= 0.0:
            raise InputError(f"{name} of {kind.name} is {values[name]:g}: give a positive number.")
    return values


def _axes_meant(word: str, axes: Sequence[Vector]) -> list[int]:
    """Which gimbal axes a word names; no word: every one."""
    if not word:
        return list(range(len(axes)))
    names = axis_names(axes)
    meanings: Mapping[str, int] = {
        "outer": 0,
        "inner": len(axes) - 1,
        **{str(number): number - 1 for number in range(1, len(axes) + 1)},
        **{name: number for number, name in enumerate(names)},
    }
    if word not in meanings:
        raise InputError(f"gimbal axis {word!r} is not known: use {', '.join(names)}, outer or inner.")
    return [meanings[word]]


def _drawn(
    known: Sequence[bool],
    axes: Sequence[Vector],
    seed: int,
    number: int,
    grade: str,
    taken: set[str],
    resized: Callable[[Hidden], Hidden] | None,
) -> Hidden:
    """An effect that is not ``taken`` and, where a size in sigma is asked for, can have it."""
    rng = generator(seed, f"hidden random {number}")
    kinds = [kind for kind in catalogue().values() if kind.known in known]
    for _ in range(_DRAWS):
        effect = _draw(rng, kinds, axes, grade)
        if effect.name in taken:
            continue
        with contextlib.suppress(NoSizeError):
            return resized(effect) if resized else effect
    raise InputError("no effect that was drawn can be seen with these orientations: give one by name, with a unit.")


def _draw(rng: np.random.Generator, kinds: Sequence[EffectKind], axes: Sequence[Vector], grade: str) -> Hidden:
    """An effect: kind and axis evenly, sizes and constants evenly in their logarithm."""
    kind = kinds[int(rng.integers(len(kinds)))]
    axis = int(rng.integers(len(axes))) if kind.per_axis else 0
    size = float(np.exp(rng.uniform(*np.log(kind.typical(grade)))))
    signs = rng.choice([-1.0, 1.0], len(kind.coefficients)) if kind.signed else np.ones(len(kind.coefficients))
    inner = {
        name: value * float(2.0 ** rng.uniform(-1.0, 1.0)) if INNER_CONSTANTS[name].free else value
        for name, value in kind.inner.items()
    }
    axis_name = axis_names(axes)[axis] if kind.per_axis else ""
    return Hidden(kind, tuple((size * signs).tolist()), inner, axis, axis_name)
