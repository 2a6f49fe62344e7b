"""What commands say that use calibrations, export them, or show one that was saved: as reports, and as JSON objects."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.estimation.correction import Correction
from kf_calib.estimation.estimate import Parameter
from kf_calib.estimation.results import format_p
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.corrected_file import Applied
from kf_calib.exchange.history import History, ParameterTrack
from kf_calib.exchange.verification import Verification
from kf_calib.sources.files.contents import CALIBRATED_TOPIC
from kf_calib.support.text import counted
from kf_calib.support.units import field_unit, shown
from kf_calib.views.console import p_cell, table_of_parameters
from kf_calib.views.json import members
from kf_calib.views.notation import signed, symbol
from kf_calib.views.terminal import VERDICT_STYLES, ConsoleTable, note, table

_SHOWN = 12
_OF_A_MOVE = "symbol", "difference", "sigma", "unit", "p_value"


def applied_object(
    correction: Correction, applied: Applied, path: Path, warnings: Sequence[str], topic: bool = True
) -> dict[str, Any]:
    """The JSON object of ``apply``."""
    return {
        "out": path,
        "topic": CALIBRATED_TOPIC if topic else None,
        **members(applied, "readings", "not_finite"),
        "corrected": list(map(str, correction.effects)),
        "left_out": correction.left_out,
        "temperature_c": applied.temperature_c,
        "sigma_mps2": correction.worst_sigma_mps2,
        "warnings": warnings,
    }


def applied_report(
    correction: Correction, applied: Applied, path: Path, warnings: Sequence[str], topic: bool = True
) -> RenderableType:
    """The report of ``apply``."""
    place = f"{CALIBRATED_TOPIC} in {path}" if topic else str(path)
    names = ", ".join(["alignment, scale factor and bias", *map(str, correction.effects)])
    lines = [Text(f"{applied.readings} readings corrected for {names}: {place}.", style="bold")]
    unit = shown("m/s^2")
    sigma = ", ".join(unit.number(each, 2, zeros=True) for each in correction.worst_sigma_mps2)
    lines.append(Text(f"Uncertainty by the calibration (1σ, at most, at 1 g): {sigma} {unit.label} along x, y, z."))
    if applied.temperature_c is not None:
        low, high = applied.temperature_c
        lines.append(Text(f"Temperature {low:.1f} to {high:.1f} °C."))
    lines += [note(f"{name} is not corrected: {why}") for name, why in correction.left_out.items()]
    if applied.not_finite:
        lines.append(note(f"{applied.not_finite} readings are not finite, and stay so"))
    return Group(*lines, *map(note, warnings))


def verification_object(verification: Verification) -> dict[str, Any]:
    """The JSON object of ``verify``."""
    return {
        **members(verification, "holds", "p_value", "statistic", "dof", "dwells"),
        "moved": [members(move, *_OF_A_MOVE) for move in verification.moved],
        "compared": [members(move, *_OF_A_MOVE) for move in verification.moves],
        "residual_rms_mps2": verification.residual_rms_mps2,
        "worst_error_mps2": verification.worst_mps2,
        "worst_error_sigma_mps2": verification.worst_sigma_mps2,
        "not_compared": verification.free,
        "new_consistent": None if verification.new is None else verification.new.consistency.consistent,
        "warnings": verification.warnings,
    }


def verification_report(verification: Verification) -> RenderableType:
    """The report of ``verify``."""
    head = "The calibration still holds" if verification.holds else "The calibration does NOT hold any more"
    style = VERDICT_STYLES[verification.holds]
    dwells, test = counted(verification.dwells, "dwell"), f"χ² {verification.statistic:.1f} of {verification.dof} dof"
    parts: list[RenderableType] = [Text(f"{head} (p {format_p(verification.p_value)}; {dwells}, {test}).", style=style)]
    unit = shown("m/s^2")
    parts.append(Text(f"It predicts the means of the dwells to {unit.text(verification.residual_rms_mps2)} rms."))
    if verification.worst_mps2 is not None and verification.worst_sigma_mps2 is not None:
        worst = unit.with_sigma(verification.worst_mps2, verification.worst_sigma_mps2)
        parts.append(Text(f"Readings corrected by it are wrong by up to {worst} now."))
    if verification.moves:
        parts.append(_moves_table(verification))
    else:
        parts.append(note("the new orientations determine no parameter by themselves, so none is compared"))
    if verification.new is not None and verification.new.consistency.consistent is False:
        parts.append(note("the new run does not agree with the model by itself: diagnose it before you trust the rest"))
    parts += [note(f"{name} was not compared: it belongs to the run or the platform") for name in verification.free]
    return Group(*parts, *map(note, verification.warnings))


def _moves_table(verification: Verification) -> ConsoleTable:
    """Return the table of the parameters that were compared, the clearest changes first."""
    moved, rows = set(verification.moved), list[tuple[str, ...]]()
    for move in verification.moves[:_SHOWN]:
        unit = shown(move.unit)
        change, sigma = unit.rounded(move.difference, move.sigma)
        rows.append(
            (symbol(move.symbol), signed(change), f"± {sigma}", unit.label, f"{move.difference / move.sigma:+.1f}",
             p_cell(move.p_value), "moved" if move in moved else "")
        )  # fmt: skip
    headings = "parameter", ">change", ">sigma", "unit", ">change / sigma", ">p", ""
    return table("Changes (1σ of both; p: of one so large, of all, by noise alone)", headings, rows)


def history_object(history: History) -> dict[str, Any]:
    """The JSON object of ``history``; drift in SI per day."""
    return {
        "serial": history.serial or None,
        "dates": [date.isoformat() for date in history.dates],
        "parameters": [
            members(track, "symbol", "unit", "values", "sigmas", "predicted")
            | {"predicted_sigmas": track.predicted_sigma}
            | members(track, "level", "level_sigma", "drift", "drift_sigma", "repeatability", "walk", "constant_p")
            for track in history.tracks
        ],
        "tolerances": history.tolerances,
        "due": None if history.due is None else history.due.isoformat(),
        "due_by": history.due_by or None,
        "warnings": history.warnings,
    }


def history_report(history: History) -> RenderableType:
    """The report of ``history``."""
    of = f" of {history.serial}" if history.serial else ""
    first, last = history.dates[0].date(), history.dates[-1].date()
    parts: list[RenderableType] = [Text(f"{len(history.dates)} calibrations{of}, {first} to {last}.", style="bold")]
    title = "Change over the calibrations (1σ; p: that a constant differs so much)"
    headings = "parameter", ">last less first", ">drift a year", ">repeatability", ">walk in a year", "unit", ">p"
    parts.append(table(title, headings, map(_track_row, history.tracks)))
    if history.due is not None:
        parts.append(Text(_next_calibration(history, history.due), style="bold"))
    elif history.tolerances and all(track.drift is not None for track in history.tracks):
        parts.append(Text("No tolerance is left within twenty years, as far as these calibrations can tell."))
    return Group(*parts, *map(note, history.warnings))


def _next_calibration(history: History, due: datetime) -> str:
    """Return when the next calibration is due, and why."""
    what = symbol(history.due_by)
    if due > history.dates[-1]:
        return f"Calibrate again by {due.date()}: {what} may leave its tolerance then (2σ)."
    if any(track.drift is None for track in history.tracks):
        return f"{what} may be beyond its tolerance at once (2σ): its repeatability is not better than that."
    return f"Calibrate again now: {what} may be beyond its tolerance already (2σ)."


def _track_row(track: ParameterTrack) -> list[str]:
    """Return the row of one parameter."""
    unit, year = shown(track.unit), 365.25
    drift = "not seen"
    if track.drift is not None and track.drift_sigma is not None:
        drift = " ± ".join(unit.rounded(track.drift * year, track.drift_sigma * year))
    change = signed(unit.number(float(track.values[-1] - track.values[0])))
    sizes = unit.number(track.repeatability, 2), unit.number(track.walk * year**0.5, 2)
    return [symbol(track.symbol), change, drift, *sizes, unit.label, p_cell(track.constant_p)]


def calibration_object(saved: SavedCalibration, path: Path) -> dict[str, Any]:
    """The JSON object of ``info`` of a calibration: what the file holds, and what it takes."""
    return {"file": path, "kind": "calibration", "input": str(saved.bench.input), **saved.model_dump()}


def calibration_report(saved: SavedCalibration, path: Path) -> RenderableType:
    """The report of ``info`` of a calibration."""
    units = [field_unit(each.unit) for each in saved.parameters]
    parameters = [Parameter(**each.model_dump(), shown_unit=unit.label, per_si=unit.per_si)
                  for each, unit in zip(saved.parameters, units, strict=True)]  # fmt: skip
    lines = [Text(f"{path}: a calibration, {saved.summary}.", style="bold"), Text(f"It takes {saved.bench.input}.")]
    commands = Text(f"Try: kf-calib apply {path} RECORDING -o OUT, or certificate, export, verify, history.")
    values = table_of_parameters("Parameters (1σ)", parameters, saved.fixed)
    return Group(*lines, values, Text(_agreement(saved)), *map(note, saved.provenance.warnings), commands)


def _agreement(saved: SavedCalibration) -> str:
    """Return in words whether model and measurements agreed."""
    consistency = saved.consistency
    if consistency.consistent is None or consistency.p_value is None or consistency.nis_per_dof is None:
        return "Whether model and measurements agree could not be judged: nothing was left over."
    agree = "agree" if consistency.consistent else "disagree"
    return (
        f"Model and measurements {agree} (p {format_p(consistency.p_value)}, NIS/dof {consistency.nis_per_dof:.3g}, "
        f"{consistency.dof} degrees of freedom)."
    )
