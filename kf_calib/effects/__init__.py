"""The catalogue of physical effects: names, and how to make one.

Nothing outside this package knows an effect's name. A class listed here is found by the command line, both engines,
batch least squares, the views and the tests; so is one that a user registers (``effects.user``), and a formula
(``effects.formula``) wherever a name is asked for.
"""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from kf_calib.bench.bench import Bench
from kf_calib.effects import checks, drift, formula, frame, sensor, user
from kf_calib.effects.effect import Bearer, Coefficient, Effect, SensorEffect, Unknown
from kf_calib.effects.frame import RotationEffect
from kf_calib.effects.stimulus import Stimulus
from kf_calib.effects.user import Program
from kf_calib.errors import InputError

__all__ = [
    "Bearer", "Coefficient", "Effect", "RotationEffect", "SensorEffect", "Stimulus", "Unknown", "as_text", "described",
    "effect_named", "kind_of", "load_file", "loaded", "merged", "names", "of_the_users", "oscillation_of",
    "programs_of", "refuse_unfit", "refuse_unknown", "register", "remarks_of", "slew_effects", "walk_named",
]  # fmt: skip

_PLAIN: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        sensor.BiasAsymmetry, sensor.ScaleAsymmetry, sensor.SecondOrder, sensor.ThirdOrder, sensor.OddQuadratic,
        sensor.CrossCouplingIP, sensor.CrossCouplingIO, sensor.CrossCouplingPO, sensor.CrossAxisSquare,
        sensor.OutputSquare,
        sensor.VibrationRectification, sensor.DeadZone,
        drift.BiasDrift, drift.BiasWalk, drift.ScaleDrift, drift.WarmUp, drift.ScaleWarmUp, drift.Settling,
        drift.Hysteresis, drift.Memory, drift.Sinusoid,
        drift.ThermalBias, drift.ThermalBias2, drift.ThermalScale, drift.ThermalRate,
        drift.ThermalMisalignment, drift.ThermalLag, drift.ThermalHysteresis, drift.Magnetic,
        frame.BaseTilt, frame.BaseTiltDrift, frame.PlatformDrift, frame.GravityError,
        frame.EarthRotation, frame.Flexure, frame.UnevenFlexure, frame.CrossTalk, frame.Latency, frame.LeverArm,
    )
}  # fmt: skip
_OF_A_GIMBAL = {
    kind.name: kind
    for kind in (
        frame.EncoderOffset, frame.EncoderScale, frame.EncoderHarmonic1, frame.EncoderHarmonic2,
        frame.Backlash, frame.AxisNonorthogonality,
    )
}  # fmt: skip


@dataclass(frozen=True)
class _Registered:
    """A user's class; where it came from, in words and, if from a file, as that file; what its checks had to say."""

    kind: type[Effect]
    origin: str
    program: Program | None
    remarks: tuple[str, ...]


_registered: dict[str, _Registered] = {}


def names(bench: Bench) -> list[str]:
    """Every effect known that this bench can have: the catalogue's, axis-wise ones with their axis after a colon,
    then registered ones."""
    letters = formula.gimbal_letters(bench.axes)
    variants = [letter if letters.count(letter) == 1 else str(k + 1) for k, letter in enumerate(letters)]
    plain = [name for name in _PLAIN if name != frame.EarthRotation.name or bench.latitude_deg is not None]
    return [*plain, *(f"{name}:{variant}" for name in _OF_A_GIMBAL for variant in variants), *_registered]


def walk_named(bench: Bench) -> str:
    """The name of the effect that lets the biases walk."""
    kinds = (effect_named(name, bench) for name in names(bench) if ":" not in name)
    return next((str(effect) for effect in kinds if effect.walks), "")


def oscillation_of(bench: Bench) -> Effect | None:
    """The effect that oscillates, or None."""
    return next((each for each in (effect_named(name, bench) for name in names(bench)) if each.oscillates), None)


def slew_effects(bench: Bench) -> tuple[str, ...]:
    """Names of the effects that show in slews only."""
    return tuple(name for name in names(bench) if effect_named(name, bench).dynamic)


def effect_named(text: str, bench: Bench) -> Effect:
    """The effect of that name, or that ``NAME = FORMULA``; raises InputError, with near names, where there is none."""
    name, _, variant = text.partition(":")
    if "=" in text:
        return _formula(text, bench)
    if name in _PLAIN and not variant:
        return _PLAIN[name]()
    if name in _OF_A_GIMBAL and variant:
        letters = formula.gimbal_letters(bench.axes)
        return _OF_A_GIMBAL[name](frame.gimbal_number(variant, letters), variant)
    if text in _registered:
        return _registered[text].kind()
    raise _unknown(text, names(bench))


def kind_of(name: str) -> str:
    """The name of an effect without the gimbal that has it."""
    return name.partition(":")[0]


def described(text: str) -> Effect | None:
    """The effect of that name without a bench: its coefficients, units and usual sizes hold on every bench, its columns
    on none. None where no effect is known by that name, as for a formula."""
    name, _, variant = text.partition(":")
    if name in _OF_A_GIMBAL:
        return _OF_A_GIMBAL[name](0, variant)
    return _PLAIN[name]() if name in _PLAIN else _registered[text].kind() if text in _registered else None


