"""One tree of errors. Each message is one sentence: what is wrong, where, what to do next."""

from __future__ import annotations

import math
import re


class KfCalibError(Exception):
    """Anything kf_calib refuses to do; the command line prints it on stderr and exits with 2."""


class InputError(KfCalibError):
    """A recording, a line or a file of parameters cannot be used as it is."""


class CountsError(InputError):
    """Readings are in counts, and the size of one is not stated; ``scale`` is a guess at it by gravity, m/s^2."""

    def __init__(self, said: str, scale: float) -> None:
        super().__init__(said)
        self.scale = scale


class BenchError(InputError):
    """The description of the bench (axes, reference, gravity, latitude ...) is missing or impossible."""


class UnobservableError(KfCalibError):
    """The orientations so far leave some parameters undetermined; the message names them."""


class BlunderError(InputError):
    """The run is no calibration of the bench as it is stated: a channel reversed, a gimbal's sense, a unit ..."""


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
