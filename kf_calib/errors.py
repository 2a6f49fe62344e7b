"""One tree of errors. Each message is one sentence: what is wrong, where, what to do next."""

from __future__ import annotations

import re


class KfCalibError(Exception):
    """Anything kf_calib refuses to do; the command line prints it on stderr and exits with 2."""


class InputError(KfCalibError):
    """A recording, a line or a file of parameters cannot be used as it is."""


class BenchError(InputError):
    """The description of the bench (axes, reference, gravity, latitude ...) is missing or impossible."""


class UnobservableError(KfCalibError):
    """The orientations so far leave some parameters undetermined; the message names them."""


def how_to_write(number: str) -> str:
    """`` (write 9.81 with a point)`` for what is written as 9,81; nothing for anything else."""
    found = re.search(r"\d*,\d+", number)
    return f" (write {number[: found.end()].replace(',', '.')} with a point)" if found else ""
