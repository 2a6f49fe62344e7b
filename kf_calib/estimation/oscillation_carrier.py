"""Dwells folded anew on a carrier near the frequency of an oscillation in the model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kf_calib.dwells.sufficient_statistics import DwellFactor, Folder, lines_of
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.fit import Fit, fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import consistency
from kf_calib.support import stage

_CARRIERS = 3  # passes at most in search of one
_CYCLES = 50.0  # a dwell, of a line that may be what is left of a slow oscillation
_SLOW = 0.3  # cycles of a slow oscillation in a dwell: its parabola leaves less than a thousandth of its power
_NEAR = 0.06  # cycles between oscillation and carrier in a piece: a parabola then leaves 1e-3 of its amplitude


def on_carrier(
    passed: Pass, dwells: list[DwellFactor], plain: Fit | None, on_progress: Callable[[float], None] | None
) -> tuple[Pass, Fit]:
    """The source folded again on a carrier at the frequency of the model's oscillation, until it is near enough.

    The first carrier is the line in the spectrum; without one, the oscillation is slow, and found on the plain dwells.
    What a parabola leaves of a slow one makes a line of a few cycles a dwell: there the likelier one is taken.
    """
    seen = lines_of(dwells)
    if not seen:
        plain = plain or fitted_to(passed, dwells)
        return (passed, plain) if holds_its_oscillation(plain) else _nearer(passed, plain, on_progress)
    shortest_s = min(dwell.end_s - dwell.start_s for dwell in dwells if dwell.count > dwells[0].count // 2)
    found = [_nearer(passed, seen[0].frequency_hz, on_progress)]
    if seen[0].frequency_hz * shortest_s < _CYCLES:
        found.append(_nearer(passed, plain or fitted_to(passed, dwells), on_progress))
    return min(found, key=lambda each: _unlikeliness(each[1]))


def _unlikeliness(fitted: Fit) -> float:
    """-2 ln of the likelihood of the noise within dwells and of the misfit of the model, but for a constant."""
    sigma, count = fitted.noise.effective_sigma_mps2, sum(dwell.count for dwell in fitted.dwells)
    return 2.0 * count * float(np.log(sigma).sum()) + consistency(fitted).statistic


def holds_its_oscillation(fitted: Fit) -> bool:
    """Whether the dwells are folded so that they hold the model's oscillation, if it has one: on a carrier, or it is so
    slow that a parabola over a dwell does, or what that leaves would count as correlated noise."""
    dwells = fitted.dwells
    if not fitted.carried.model.oscillates or dwells[0].carrier_hz:
        return True
    longest_s = max(dwell.end_s - dwell.start_s for dwell in dwells)
    return _oscillation_hz(fitted) * longest_s < _SLOW and not lines_of(dwells)


def _nearer(passed: Pass, carrier: float | Fit, on_progress: Callable[[float], None] | None) -> tuple[Pass, Fit]:
    """The source folded on a carrier, in Hz or where a fit has the oscillation, and the fit there."""
    carrier_hz = _oscillation_hz(carrier) if isinstance(carrier, Fit) else carrier
    for left in reversed(range(_CARRIERS)):
        stage.say(f"reading on a carrier of {carrier_hz:.3g} Hz")
        passed = Pass(passed.source, passed.settings, folder=Folder(carrier_hz))
        dwells = passed.fold(on_progress)
        fitted = fitted_to(passed, dwells)
        longest_s = max(float(np.ptp(piece.nodes.elapsed_s)) for dwell in dwells for piece in dwell.pieces)
        if not left or abs(_oscillation_hz(fitted) - carrier_hz) * longest_s < _NEAR:
            return passed, fitted
        carrier_hz = _oscillation_hz(fitted)
    raise AssertionError("unreachable: the last of the carriers is taken as it is")


def fitted_to(passed: Pass, dwells: list[DwellFactor]) -> Fit:
    settings = passed.settings
    model = Model.of(passed.source.bench, settings.effects)
    return fit(dwells, model, settings.walk_mps2_per_sqrt_s, passed.folder.slews)


def _oscillation_hz(fitted: Fit) -> float:
    return next(effect.value for effect in fitted.carried.model.effects if effect.oscillates)
