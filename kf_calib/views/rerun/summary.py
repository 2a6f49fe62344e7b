"""The run in one page of Markdown: parameters, noise, misfit, warnings."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from kf_calib.estimation.correlation import correlation
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.views.console import noise_origins
from kf_calib.views.rerun.names import GROUP_OF, LABELS, MICRO, quantities


def summary(result: Calibration) -> str:
    """Markdown; deviations and sigmas in arcsec, ppm, um/s^2."""
    blocks = [_head(result), _table(result), _verdict(result), *_warnings(result), _noise(result), *_ties(result)]
    return "\n\n".join(blocks) + "\n"


def _head(result: Calibration) -> str:
    bench, count = result.bench, sum(visit.dwell.count for visit in result.visits)
    serial = f"**{bench.notes['block_serial']}**: " if "block_serial" in bench.notes else ""
    axes = f"axes {bench.to_metadata()['axes']}" if bench.axes else "attitude recorded"
    held = ", inertially held" if bench.reference == "inertial" else ""
    dwells = f"{len(result.visits)} dwell{'s' * (len(result.visits) != 1)}"
    return f"{serial}{dwells}, {count} samples; {axes}{held}, g = {bench.gravity_mps2:.6g} m/s²"


def _table(result: Calibration) -> str:
    head = "| | value | − nominal | ± 1σ | |\n|:--|--:|--:|--:|:--|\n"
    return head + "\n".join(_row(parameter) for parameter in result.parameters.values())


def _row(parameter: Parameter) -> str:
    label, group = LABELS.get(parameter.symbol, parameter.symbol), GROUP_OF.get(parameter.symbol)
    if parameter.value is None or parameter.sigma is None:
        return f"| {label} | not determined | | | |"
    per_si, unit = (parameter.per_si, parameter.shown_unit) if group is None else (group.per_si, group.unit)
    deviation = fixed((parameter.value - parameter.nominal) * per_si, parameter.sigma * per_si)
    value = "" if group is None else _absolute(parameter.value, parameter.sigma, parameter.unit)
    return f"| {label} | {value} | {deviation} | {_two(parameter.sigma * per_si)} | {unit} |"


def _absolute(value: float, sigma: float, unit: str) -> str:
    if unit == "rad":
        return fixed(math.degrees(value), math.degrees(sigma)) + "°"
    return fixed(value, sigma)


def fixed(value: float, sigma: float) -> str:
    """A value to the second digit of its sigma."""
    digits = 1 - math.floor(math.log10(sigma)) if sigma > 0 else 9
    return f"{value:.{min(max(digits, 0), 12)}f}".replace("-", "−")


def _two(sigma: float) -> str:
    return fixed(sigma, sigma)


def _verdict(result: Calibration) -> str:
    judged = result.consistency
    if judged.p_value is None:
        words = "nothing left over to judge the model by"
    else:
        yes = "agree with the model" if judged.consistent else "**disagree with the model**"
        per_dof = _digits(judged.statistic / judged.dof)
        words = f"the dwells {yes}: p {format_p(judged.p_value)}, NIS/dof = {per_dof}, dof = {judged.dof}"
    held = ""
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2 is not None:
        held = f"; held out {_micro(result.held_out_rms_mps2)} (noise alone {_micro(result.held_out_floor_mps2)})"
    return f"**Misfit**: {words}. Residual rms {_micro(result.residual_rms_mps2)}{held} µm/s²"


def _noise(result: Calibration) -> str:
    noise = result.noise
    parts = [f"{_three(noise.sigma_mps2 * MICRO)} µm/s² a reading"]
    if noise.inflation.max() > 1.05:
        parts.append(f"correlated: variance of means × {_three(noise.inflation)}")
    if noise.setting_rad > 0:
        origin = noise_origins(result)[1]
        parts.append(f"setting error {math.degrees(noise.setting_rad) * 3600:.3g} arcsec ({origin})")
    if noise.scatter_mps2.max() > 0:
        origin = noise_origins(result)[0]
        parts.append(f"scatter {_three(noise.scatter_mps2 * MICRO)} µm/s² ({origin})")
    return f"**Noise** (1σ): {'; '.join(parts)}"


def _ties(result: Calibration) -> list[str]:
    """The pairs of parameters the orientations tell apart worst."""
    matrix = np.nan_to_num(correlation(result.estimate))
    pairs = sorted(combinations(range(len(matrix)), 2), key=lambda pair: -abs(matrix[pair]))
    names = [each.label for each in quantities(result.model)]
    strong = [f"{names[i]} {names[j]} {matrix[i, j]:+.2f}" for i, j in pairs[:4] if abs(matrix[i, j]) >= 0.5]
    return [f"**Correlated**: {', '.join(strong)}".replace("-", "−")] if strong else []


def _three(values: np.ndarray) -> str:
    return ", ".join(_digits(value) for value in values)


def _micro(value_mps2: float) -> str:
    return _digits(value_mps2 * MICRO)


def _warnings(result: Calibration) -> list[str]:
    return ["**Warnings**\n\n" + "\n".join(f"- {text}" for text in result.warnings)] if result.warnings else []


def _digits(value: float) -> str:
    """Three significant digits, no exponent."""
    if 0 < value < 1e-3:
        return "< 0.001"
    return np.format_float_positional(value, precision=3, unique=False, fractional=False, trim="-")
