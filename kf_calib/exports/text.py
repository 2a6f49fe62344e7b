"""What was exported for another program, and what that program cannot hold: as reports, and as JSON objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.exports.noise_keys import NoiseExport
from kf_calib.exports.target import Target
from kf_calib.support.units import shown
from kf_calib.views.terminal import note


def exported_object(target: Target, to: str, path: Path) -> dict[str, Any]:
    """The JSON object of ``export``."""
    left = target.error_left
    return {
        "out": path,
        "format": to,
        "lost": target.lost,
        "left_out": target.correction.left_out,
        "takes": str(target.input),
        "to_be_done_before": target.to_be_done_before or None,
        "error_left_rms_mps2": None if left is None else left.rms_mps2,
        "error_left_worst_mps2": None if left is None else left.worst_mps2,
        "warnings": [*target.remarks, *(target.noise.remarks if target.noise else ())],
    }


def exported_report(target: Target, to: str, path: Path) -> RenderableType:
    """The report of ``export``."""
    lines = [Text(f"{path} is the calibration for {target.title}.", style="bold")]
    if not target.correction.input.is_plain:
        lines.append(Text(f"It takes {target.input}."))
    if target.to_be_done_before:
        lines.append(note(f"convert what the device sends before it goes in: {target.to_be_done_before}"))
    if target.error_left is None:
        lines.append(Text("It holds all of it."))
    else:
        unit, (rms, worst) = shown("m/s^2"), target.error_left
        lines.append(note(f"it does not hold {', '.join(target.lost)}: corrected readings are wrong by "
                          f"{unit.text(rms)} rms, {unit.text(worst)} at worst"))  # fmt: skip
    lines += [note(f"{name} is not corrected: {why}") for name, why in target.correction.left_out.items()]
    return Group(*lines, *map(note, [*target.remarks, *(target.noise.remarks if target.noise else ())]))


def noise_export_object(export: NoiseExport, to: str, path: Path) -> dict[str, Any]:
    """The JSON object of ``export`` of noise alone."""
    return {
        "out": path,
        "format": to,
        "keys": {key.name: key.value for key in export.keys},
        "limits": [key.name for key in export.keys if key.is_limit],
        "warnings": export.remarks,
    }


def noise_export_report(export: NoiseExport, to: str, path: Path) -> RenderableType:
    """The report of ``export`` of noise alone."""
    return Group(Text(f"{path} is the noise for {export.title}.", style="bold"), *map(note, export.remarks))
