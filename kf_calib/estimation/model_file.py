"""Model files: the effects of a model as TOML, to keep and to share.

    effects = ["bend", "mine = fx*fy*T"]
    effects_from = ["my_effects.py"]        # files that define a user's own effects, relative to this one

    [sha256]                                # checksums of these files when the model was saved
    "my_effects.py" = "4f0e..."

    [[coefficients]]                        # estimates of the run; for information only, not read
    symbol = "mine1"
    value = 1.2e-7
    sigma = 3.0e-9
    unit = "s^2/m/K"

A file under ``effects_from`` is a program. Reading a model runs none; ``ModelFile.load`` runs those that it may::

    model = model_file.read_model_file("model.toml")
    model.load(named=["my_effects.py"])     # or trust=True, to run all files that the model names
    calibrate("run.mcap", Settings(effects=model.effects))
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired

from pydantic import StringConstraints
from typing_extensions import TypedDict

from kf_calib import effects
from kf_calib.effects.programs import Allowed, Program, allowed
from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.support.output_files import write_whole
from kf_calib.support.plain_text import cut
from kf_calib.support.toml_files import FINITE, TEXT, Misfit, converted, toml_table

_EXAMPLE = 'effects = ["NAME", "mine = a*T"]'
_Path = Annotated[str, StringConstraints(min_length=1, max_length=4096, pattern=r"\A[^\x00]*\z")]


class _Content(TypedDict):
    """The content of a model file."""

    effects: list[TEXT]
    effects_from: NotRequired[list[_Path]]
    sha256: NotRequired[dict[_Path, TEXT]]
    coefficients: NotRequired[list[dict[str, str | FINITE]]]


_KEYS = tuple(_Content.__annotations__)


@dataclass(frozen=True)
class ModelFile:
    """The content of a model file: the texts of effects and the Python files that define some of them."""

    path: Path
    effects: tuple[str, ...]
    programs: tuple[Program, ...] = ()

    def allowed(self, named: Sequence[Path] = (), trust: bool = False) -> Allowed:
        """The Python files that may be run for this model: those named, or all with ``trust``. Raises InputError."""
        return allowed(self.path, self.programs, named, trust)

    def load(self, named: Sequence[str | Path] = (), trust: bool = False) -> tuple[str, ...]:
        """Run these Python files, check that all effects exist, and return what has changed since the model was saved.

        Raises InputError, with the path, if a file may not be run or cannot be used.
        """
        allowed = self.allowed([Path(name) for name in named], trust)
        with _telling(self.path):
            for file in allowed.files:
                effects.load_file(file)
            for text in self.effects:
                effects.refuse_unknown(text)
        return allowed.changes


def read_model_file(path: str | Path) -> ModelFile:
    """Read a model file and check what can be checked before the Python files that it names are run.

    Raises InputError, with the path, if the file cannot be read or used.
    """
    path = Path(path)
    table = toml_table(path, _EXAMPLE)
    for key in table:
        if key not in _KEYS:
            near = difflib.get_close_matches(key, _KEYS, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(_KEYS)}."
            raise InputError(f"{path}: has a key {cut(key, 60)!r}, which no model has: {hint}")
    if "effects" not in table:
        raise InputError(f"{path}: names no effects: write a line such as {_EXAMPLE}.")
    try:
        content: _Content = converted(table, _Content)
    except Misfit as error:
        raise InputError(f"{path}: {error}: write lines such as {_EXAMPLE}.") from None
    sums = content.get("sha256", {})
    programs = tuple(Program(path.parent / text, sums.get(text, "")) for text in content.get("effects_from", []))
    with _telling(path):
        effects.refuse_unfit(content["effects"], programs)
    return ModelFile(path, tuple(content["effects"]), programs)


@contextmanager
def _telling(path: Path) -> Iterator[None]:
    """Add the path to the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_model_file(path: Path, result: Calibration) -> None:
    """Write the model of a result with the coefficients that were found; the file is written completely or not at all.

    A file of that name is replaced. Raises InputError if it cannot be written.
    """
    own = result.model.effects
    table: dict[str, Any] = {"effects": [effects.as_text(effect) for effect in own]}
    if programs := {_relative(each.path, path): each.sha256 for each in effects.programs_of(own)}:
        table |= {"effects_from": list(programs), "sha256": programs}
    if found := list(_coefficients(result)):
        table["coefficients"] = found
    import tomli_w

    write_whole(
        path, ("# Model of kf_calib: kf-calib replay RECORDING --model THIS_FILE\n" + tomli_w.dumps(table)).encode()
    )


def _coefficients(result: Calibration) -> Iterable[dict[str, Any]]:
    """Yield symbol, value, sigma and unit of all parameters but the twelve; value and sigma are absent if not
    determined."""
    twelve = len(result.estimate.parameters)
    for parameter in list(result.parameters.values())[twelve:]:
        seen = {"value": parameter.value, "sigma": parameter.sigma} if parameter.value is not None else {}
        yield {"symbol": parameter.symbol, **seen, "unit": parameter.unit}


def _relative(file: Path, path: Path) -> str:
    """Return the path of a program relative to the model file."""
    try:
        return Path(os.path.relpath(file, path.resolve().parent)).as_posix()
    except ValueError:  # the file is on another drive
        return file.as_posix()
