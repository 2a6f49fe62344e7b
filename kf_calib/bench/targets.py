"""What ``--target`` says, the same for ``live`` and ``plan``: the sigmas that a run is to reach.

A target is ``NAME=SIGMA``. NAME: a parameter (``theta1``, ``K2``), all of a kind (``theta``, ``phi``, ``nu``, ``K``,
``b``) or ``angles``. SIGMA: a number with a unit (``2ppm``, ``20ug``, ``0.1 arcsec``), or in SI without one.
"""

from __future__ import annotations

from collections.abc import Iterable

from kf_calib.bench import paper_parameters
from kf_calib.errors import InputError, how_to_write
from kf_calib.support import units


def targets_of(texts: Iterable[str]) -> dict[str, float]:
    """Sigma wanted by symbol, in SI; of several for one parameter the last counts. Raises InputError."""
    targets = dict[str, float]()
    for text in texts:
        name, equals, size = text.partition("=")
        parameters = [k for k, symbol in enumerate(paper_parameters.SYMBOLS) if name.strip() in _names_of(symbol)]
        if not equals or not parameters:
            raise InputError(
                f"target {text!r} names no parameter: write NAME=SIGMA, for example K=2ppm, with NAME one of "
                f"{', '.join(paper_parameters.SYMBOLS)}, or theta, phi, nu, K, b or angles for all of a kind."
            )
        sigma = _sigma(text, size, paper_parameters.UNITS[parameters[0]])
        targets |= {paper_parameters.SYMBOLS[k]: sigma for k in parameters}
    return targets


def _names_of(symbol: str) -> set[str]:
    """Return the names of a parameter: its symbol, its symbol without number, and ``angles`` for an angle."""
    kind = symbol.rstrip("123")
    return {symbol, kind, *([] if kind in ("K", "b") else ["angles"])}


def _sigma(text: str, size: str, unit: str) -> float:
    """Return the size in SI of a sigma."""
    try:
        value = units.quantity(size, unit)
    except InputError:
        value = 0.0
    if value <= 0.0:
        raise InputError(
            f"target {text!r} has no sigma above zero that fits: give a number in one of "
            f"{', '.join(units.choices(unit))}{how_to_write(size)}."
        )
    return value