def refuse_unknown(text: str) -> None:
    """Raise InputError where no bench whatever could have an effect of that name."""
    if "=" in text:
        formula.split(text)
        return
    known = [*_PLAIN, *_OF_A_GIMBAL, *_registered]
    if kind_of(text) not in known:
        raise _unknown(text, known)


def refuse_unfit(texts: Iterable[str], programs: Iterable[Program]) -> None:
    """Raise InputError for what is no effect, as far as that is known before the programs have run."""
    undefined = bool(list(programs))
    for text in texts:
        if "=" in text or not undefined:
            refuse_unknown(text)


def _unknown(text: str, known: list[str]) -> InputError:
    near = difflib.get_close_matches(text, known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else f"the catalogue has {', '.join(known)}."
    return InputError(f"no effect is called {text!r}: {hint}")


def _formula(text: str, bench: Bench) -> Effect:
    name = kind_of(formula.split(text)[0])
    origin = "the catalogue" if name in (*_PLAIN, *_OF_A_GIMBAL) else None
    origin = _registered[name].origin if name in _registered else origin
    if origin:
        raise InputError(
            f"{name} is the name of an effect of {origin}: call the formula otherwise, say my-{text.strip()}."
        )
    effect = formula.formula(text.strip(), bench.axes, bench.gravity_mps2)
    user.refuse_symbols(effect, _catalogue_symbols())
    return effect


@cache
def _catalogue_symbols() -> dict[str, str]:
    """Symbols of all coefficients and unknowns of the catalogue, with the effect each belongs to."""
    known = [kind() for kind in _PLAIN.values()]
    known += [kind(0, axis) for kind in _OF_A_GIMBAL.values() for axis in ("x", "y", "z", "1", "2", "3")]
    found = {coefficient.symbol: str(effect) for effect in known for coefficient in effect.coefficients}
    return found | {effect.unknown.symbol: str(effect) for effect in known if effect.unknown is not None}


def register(kind: type[Effect], origin: str = "this program", program: Program | None = None) -> type[Effect]:
    """Let a user's class into the catalogue, completed and checked; a decorator of it, too.

    Raises InputError, in one sentence, where its name or symbols are taken or a check fails.
    """
    kind = user.completed(kind, origin)
    name, known = kind.name, _registered.get(kind.name)
    if known is not None and known.kind is kind:
        return kind
    if name in _PLAIN or name in _OF_A_GIMBAL:
        raise InputError(
            f"{origin}: the catalogue already has an effect {name}: call this one otherwise, say my-{name}."
        )
    if known is not None:
        both = f"{origin} defines" if known.origin == origin else f"{known.origin} and {origin} both define"
        raise InputError(f"{both} an effect {name}: rename one of the two, or leave one out.")
    effect = user.instance_of(kind, origin)
    said = checks.check_effect(effect)
    user.refuse_symbols(effect, _catalogue_symbols())
    _registered[name] = _Registered(kind, origin, program, said)
    return kind


def load_file(path: Path) -> list[str]:
    """Run a Python file and register its effect classes; returns their names.

    A file that has changed since it was loaded replaces its classes; one that has not is not run again.
    """
    source = user.source_of(path)
    program = Program(path.resolve(), hashlib.sha256(source).hexdigest())
    before = {name: known.program for name, known in _registered.items() if known.program}
    before = {name: known for name, known in before.items() if known.path == program.path}
    if before and set(before.values()) == {program}:
        return list(before)
    _forget(program.path)
    try:
        return [register(kind, str(path), program).name for kind in user.classes_in(source, path)]
    except InputError:
        _forget(program.path)
        raise


def _forget(file: Path) -> None:
    for name in [name for name, known in _registered.items() if known.program and known.program.path == file]:
        del _registered[name]


def remarks_of(effect: Effect) -> tuple[str, ...]:
    """What the checks of a user's class or formula had to say of it, short of refusing it."""
    if isinstance(effect, formula.Formula):
        return effect.remarks
    known = _registered.get(str(effect))
    return known.remarks if known is not None else ()


def of_the_users(effect: Effect) -> bool:
    """Whether an effect is a formula or a class from outside, not one of the catalogue."""
    return isinstance(effect, formula.Formula) or str(effect) in _registered


def as_text(effect: Effect) -> str:
    """What ``effect_named`` makes the same effect of."""
    return effect.text if isinstance(effect, formula.Formula | formula.FrameFormula) else str(effect)


def programs_of(effects: Iterable[Effect]) -> list[Program]:
    """The user's files that classes of these effects came from, as they were run."""
    known = (_registered.get(str(effect)) for effect in effects)
    return list(dict.fromkeys(each.program for each in known if each is not None and each.program is not None))


def loaded(files: Iterable[Path]) -> list[Program]:
    """These files as they were run."""
    run = {known.program.path: known.program for known in _registered.values() if known.program}
    return list(dict.fromkeys(run[file.resolve()] for file in files))


def merged(first: Iterable[str], second: Iterable[str]) -> tuple[str, ...]:
    """Texts of effects, those of ``second`` left out that are in ``first``; spaces in formulas do not count."""
    first = tuple(first)
    there = {_bare(text) for text in first}
    return (*first, *(text for text in second if _bare(text) not in there))


def _bare(text: str) -> str:
    return "".join(text.split())
