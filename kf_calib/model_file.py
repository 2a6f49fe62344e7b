"""Model files: the effects of a model as TOML, to keep and to share.

    effects = ["bend", "mine = fx*fy*T"]
    effects_from = ["my_effects.py"]        # files of a user's own classes, relative to this one

    [[coefficients]]                        # what the run it was saved from found; for people, read by nobody
    symbol = "mine1"
    value = 1.2e-7
    sigma = 3.0e-9
    unit = "s^2/m/K"

A file under ``effects_from`` is a program, and reading the model runs it: look at it first where it came from others.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kf_calib import effects
from kf_calib.calibration import Calibration
from kf_calib.errors import InputError
from kf_calib.outputs import write_whole

_KEYS = ("effects", "effects_from", "coefficients")


@dataclass(frozen=True)
class ModelFile:
    """What a model file says: texts of effects, paths of files that define some of them."""

    effects: tuple[str, ...]
    effects_from: tuple[Path, ...] = ()


def read(path: Path) -> ModelFile:
    """Read a model file, load the classes it needs, and see that its effects exist.

    Raises InputError, with the path, where the file cannot be read or used.
    """
    table = table_of(path)
    for key in table:
        if key not in _KEYS:
            near = difflib.get_close_matches(key, _KEYS, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(_KEYS)}."
            raise InputError(f"{path}: has a key {key!r}, which no model has: {hint}")
    if "effects" not in table:
        raise InputError(f'{path}: names no effects: write a line such as effects = ["NAME", "mine = a*T"].')
    found = ModelFile(
        _texts(path, table, "effects"), tuple(path.parent / text for text in _texts(path, table, "effects_from"))
    )
    try:
        for file in found.effects_from:
            effects.load_file(file)
        for text in found.effects:
            effects.refuse_unknown(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return found


def table_of(path: Path) -> dict[str, Any]:
    """The content of a TOML file; raises InputError, with the path, where it cannot be read."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f'{path}: is not TOML ({error}); write lines such as effects = ["NAME"].') from None


def _texts(path: Path, table: dict[str, Any], key: str) -> tuple[str, ...]:
    value = table.get(key, [])
    if not (isinstance(value, list) and all(isinstance(text, str) for text in value)):
        raise InputError(f'{path}: {key} must be a list of texts, such as {key} = ["..."].')
    return tuple(value)


def write(path: Path, result: Calibration) -> None:
    """Write the model of a result with what was found for its coefficients; the file is whole or not there.

    A file of that name is replaced. Raises InputError where it cannot be written.
    """
    own = result.model.effects
    table: dict[str, Any] = {"effects": [effects.as_text(effect) for effect in own]}
    if files := effects.files_of(own):
        table["effects_from"] = [_relative(file, path) for file in files]
    if found := list(_coefficients(result)):
        table["coefficients"] = found
    write_whole(path, _toml(table))


def _toml(table: dict[str, Any]) -> bytes:
    import tomli_w

    return ("# Model of kf_calib: kf-calib replay RECORDING --model THIS_FILE\n" + tomli_w.dumps(table)).encode()


def _coefficients(result: Calibration) -> Iterable[dict[str, Any]]:
    """Symbol, value, sigma and unit of all but the twelve; without value and sigma where they were not seen."""
    twelve = len(result.estimate.parameters)
    for parameter in list(result.parameters.values())[twelve:]:
        seen = {"value": parameter.value, "sigma": parameter.sigma} if parameter.value is not None else {}
        yield {"symbol": parameter.symbol, **seen, "unit": parameter.unit}


def _relative(file: Path, path: Path) -> str:
    try:
        return Path(os.path.relpath(file, path.resolve().parent)).as_posix()
    except ValueError:  # another drive
        return file.as_posix()
