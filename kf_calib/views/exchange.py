"""What commands say that use calibrations, export them, or show one that was saved: as reports, and as JSON objects."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.estimation.correction import Correction
from kf_calib.estimation.estimate import Parameter
from kf_calib.estimation.results import format_p
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.corrected_file import Applied
from kf_calib.exchange.exports.target import Target
from kf_calib.exchange.history import History, ParameterTrack
from kf_calib.exchange.verification import Verification
from kf_calib.sources.files.contents import CALIBRATED_TOPIC
from kf_calib.support.units import field_unit, shown
from kf_calib.views.console import parameter_row, symbol
from kf_calib.views.json import clean
from kf_calib.views.terminal import ConsoleTable, note

if TYPE_CHECKING:
    from kf_calib.exchange.certificate.budget import Certificate, CertifiedResult, Contribution
    from kf_calib.exchange.certificate.monte_carlo import MonteCarloCheck

_SHOWN = 12


def applied_object(
    correction: Correction, applied: Applied, path: Path, warnings: Sequence[str], topic: bool = True
) -> dict[str, Any]:
    """The JSON object of ``apply``."""
    return clean(
        {
            "out": str(path),
            "topic": CALIBRATED_TOPIC if topic else None,
            "readings": applied.readings,
            "not_finite": applied.not_finite,
            "corrected": [str(effect) for effect in correction.effects],
            "left_out": correction.left_out,
            "temperature_c": applied.temperature_c,
            "sigma_mps2": correction.worst_sigma_mps2,
            "warnings": list(warnings),
        }
    )


def applied_report(
    correction: Correction, applied: Applied, path: Path, warnings: Sequence[str], topic: bool = True
) -> RenderableType:
    """The report of ``apply``."""
    place = f"{CALIBRATED_TOPIC} in {path}" if topic else str(path)
    names = ", ".join(["alignment, scale factor and bias", *map(str, correction.effects)])
    lines = [Text(f"{applied.readings} readings corrected for {names}: {place}.", style="bold")]
    unit = shown("m/s^2")
    sigma = ", ".join(unit.number(each, 2) for each in correction.worst_sigma_mps2)
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
    return clean(
        {
            "holds": verification.holds,
            "p_value": verification.p_value,
            "statistic": verification.statistic,
            "dof": verification.dof,
            "dwells": verification.dwells,
            "moved": [_move_object(move) for move in verification.moved],
            "compared": [_move_object(move) for move in verification.moves],
            "residual_rms_mps2": verification.residual_rms_mps2,
            "worst_error_mps2": verification.worst_mps2,
            "worst_error_sigma_mps2": verification.worst_sigma_mps2,
            "not_compared": list(verification.free),
            "new_consistent": None if verification.new is None else verification.new.consistency.consistent,
            "warnings": list(verification.warnings),
        }
    )


def _move_object(move: Any) -> dict[str, Any]:
    """Return the change of one parameter as a JSON object."""
    return {"symbol": move.symbol, "difference": move.difference, "sigma": move.sigma, "unit": move.unit,
            "p_value": move.p_value}  # fmt: skip


def verification_report(verification: Verification) -> RenderableType:
    """The report of ``verify``."""
    head = "The calibration still holds" if verification.holds else "The calibration does NOT hold any more"
    style = "bold green" if verification.holds else "bold yellow"
    dwells = f"{verification.dwells} dwell{'s' * (verification.dwells != 1)}"
    test = f"p {format_p(verification.p_value)}; {dwells}, χ² {verification.statistic:.1f} of {verification.dof} dof"
    parts: list[RenderableType] = [Text(f"{head} ({test}).", style=style)]
    unit = shown("m/s^2")
    parts.append(Text(f"It predicts the means of the dwells to {unit.text(verification.residual_rms_mps2)} rms."))
    if verification.worst_mps2 is not None and verification.worst_sigma_mps2 is not None:
        worst, sigma = unit.rounded(verification.worst_mps2, verification.worst_sigma_mps2)
        parts.append(Text(f"Readings corrected by it are wrong by up to {worst} ± {sigma} {unit.label} now."))
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
    table = ConsoleTable(title="Changes (1σ of both; p: that none of them has moved)", title_justify="left")
    for heading in ("parameter", "change", "sigma", "unit", "change / sigma", "p", ""):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "") else "right")
    moved = set(verification.moved)
    for move in verification.moves[:_SHOWN]:
        unit = shown(move.unit)
        change, sigma = unit.rounded(move.difference, move.sigma)
        sign = "" if change.startswith("-") else "+"
        table.add_row(
            symbol(move.symbol), f"{sign}{change}", f"± {sigma}", unit.label, f"{move.difference / move.sigma:+.1f}",
            format_p(move.p_value).removeprefix("= "), "moved" if move in moved else "",
        )  # fmt: skip
    return table


def history_object(history: History) -> dict[str, Any]:
    """The JSON object of ``history``; drift in SI per day."""
    return clean(
        {
            "serial": history.serial or None,
            "dates": [date.isoformat() for date in history.dates],
            "parameters": [_track_object(track) for track in history.tracks],
            "tolerances": dict(history.tolerances),
            "due": None if history.due is None else history.due.isoformat(),
            "due_by": history.due_by or None,
            "warnings": list(history.warnings),
        }
    )


def _track_object(track: ParameterTrack) -> dict[str, Any]:
    """Return one parameter over the calibrations as a JSON object."""
    return {
        "symbol": track.symbol, "unit": track.unit, "values": track.values, "sigmas": track.sigmas,
        "predicted": track.predicted, "predicted_sigmas": track.predicted_sigma, "level": track.level,
        "level_sigma": track.level_sigma, "drift": track.drift, "drift_sigma": track.drift_sigma,
        "repeatability": track.repeatability, "walk": track.walk, "constant_p": track.constant_p,
    }  # fmt: skip


def history_report(history: History) -> RenderableType:
    """The report of ``history``."""
    of = f" of {history.serial}" if history.serial else ""
    first, last = history.dates[0].date(), history.dates[-1].date()
    parts: list[RenderableType] = [Text(f"{len(history.dates)} calibrations{of}, {first} to {last}.", style="bold")]
    table = ConsoleTable(
        title="Change over the calibrations (1σ; p: that a constant differs so much)", title_justify="left"
    )
    for heading in ("parameter", "last less first", "drift a year", "repeatability", "walk in a year", "unit", "p"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for track in history.tracks:
        table.add_row(*_track_row(track))
    parts.append(table)
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
        value, sigma = unit.rounded(track.drift * year, track.drift_sigma * year)
        drift = f"{value} ± {sigma}"
    change = unit.number(float(track.values[-1] - track.values[0]))
    return [
        symbol(track.symbol), change if change.startswith("-") else f"+{change}", drift,
        unit.number(track.repeatability, 2), unit.number(track.walk * year**0.5, 2), unit.label,
        format_p(track.constant_p).removeprefix("= "),
    ]  # fmt: skip


def exported_object(target: Target, to: str, path: Path) -> dict[str, Any]:
    """The JSON object of ``export``."""
    left = target.error_left
    return clean(
        {
            "out": str(path),
            "format": to,
            "lost": list(target.lost),
            "left_out": target.correction.left_out,
            "takes": str(target.input),
            "to_be_done_before": target.to_be_done_before or None,
            "error_left_rms_mps2": None if left is None else left.rms_mps2,
            "error_left_worst_mps2": None if left is None else left.worst_mps2,
            "warnings": [*target.remarks, *(target.noise.remarks if target.noise else ())],
        }
    )


def exported_report(target: Target, path: Path) -> RenderableType:
    """The report of ``export``."""
    lines = [Text(f"{path} is the calibration for {target.title}.", style="bold")]
    if not target.correction.input.is_plain:
        lines.append(Text(f"It takes {target.input}."))
    if target.to_be_done_before:
        lines.append(note(f"to be made before of what the device sends: {target.to_be_done_before}"))
    if target.error_left is None:
        lines.append(Text("It holds all of it."))
    else:
        unit, (rms, worst) = shown("m/s^2"), target.error_left
        lines.append(note(f"it does not hold {', '.join(target.lost)}: corrected readings are wrong by "
                          f"{unit.text(rms)} rms, {unit.text(worst)} at worst"))  # fmt: skip
    lines += [note(f"{name} is not corrected: {why}") for name, why in target.correction.left_out.items()]
    return Group(*lines, *map(note, [*target.remarks, *(target.noise.remarks if target.noise else ())]))


def calibration_object(saved: SavedCalibration, path: Path) -> dict[str, Any]:
    """The JSON object of ``info`` of a calibration: what the file holds, and what it takes."""
    return clean({"file": str(path), "kind": "calibration", "input": str(saved.bench.input), **saved.model_dump()})


def calibration_report(saved: SavedCalibration, path: Path) -> RenderableType:
    """The report of ``info`` of a calibration."""
    table = ConsoleTable(title="Parameters (1σ)", title_justify="left")
    for heading in ("parameter", "value", "less nominal", "sigma", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for k, parameter in enumerate(saved.parameters):
        field = field_unit(parameter.unit)
        row = Parameter(**parameter.model_dump(), shown_unit=field.label, per_si=field.per_si)
        table.add_row(*parameter_row(row, saved.fixed.get(parameter.symbol, "")), end_section=k in (3, 7, 11))
    lines = [Text(f"{path}: a calibration, {saved.summary}.", style="bold"), Text(f"It takes {saved.bench.input}.")]
    commands = Text(f"Try: kf-calib apply {path} RECORDING -o OUT, or certificate, export, verify, history.")
    return Group(*lines, table, Text(_agreement(saved)), *map(note, saved.provenance.warnings), commands)


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


def certificate_object(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, path: Path, xml: Path | None
) -> dict[str, Any]:
    """The JSON object of ``certificate``."""
    return clean(
        {
            "out": str(path),
            "xml": None if xml is None else str(xml),
            "xml_check": standing,
            "number": certificate.statement.number,
            "not_stated": list(certificate.missing),
            "decision_rule": certificate.statement.decision_rule,
            "parameters": [_result_object(each) for each in certificate.results],
            "budget": [_line_object(line) for line in certificate.budget.contributions],
            "left_out": list(certificate.budget.left_out),
            "covariance": None if certificate.twelve is None else certificate.twelve[1].tolist(),
            "intrinsic": [_intrinsic_object(each) for each in certificate.intrinsic],
            "monte_carlo": None
            if check is None
            else {"draws": check.draws, "expanded": check.expanded.tolist(), "agrees": list(check.agrees)},
        }
    )


def _intrinsic_object(result: CertifiedResult) -> dict[str, Any]:
    return {key: value for key, value in _result_object(result).items()
            if key not in ("before", "limit", "conformity")}  # fmt: skip


def _result_object(result: CertifiedResult) -> dict[str, Any]:
    return {
        "symbol": result.symbol, "value": result.value, "unit": result.unit, "nominal": result.nominal,
        "standard": result.standard, "expanded": result.expanded, "k": result.k, "dof": result.dof,
        "before": None if result.before is None else list(result.before),
        "limit": result.limit, "conformity": result.conformity,
    }  # fmt: skip


def _line_object(line: Contribution) -> dict[str, Any]:
    return {
        "symbol": line.name, "title": line.title, "kind": line.kind, "standard": line.standard, "unit": line.unit,
        "distribution": line.distribution, "dof": line.dof, "source": line.source,
        "sensitivity": None if line.sensitivity is None else line.sensitivity.tolist(),
        "contribution": line.parts.tolist(),
    }  # fmt: skip


def certificate_report(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, pdf: Path, xml: Path | None
) -> RenderableType:
    """The report of ``certificate``."""
    from kf_calib.exchange.certificate.budget import OUTCOMES  # loaded already by what makes certificates

    with_conformity = any(result.conformity for result in certificate.results)
    table = ConsoleTable(title="Uncertainty (type A and type B: standard; U = k u)", title_justify="left")
    drawn = ["U by Monte Carlo"] if check else []
    judged = ["conformity"] if with_conformity else []
    for heading in ("parameter", "type A", "type B", "U", *drawn, "k", "unit", *judged):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "conformity") else "right")
    first, combined = certificate.budget.contributions[0].parts, certificate.budget.combined
    for i, result in enumerate(certificate.results):
        unit = shown(result.unit)
        other = max(combined[i] ** 2 - first[i] ** 2, 0.0) ** 0.5
        by_draws = [] if check is None else [unit.number(float(check.expanded[i]), 2)]
        row = [symbol(result.symbol), *(unit.number(u, 2) for u in (first[i], other)),
               "" if result.expanded is None else unit.number(result.expanded, 2),
               *by_draws, f"{result.k:.2f}", unit.label]  # fmt: skip
        table.add_row(
            *row, *([OUTCOMES[result.conformity] if result.conformity else "not judged"] if with_conformity else [])
        )
    lines = [note(f"not stated, and left blank: {', '.join(certificate.missing)}")] if certificate.missing else []
    saved = [Text(f"saved {path}") for path in (pdf, xml) if path is not None]
    parts: list[RenderableType] = [table]
    if certificate.intrinsic:
        parts.append(_intrinsic_table(certificate.intrinsic))
    return Group(*parts, *_drawn(certificate, check), Text(f"XML: {standing}."), *lines, *saved)


def _intrinsic_table(results: Sequence[CertifiedResult]) -> ConsoleTable:
    """Return the table of the nine that no choice of a frame changes."""
    title = "Intrinsic: sensitivities, angles between the input axes, offsets"
    table = ConsoleTable(title=title, title_justify="left")
    for heading in ("parameter", "less nominal", "U", "k", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for k, result in enumerate(results):
        unit = shown(result.unit)
        assert result.value is not None and result.expanded is not None
        value, _ = unit.rounded(result.value - result.nominal, result.expanded)
        table.add_row(symbol(result.symbol), value, unit.number(result.expanded, 2), f"{result.k:.2f}", unit.label,
                      end_section=k % 3 == 2)  # fmt: skip
    return table


def _drawn(certificate: Certificate, check: MonteCarloCheck | None) -> list[RenderableType]:
    """Return what a Monte Carlo check says of the budget, in a sentence."""
    if check is None:
        return []
    apart = [symbol(each.symbol) for each, agrees in zip(certificate.results, check.agrees, strict=True) if not agrees]
    how = f"to half of the second digit of u, by {check.draws} draws (JCGM 101)"
    if not apart:
        return [Text(f"U of all parameters is confirmed {how}.")]
    return [note(f"U of {', '.join(apart)} is not confirmed {how}: quote U by Monte Carlo for these")]
