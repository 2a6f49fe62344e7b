"""Effects from outside: classes in a Python file of the user's.

A file needs no more than this (ten lines at most)::

    from kf_calib.effects import SensorEffect

    class Mine(SensorEffect):
        unit = "s^2/m/K"

        def terms(self, s):
            return s.along**2 * s.warmth[:, None]

What a class leaves out is filled in: name ``mine``, title, source ``user``, symbols ``mine1 mine2 mine3``, scale 1, and
the unit of the field that it is shown in (``support.units``). Reading such a file runs it, as Python runs any module.

Python files that a model file names: the classes of effects it needs are in them.

Loading such a file runs it, and whoever wrote it can then do all that the user can. Files from others are therefore
only loaded where the user named the file himself, or says that he trusts what came with it.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from kf_calib.effects import checks
from kf_calib.effects.effect import Bearer, Effect, SensorEffect
from kf_calib.effects.formula import NAME_RULE, is_name, symbol_stem
from kf_calib.effects.frame import RotationEffect
from kf_calib.errors import InputError
from kf_calib.support.text import listing

TWELVE = frozenset(f"{stem}{i}" for stem in ("theta", "phi", "nu", "K", "b") for i in (1, 2, 3))
"""Symbols of the paper's parameters, one or two of them never used: no effect may have them."""


def source_of(path: Path) -> bytes:
    """The text of a Python file; raises InputError where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): give a Python file of effect classes.") from None


def classes_in(source: bytes, path: Path) -> list[type[Effect]]:
    """The effect classes that the text of a Python file defines, in its order.

    Raises InputError where it cannot be run or has none.
    """
    # run from its text: nothing is written beside the user's file, and an old compiled copy is never taken for it
    module = ModuleType(f"kf_calib_user_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        with contextlib.redirect_stdout(sys.stderr):  # stdout may be one JSON object
            exec(compile(source, str(path), "exec", dont_inherit=True), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise InputError(
            f"{path}{checks.line_in(error, str(path))}: cannot be run ({checks.error_words(error)}): mend it there."
        ) from None
    classes = effect_classes(module)
    if not classes:
        raise InputError(
            f"{path}: defines no effect: write a class that derives from SensorEffect, RotationEffect or Effect "
            "(from kf_calib.effects import SensorEffect)."
        )
    return classes


def effect_classes(module: ModuleType) -> list[type[Effect]]:
    """Classes of effects defined in a module, but for those whose name begins with an underscore."""
    return [
        kind
        for name, kind in vars(module).items()
        if inspect.isclass(kind)
        and issubclass(kind, Effect)
        and kind.__module__ == module.__name__
        and not name.startswith("_")
    ]


def completed(kind: type[Effect], origin: str) -> type[Effect]:
    """The class with what it left out; raises InputError where that cannot be filled in."""
    who = f"class {kind.__name__} of {origin}"
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    if issubclass(kind, SensorEffect):
        missing += ["terms"] if kind.terms is SensorEffect.terms and not kind.formulas else []
    elif kind.coefficients in (Effect.coefficients, RotationEffect.coefficients) and not hasattr(kind, "symbols"):
        missing = ["coefficients", *missing]
    if missing:
        raise InputError(f"{who} lacks {listing(missing)}: define {'it' if len(missing) == 1 else 'them'}.")
    given = getattr(kind, "name", None)
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", kind.__name__).lower() if given is None else given
    if not (isinstance(name, str) and is_name(name)):
        raise InputError(f"{who} is called {name!r}: a name is made of {NAME_RULE}.")
    defaults: dict[str, object] = {"name": name, "title": name, "source": "user", "unit": "SI", "scale": 1.0}
    if issubclass(kind, SensorEffect):
        defaults["symbol"] = symbol_stem(name)
    for key, value in defaults.items():
        if not hasattr(kind, key):
            setattr(kind, key, value)
    said_by = next(each for each in kind.__mro__ if "borne_by" in vars(each))
    if said_by in (SensorEffect, RotationEffect):  # the shape of its columns does not say what has it
        kind.borne_by = Bearer.EITHER
    checks.guard(kind)
    return kind


def instance_of(kind: type[Effect], origin: str) -> Effect:
    """An effect of the class; raises InputError where it cannot be made without arguments."""
    try:
        return kind()
    except Exception as error:
        raise InputError(
            f"class {kind.__name__} of {origin} cannot be made without arguments"
            f"{checks.line_of(error, kind)} ({checks.error_words(error)}): give those of __init__ default values."
        ) from None


def refuse_symbols(effect: Effect, taken: dict[str, str]) -> None:
    """Raise InputError where a symbol of the effect is one of the twelve parameters' or ``taken`` by another effect."""
    symbols = [coefficient.symbol for coefficient in effect.coefficients]
    symbols += [effect.unknown.symbol] if effect.unknown is not None else []
    for symbol in symbols:
        owner = "the twelve parameters" if symbol in TWELVE else taken.get(symbol)
        if owner:
            raise InputError(
                f"{effect} would have a coefficient {symbol}, which is one of {owner}: give it another name."
            )


_LARGEST_BYTES = 10_000_000


@dataclass(frozen=True)
class Program:
    """A Python file; sha256: of its content when the model was saved, empty where that is not known."""

    path: Path
    sha256: str = ""


@dataclass(frozen=True)
class Allowed:
    """files: what may be loaded. changes: what is not as it was when it was saved, a sentence each."""

    files: tuple[Path, ...] = ()
    changes: tuple[str, ...] = ()


def allowed(origin: Path, programs: Sequence[Program], named: Sequence[Path], trust: bool) -> Allowed:
    """The files to load for the programs of ``origin``; nothing is run.

    named: files that the user named; one of them stands for a program where it is the same file or has the same
    content. trust: whether the others may be run as well. Raises InputError, with what would run, where they may not.
    """
    places = {path.resolve(): path for path in named}
    contents = {sha256_of(path): path for path in named} if programs else {}
    files, changes = list[Path](), list[str]()
    for program in programs:
        now = _sha256_if_there(program.path)
        file = places.get(program.path.resolve()) or contents.get(now) or contents.get(program.sha256)
        if file is None and not (trust and now):
            raise _refusal(origin, program, now)
        files.append(file or program.path)
        content = sha256_of(file) if file else now
        if program.sha256 not in ("", content):
            changes.append(
                f"{origin}: {files[-1]} has changed since it was saved (SHA-256 {program.sha256} then, {content} now), "
                "so results may differ."
            )
    return Allowed(tuple(files), tuple(changes))


def _refusal(origin: Path, program: Program, now: str) -> InputError:
    if not now:
        return InputError(
            f"{origin}: needs the Python file {program.path.resolve()}, which cannot be read: put it there, or name a "
            "copy of it by --effects-from."
        )
    saved = "" if program.sha256 in ("", now) else f"; when it was saved, {program.sha256}"
    return InputError(
        f"{origin}: would run the Python file {program.path.resolve()} (SHA-256 {now}{saved}), which can do all that "
        "you can: read it, then name it by --effects-from, or allow what this file names by --trust."
    )


def sha256_of(path: Path) -> str:
    """Raises InputError where the file cannot be read."""
    sha256 = _sha256_if_there(path)
    if not sha256:
        raise InputError(f"{path}: cannot be read: give a Python file of effect classes.")
    return sha256


def _sha256_if_there(path: Path) -> str:
    """Of a regular file of a sane size, which a device or a pipe is not; empty for anything else."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST_BYTES:
            return ""
        with path.open("rb") as file:
            return hashlib.sha256(file.read(_LARGEST_BYTES)).hexdigest()
    except (OSError, ValueError):
        return ""
