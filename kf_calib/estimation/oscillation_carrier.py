"""Folding of the dwells on a carrier near the frequency of an oscillation in the model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kf_calib.dwells.folding import Folder
from kf_calib.dwells.line_spectrum import SpectralLine
from kf_calib.dwells.sufficient_statistics import DwellFactor, lines_of
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.results import consistency
from kf_calib.support import stage

_CARRIERS = 3  # largest number of passes in search of a carrier
_CYCLES = 50.0  # cycles per dwell; a line below may be the remainder of a slow oscillation
_SLOW, _LEFT = 0.3, 1e-3  # cycles per dwell; of a slower oscillation a parabola leaves less than this of the power
_APART = 3.0  # cycles per dwell between a slow oscillation and the strongest line that it leaves, at most
_NEAR = 0.06  # cycles by which oscillation and carrier may differ in a piece; a parabola then leaves 1e-3 of it


def on_carrier(
    passed: Pass, dwells: Sequence[DwellFactor], plain: Fit | None, on_progress: Callable[[float], None] | None
) -> tuple[Pass, Fit]:
    """The source folded again on a carrier near the frequency of the model's oscillation, and the fit to it.

    The first carrier is the strongest line in the spectrum; if there is none, the oscillation is slow and is fitted to
    the plain dwells. A line of only a few cycles per dwell may be the remainder of a slow oscillation after the
    parabola was removed; where that could leave it, both are tried and the more likely one is taken.
    """
    lines = lines_of(dwells)
    if not lines:
        plain = plain or fitted_to(passed, dwells)
        return (passed, plain) if holds_its_oscillation(plain) else _nearer(passed, plain, on_progress)
    shortest_s = min(dwell.end_s - dwell.start_s for dwell in dwells if dwell.count > dwells[0].count // 2)
    on_carriers = [_nearer(passed, lines[0].frequency_hz, on_progress)]
    if lines[0].frequency_hz * shortest_s < _CYCLES:
        slow = plain or fitted_to(passed, dwells)
        if _may_leave(slow, lines[0]):
            on_carriers.append(_nearer(passed, slow, on_progress))
    return min(on_carriers, key=lambda each: _unlikeliness(each[1]))


def _may_leave(slow: Fit, line: SpectralLine) -> bool:
    """Tell whether a fitted oscillation may leave this line beside a parabola over each dwell.

    What is left is near it, or at one to two cycles a dwell. Otherwise the fit is no more than a drift that the
    oscillation mimics; less than half a cycle a run is no oscillation.
    """
    dwells, effect = slow.dwells, slow.linearised.model.oscillation
    assert effect is not None
    apart = abs(line.frequency_hz - effect.value) * max(dwell.end_s - dwell.start_s for dwell in dwells)
    if apart > _APART or effect.value * (dwells[-1].end_s - dwells[0].start_s) < 0.5:
        return False
    part = slow.linearised.model.parts[str(effect)]
    amplitude = float(np.linalg.norm(slow.state[part][: len(effect.coefficients)]))
    seen = float(np.linalg.norm(line.amplitude_mps2))
    return _cycles(slow) >= _SLOW or amplitude**2 * _LEFT > seen**2


def _unlikeliness(fitted: Fit) -> float:
    """Return -2 ln of the likelihood of the noise within dwells and of the misfit, up to a constant."""
    sigma, count = fitted.noise.effective_sigma_mps2, sum(dwell.count for dwell in fitted.dwells)
    return 2.0 * count * float(np.log(sigma).sum()) + consistency(fitted).statistic


def holds_its_oscillation(fitted: Fit) -> bool:
    """Tell whether the dwells are folded so that the model's oscillation, if it has one, can be fitted.

    They are if they are folded on a carrier, or if the oscillation is so slow that a parabola over a dwell describes it
    and its remainder shows no line.
    """
    dwells = fitted.dwells
    if not fitted.linearised.model.oscillates or dwells[0].carrier_hz:
        return True
    return _cycles(fitted) < _SLOW and not lines_of(dwells)


def _nearer(passed: Pass, carrier: float | Fit, on_progress: Callable[[float], None] | None) -> tuple[Pass, Fit]:
    """Fold the source on a carrier, given in Hz or by the oscillation of a fit, until it is near the fitted
    oscillation."""
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


def fitted_to(passed: Pass, dwells: Sequence[DwellFactor]) -> Fit:
    """The fit of the settings' model to these dwells."""
    return fit(dwells, passed.model, passed.settings.walk_mps2_per_sqrt_s, passed.folder.slews)


def _cycles(fitted: Fit) -> float:
    """Return the cycles of the model's oscillation in the longest dwell."""
    return _oscillation_hz(fitted) * max(dwell.end_s - dwell.start_s for dwell in fitted.dwells)


def _oscillation_hz(fitted: Fit) -> float:
    """Return the frequency of the model's oscillation."""
    effect = fitted.linearised.model.oscillation
    assert effect is not None
    return effect.value
