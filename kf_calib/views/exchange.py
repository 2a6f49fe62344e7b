"""What the commands that use calibrations say: as reports, and as JSON objects."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.estimation.correction import Correction
from kf_calib.estimation.results import format_p
from kf_calib.exchange.corrected_file import Applied
from kf_calib.exchange.history import History, Track
from kf_calib.exchange.verification import Verification
from kf_calib.sources.files.contents import CALIBRATED_TOPIC
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import Table
from kf_calib.views.terminal import note

_SHOWN = 12


def applied_object(
    correction: Correction, found: Applied, out: Path, warnings: Sequence[str], topic: bool = True
) -> dict[str, Any]:
    """The JSON object of ``apply``."""
    return clean(
        {
            "out": str(out),
            "topic": CALIBRATED_TOPIC if topic else None,
            "readings": found.readings,
            "not_finite": found.not_finite,
            "corrected": [str(effect) for effect in correction.effects],
            "left_out": correction.left_out,
            "temperature_c": found.temperature_c,
            "sigma_mps2": correction.worst_sigma_mps2,
            "warnings": list(warnings),
        }
    )


def applied_report(
    correction: Correction, found: Applied, out: Path, warnings: Sequence[str], topic: bool = True
) -> RenderableType:
    """The report of ``apply``."""
    place = f"{CALIBRATED_TOPIC} in {out}" if topic else str(out)
    names = ", ".join(["alignment, scale factor and bias", *map(str, correction.effects)])
    lines = [Text(f"{found.readings} readings corrected for {names}: {place}.", style="bold")]
    unit = shown("m/s^2")
    sigma = ", ".join(unit.number(each, 2) for each in correction.worst_sigma_mps2)
    lines.append(Text(f"Uncertainty by the calibration (1σ, at most, at 1 g): {sigma} {unit.label} along x, y, z."))
    if found.temperature_c is not None:
        low, high = found.temperature_c
        lines.append(Text(f"Temperature {low:.1f} to {high:.1f} °C."))
    lines += [note(f"{name} is not corrected: {why}") for name, why in correction.left_out.items()]
    if found.not_finite:
        lines.append(note(f"{found.not_finite} readings are not finite, and stay so"))
    return Group(*lines, *map(note, warnings))


def verification_object(found: Verification) -> dict[str, Any]:
    """The JSON object of ``verify``."""
    return clean(
        {
            "holds": found.holds,
            "p_value": found.p_value,
            "statistic": found.statistic,
            "dof": found.dof,
            "dwells": found.dwells,
            "moved": [_move_object(move) for move in found.moved],
            "compared": [_move_object(move) for move in found.moves],
            "residual_rms_mps2": found.residual_rms_mps2,
            "worst_error_mps2": found.worst_mps2,
            "worst_error_sigma_mps2": found.worst_sigma_mps2,
            "not_compared": list(found.free),
            "new_consistent": None if found.new is None else found.new.consistency.consistent,
            "warnings": list(found.warnings),
        }
    )


def _move_object(move: Any) -> dict[str, Any]:
    """Return the change of one parameter as a JSON object."""
    return {"symbol": move.symbol, "difference": move.difference, "sigma": move.sigma, "unit": move.unit,
            "p_value": move.p_value}  # fmt: skip


def verification_report(found: Verification) -> RenderableType:
    """The report of ``verify``."""
    head = "The calibration still holds" if found.holds else "The calibration does NOT hold any more"
    style = "bold green" if found.holds else "bold yellow"
    dwells = f"{found.dwells} dwell{'s' * (found.dwells != 1)}"
    test = f"p {format_p(found.p_value)}; {dwells}, χ² {found.statistic:.1f} of {found.dof} dof"
    parts: list[RenderableType] = [Text(f"{head} ({test}).", style=style)]
    unit = shown("m/s^2")
    parts.append(Text(f"It predicts the means of the dwells to {unit.text(found.residual_rms_mps2)} rms."))
    if found.worst_mps2 is not None and found.worst_sigma_mps2 is not None:
        worst, sigma = unit.rounded(found.worst_mps2, found.worst_sigma_mps2)
        parts.append(Text(f"Readings corrected by it are wrong by up to {worst} ± {sigma} {unit.label} now."))
    if found.moves:
        parts.append(_moves_table(found))
    else:
        parts.append(note("the new orientations determine no parameter by themselves, so none is compared"))
    if found.new is not None and found.new.consistency.consistent is False:
        parts.append(note("the new run does not agree with the model by itself: diagnose it before you trust the rest"))
    parts += [note(f"{name} was not compared: it belongs to the run or the platform") for name in found.free]
    return Group(*parts, *map(note, found.warnings))


def _moves_table(found: Verification) -> Table:
    """Return the table of the parameters that were compared, the clearest changes first."""
    table = Table(title="Changes (1σ of both; p: that none of them has moved)", title_justify="left")
    for heading in ("parameter", "change", "sigma", "unit", "change / sigma", "p", ""):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "") else "right")
    moved = set(found.moved)
    for move in found.moves[:_SHOWN]:
        unit = shown(move.unit)
        change, sigma = unit.rounded(move.difference, move.sigma)
        sign = "" if change.startswith("-") else "+"
        table.add_row(
            symbol(move.symbol), f"{sign}{change}", f"± {sigma}", unit.label, f"{move.difference / move.sigma:+.1f}",
            format_p(move.p_value).removeprefix("= "), "moved" if move in moved else "",
        )  # fmt: skip
    return table


def history_object(found: History) -> dict[str, Any]:
    """The JSON object of ``history``; drift in SI per day."""
    return clean(
        {
            "serial": found.serial or None,
            "dates": [date.isoformat() for date in found.dates],
            "parameters": [_track_object(track) for track in found.tracks],
            "tolerances": dict(found.tolerances),
            "due": None if found.due is None else found.due.isoformat(),
            "due_by": found.due_by or None,
            "warnings": list(found.warnings),
        }
    )


def _track_object(track: Track) -> dict[str, Any]:
    """Return one parameter over the calibrations as a JSON object."""
    return {
        "symbol": track.symbol, "unit": track.unit, "values": track.values, "sigmas": track.sigmas,
        "predicted": track.predicted, "predicted_sigmas": track.predicted_sigma, "level": track.level,
        "level_sigma": track.level_sigma, "drift": track.drift, "drift_sigma": track.drift_sigma,
        "repeatability": track.repeatability, "walk": track.walk, "constant_p": track.constant_p,
    }  # fmt: skip


def history_report(found: History) -> RenderableType:
    """The report of ``history``."""
    of = f" of {found.serial}" if found.serial else ""
    first, last = found.dates[0].date(), found.dates[-1].date()
    parts: list[RenderableType] = [Text(f"{len(found.dates)} calibrations{of}, {first} to {last}.", style="bold")]
    table = Table(title="Change over the calibrations (1σ; p: that a constant differs so much)", title_justify="left")
    for heading in ("parameter", "last less first", "drift a year", "repeatability", "walk in a year", "unit", "p"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for track in found.tracks:
        table.add_row(*_track_row(track))
    parts.append(table)
    if found.due is not None:
        parts.append(Text(_next_calibration(found, found.due), style="bold"))
    elif found.tolerances and all(track.drift is not None for track in found.tracks):
        parts.append(Text("No tolerance is left within twenty years, as far as these calibrations can tell."))
    return Group(*parts, *map(note, found.warnings))


def _next_calibration(found: History, due: datetime) -> str:
    """Return when the next calibration is due, and why."""
    what = symbol(found.due_by)
    if due > found.dates[-1]:
        return f"Calibrate again by {due.date()}: {what} may leave its tolerance then (2σ)."
    if any(track.drift is None for track in found.tracks):
        return f"{what} may be beyond its tolerance at once (2σ): its repeatability is not better than that."
    return f"Calibrate again now: {what} may be beyond its tolerance already (2σ)."


def _track_row(track: Track) -> list[str]:
    """Return the row of one parameter."""
    unit, year = shown(track.unit), 365.25
    drift = "not seen"
    if track.drift is not None and track.drift_sigma is not None:
        value, sigma = unit.rounded(track.drift * year, track.drift_sigma * year)
        drift = f"{value} ± {sigma}"
    change = unit.number(float(track.values[-1] - track.values[0]))
    return [
        symbol(track.symbol), change if change.startswith("-") else f"+{change}", drift,
        unit.number(track.repeatability, 2), unit.number(track.walk * year**0.5, 2), unit.label,
        format_p(track.constant_p).removeprefix("= "),
    ]  # fmt: skip
