"""The runs of a fleet as a summary, and as a JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.fleet.batch import Progress
from kf_calib.fleet.results import Fleet, Population
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import Table
from kf_calib.views.terminal import note

_SHOWN = 6


def fleet_object(fleet: Fleet, populations: Sequence[Population], done: Progress) -> dict[str, Any]:
    """The JSON object of ``fleet``."""
    failures = fleet.failures()
    return clean(
        {
            "fleet": str(fleet.path),
            "runs": len(fleet),
            "failed": len(failures),
            "evaluated": done.evaluated,
            "kept": done.kept,
            "cpu_s": done.cpu_s,
            "units": fleet.distinct("unit"),
            "benches": fleet.distinct("bench"),
            "verdicts": fleet.verdicts(),
            "parameters": [vars(each) for each in populations],
            "failures": [{"run": run, "error": error} for run, error in failures.items()],
        }
    )


def fleet_report(fleet: Fleet, populations: Sequence[Population], done: Progress) -> RenderableType:
    """The report of ``fleet``."""
    failures = fleet.failures()
    counts = ", ".join(f"{count} {verdict}" for verdict, count in fleet.verdicts().items())
    each = f", {done.cpu_s / done.evaluated:.2g} s of processor time each" if done.evaluated else ""
    parts: list[RenderableType] = [
        Text(f"{len(fleet)} runs in {fleet.path}: {counts}.", style="bold"),
        Text(f"{done.evaluated} evaluated now{each}; {done.kept} were there already."),
        *([_population_table(populations)] if populations else []),
    ]
    parts += [note(error if run in error else f"{run}: {error}") for run, error in [*failures.items()][:_SHOWN]]
    if len(failures) > _SHOWN:
        parts.append(note(f"{len(failures) - _SHOWN} more runs failed: the column error of the table says why"))
    return Group(*parts)


def _population_table(populations: Sequence[Population]) -> Table:
    table = Table(title="Parameters over the runs (spread, sigma: 1σ)", title_justify="left")
    for heading in ("parameter", "runs", "median less nominal", "spread", "sigma of a run", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for each in populations:
        unit = shown(each.unit)
        cells = (unit.number(value, 3) for value in (each.median - each.nominal, each.spread, each.sigma))
        table.add_row(symbol(each.symbol), str(each.runs), *cells, unit.label)
    return table
