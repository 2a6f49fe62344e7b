"""What ``info`` says of a calibration that was saved: as a report, and as a JSON object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.estimation.parameters import Parameter
from kf_calib.estimation.results import format_p
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.support.units import field_unit
from kf_calib.views.console import parameter_row
from kf_calib.views.json import clean
from kf_calib.views.tables import Table
from kf_calib.views.terminal import note


def calibration_object(saved: SavedCalibration, path: Path) -> dict[str, Any]:
    """The JSON object of ``info`` of a calibration: what the file holds, and what it takes."""
    return clean({"file": str(path), "kind": "calibration", "input": str(saved.bench.input), **saved.model_dump()})


def calibration_report(saved: SavedCalibration, path: Path) -> RenderableType:
    """The report of ``info`` of a calibration."""
    table = Table(title="Parameters (1σ)", title_justify="left")
    for heading in ("parameter", "value", "less nominal", "sigma", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for k, parameter in enumerate(saved.parameters):
        field = field_unit(parameter.unit)
        row = Parameter(**parameter.model_dump(), shown_unit=field.label, per_si=field.per_si)
        table.add_row(*parameter_row(row, saved.fixed.get(parameter.symbol, "")), end_section=k in (3, 7, 11))
    lines = [Text(f"{path}: a calibration, {saved.summary}.", style="bold"), Text(f"It takes {saved.bench.input}.")]
    return Group(*lines, table, Text(_agreement(saved)), *map(note, saved.provenance.warnings), _commands(path))


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


def _commands(path: Path) -> Text:
    """Return what can be done with the calibration."""
    return Text(f"Try: kf-calib apply {path} RECORDING -o OUT, or certificate, export, verify, history.")
