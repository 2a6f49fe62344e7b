"""One tree of errors. Each message is one sentence: what is wrong, where, what to do next."""

from __future__ import annotations

import math
import re
from importlib.util import find_spec


class KfCalibError(Exception):
    """Anything kf_calib refuses to do; the command line prints it on stderr and exits with 2."""


class InputError(KfCalibError):
    """A recording, a line or a file of parameters cannot be used as it is."""


class CountsError(InputError):
    """Readings are in counts, of which something is not stated; ``keys``: bench keys that state it, as the readings
    tell them."""

    def __init__(self, said: str, keys: dict[str, str]) -> None:
        super().__init__(said)
        self.keys = keys


class BenchError(InputError):
    """The description of the bench (axes, reference, gravity, latitude ...) is missing or impossible."""


class UnobservableError(KfCalibError):
    """The orientations so far leave some parameters undetermined; the message names them."""


class BlunderError(InputError):
    """The run is no calibration of the bench as it is stated: a channel reversed, a gimbal's sense, a unit ...;
    ``options`` mend it, where the cause is known."""

    def __init__(self, said: str, options: str = "") -> None:
        super().__init__(said)
        self.options = options


class MissingExtraError(KfCalibError):
    """A package is not installed that this needs; the message has the command that brings it."""


def check_number(name: str, value: float, least: float = 0.0, *, above: bool = False) -> None:
    """Raise InputError unless ``value`` is a finite number of at least ``least`` (``above``: larger than that)."""
    try:
        fits = math.isfinite(value) and (value > least if above else value >= least)
    except TypeError:
        fits = False
    if not fits:
        wanted = f"a number above {least:g}" if above else f"a number of at least {least:g}"
        raise InputError(f"{name} is {value!r}: give {wanted}.")


def how_to_write(number: str) -> str:
    """`` (write 9.81 with a point)`` for what is written as 9,81; nothing for anything else."""
    found = re.search(r"\d*,\d+", number)
    return f" (write {number[: found.end()].replace(',', '.')} with a point)" if found else ""


def need(package: str, extra: str | None, purpose: str, requirement: str = "") -> None:
    """Raise MissingExtraError unless ``package`` can be imported; extra: of kf_calib, that brings it, if one does;
    requirement: what pip is to be given else, where that is not the package's name."""
    if find_spec(package) is None:
        wanted = (requirement or package) if extra is None else f"'kf_calib[{extra}]'"
        raise MissingExtraError(f"{purpose} needs {package}, which is not installed: pip install {wanted}.")
