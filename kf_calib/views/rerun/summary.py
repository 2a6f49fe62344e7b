"""The run in one page of Markdown: parameters, noise, misfit, warnings."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.correlation import correlation
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support.units import Unit, shown, significant
from kf_calib.views.console import noise_origins, whole_value
from kf_calib.views.rerun.names import LABELS, quantities


def markdown_summary(result: Calibration) -> str:
    """The page in Markdown, in the units that people are shown."""
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
    label, unit = LABELS.get(parameter.symbol, parameter.symbol), shown(parameter)
    if parameter.value is None or parameter.sigma is None:
        return f"| {label} | not determined | | | |"
    deviation, sigma = map(_minus, unit.rounded(parameter.value - parameter.nominal, parameter.sigma))
    value = _minus(whole_value(parameter)) if parameter.symbol in LABELS else ""
    return f"| {label} | {value} | {deviation} | {sigma} | {unit.label} |"


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _verdict(result: Calibration) -> str:
    judged = result.consistency
    if judged.p_value is None:
        words = "nothing left over to judge the model by"
    else:
        yes = "agree with the model" if judged.consistent else "**disagree with the model**"
        per_dof = significant(judged.statistic / judged.dof)
        words = f"the dwells {yes}: p {format_p(judged.p_value)}, NIS/dof = {per_dof}, dof = {judged.dof}"
    held, unit = "", shown("m/s^2")
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2 is not None:
        rms, floor = map(unit.number, (result.held_out_rms_mps2, result.held_out_floor_mps2))
        held = f"; held out {rms} (noise alone {floor})"
    return f"**Misfit**: {words}. Residual rms {unit.number(result.residual_rms_mps2)}{held} {unit.label}"


def _noise(result: Calibration) -> str:
    noise, unit = result.noise, shown("m/s^2")
    parts = [f"{_three(unit, noise.sigma_mps2)} {unit.label} a reading"]
    if noise.inflation.max() > 1.05:
        parts.append(f"correlated: variance of means × {_three(Unit('', 1.0), noise.inflation)}")
    if noise.setting_rad > 0:
        origin = noise_origins(result)[1]
        parts.append(f"setting error {shown('rad').text(noise.setting_rad)} ({origin})")
    if noise.scatter_mps2.max() > 0:
        origin = noise_origins(result)[0]
        parts.append(f"scatter {_three(unit, noise.scatter_mps2)} {unit.label} ({origin})")
    return f"**Noise** (1σ): {'; '.join(parts)}"


def _ties(result: Calibration) -> list[str]:
    """The pairs of parameters the orientations tell apart worst."""
    matrix = np.nan_to_num(correlation(result.estimate))
    pairs = sorted(combinations(range(len(matrix)), 2), key=lambda pair: -abs(matrix[pair]))
    names = [each.label for each in quantities(result.model)]
    strong = [f"{names[i]} {names[j]} {matrix[i, j]:+.2f}" for i, j in pairs[:4] if abs(matrix[i, j]) >= 0.5]
    return [f"**Correlated**: {', '.join(strong)}".replace("-", "−")] if strong else []


def _three(unit: Unit, values: Floats) -> str:
    return ", ".join(map(unit.number, values))


def _warnings(result: Calibration) -> list[str]:
    return ["**Warnings**\n\n" + "\n".join(f"- {text}" for text in result.warnings)] if result.warnings else []
