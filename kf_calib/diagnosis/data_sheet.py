"""A run as a data sheet: the model equation of an accelerometer with all coefficients that the run determines.

Symbols are those under which the model equation of IEEE Std 1293 is known,

    E / K1 = K0 + a_i + K2 a_i^2 + K3 a_i^3 + 1/2 K0' sgn a_i + 1/2 K1' |a_i| + Koq a_i |a_i|
             + Kip a_i a_p + Kio a_i a_o + Kpo a_p a_o + Kpp a_p^2 + Koo a_o^2 + misalignments + what varies,

with the forces a_i, a_p, a_o along the input, pendulous and output axis. The polynomial and the cross couplings are
estimated together, in one fit beside what the diagnosis found missing; every other coefficient alone beside these found
ones, as look-alikes take each other's part. What a coefficient has no value for, the run does not determine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects import effect_named, names
from kf_calib.effects.effect import SensorEffect
from kf_calib.errors import KfCalibError
from kf_calib.estimation.results import Calibration

_BESIDE = 3  # degrees of freedom that a fit must leave
_VAGUE = 100.0  # times a large size, beyond which a sigma tells nothing


@dataclass(frozen=True)
class DataSheetRow:
    """A coefficient of the three accelerometers, in SI: values and sigmas, None where the run does not determine it.

    how: ``parameter``, ``found`` (the diagnosis names it), ``together`` (with the polynomial) or ``alone``.
    """

    symbol: str
    words: str
    unit: str
    values: tuple[float | None, ...]
    sigmas: tuple[float | None, ...]
    how: str


@dataclass(frozen=True)
class DataSheet:
    """The rows; result: the calibration whose parameters they begin with."""

    result: Calibration
    rows: tuple[DataSheetRow, ...]


def data_sheet(diagnosed: Diagnosis, refits: Refits) -> DataSheet:
    """The data sheet of a run; refits: those of the diagnosis."""
    result = diagnosed.after or diagnosed.before
    modelled, bench = {str(effect) for effect in result.model.effects}, result.bench
    effects = [each for name in names(bench) if isinstance(each := effect_named(name, bench), SensorEffect)]
    listed = [each for each in effects if each.on_data_sheet]
    together = [str(each) for each in listed if each.in_polynomial and str(each) not in modelled]
    polynomial = _refit(refits, result, together)
    rows = [*_parameters(result)]
    for effect in listed:
        if str(effect) in modelled:
            rows.append(_row(effect, result, "found"))
        elif effect.in_polynomial:
            rows.append(_row(effect, polynomial, "together"))
        else:
            rows.append(_row(effect, _refit(refits, result, [str(effect)]), "alone"))
    return DataSheet(result, tuple(rows))


def _refit(refits: Refits, result: Calibration, names: Sequence[str]) -> Calibration | None:
    """Return the run with further effects; None where it leaves too few degrees of freedom, or cannot be fitted."""
    try:
        made = refits.with_effects(result, names) if names else result
    except (KfCalibError, np.linalg.LinAlgError):
        return None
    return made if made.consistency.dof >= _BESIDE else None


def _parameters(result: Calibration) -> list[DataSheetRow]:
    """Return K1 and K0 = b / K of each accelerometer, K0 with the sigma that follows from their covariance."""
    found, covariance = result.parameters, result.estimate.parameter_covariance
    scales, biases = [found[f"K{k}"] for k in (1, 2, 3)], [found[f"b{k}"] for k in (1, 2, 3)]
    values, sigmas = list[float | None](), list[float | None]()
    for k, (scale, bias) in enumerate(zip(scales, biases, strict=True)):
        if scale.value is None or bias.value is None:
            values.append(None)
            sigmas.append(None)
            continue
        gradient = np.array([-bias.value / scale.value**2, 1.0 / scale.value])
        own = covariance[4 * k + 2 : 4 * k + 4, 4 * k + 2 : 4 * k + 4]
        values.append(bias.value / scale.value)
        sigmas.append(math.sqrt(max(float(gradient @ own @ gradient), 0.0)))
    k0 = DataSheetRow("K0", "bias", "m/s^2", tuple(values), tuple(sigmas), "parameter")
    k1 = DataSheetRow("K1", "scale factor", "1", tuple(each.value for each in scales),
                      tuple(each.sigma for each in scales), "parameter")  # fmt: skip
    return [k1, k0]


def _row(effect: SensorEffect, fitted: Calibration | None, how: str) -> DataSheetRow:
    """Return the row of an effect, whose coefficients are one for each accelerometer, as a fit has them."""
    coefficients = effect.coefficients
    symbol = coefficients[0].symbol.rstrip("123").rstrip("_")
    values, sigmas = list[float | None](), list[float | None]()
    for each in coefficients:
        found = None if fitted is None else fitted.parameters.get(each.symbol)
        is_known = found is not None and found.sigma is not None and found.sigma < _VAGUE * each.scale
        values.append(found.value if found is not None and is_known else None)
        sigmas.append(found.sigma if found is not None and is_known else None)
    return DataSheetRow(symbol, effect.on_data_sheet, coefficients[0].unit, tuple(values), tuple(sigmas), how)
