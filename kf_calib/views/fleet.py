"""The runs of a fleet as a summary, and as a JSON object; how units and chances of a fleet are written in tables and
figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.fleet.batch import BatchProgress
from kf_calib.fleet.overview import FleetOverview
from kf_calib.fleet.results import Fleet, ParameterPopulation
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.pooled_diagnosis import pooled_objects, pooled_report
from kf_calib.views.tables import ConsoleTable
from kf_calib.views.terminal import note

_SHOWN = 6
_REASONS = 2


def fleet_object(
    fleet: Fleet,
    populations: Sequence[ParameterPopulation],
    done: BatchProgress,
    overview: FleetOverview,
    bench_models: Sequence[Path],
) -> dict[str, Any]:
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
            "pooled": pooled_objects(overview.pooled) if overview.pooled else None,
            "bench_models": [str(path) for path in bench_models],
            "another_look": [vars(each) for each in overview.looks],
            "remarks": [*done.notes, *overview.remarks],
        }
    )


def fleet_report(
    fleet: Fleet,
    populations: Sequence[ParameterPopulation],
    done: BatchProgress,
    overview: FleetOverview,
) -> RenderableType:
    """The report of ``fleet``."""
    failures = fleet.failures()
    counts = ", ".join(f"{count} {verdict}" for verdict, count in fleet.verdicts().items())
    cost = f", {done.cpu_s / done.evaluated:.2g} s of processor time each" if done.evaluated else ""
    parts: list[RenderableType] = [
        Text(f"{len(fleet)} runs in {fleet.path}: {counts}.", style="bold"),
        Text(f"{done.evaluated} evaluated now{cost}; {done.kept} were there already."),
        *([_population_table(populations)] if populations else []),
    ]
    parts += [note(said) for said in done.notes]
    parts += [note(error if run in error else f"{run}: {error}") for run, error in [*failures.items()][:_SHOWN]]
    if len(failures) > _SHOWN:
        parts.append(note(f"{len(failures) - _SHOWN} more runs failed: the column error of the table says why"))
    parts += [pooled_report(overview.pooled)] if overview.pooled else []
    parts += [look_table(overview)] if overview.looks else []
    return Group(*parts, *(note(said) for said in overview.remarks))


def look_table(overview: FleetOverview) -> ConsoleTable:
    """The units that need another look first, with the reasons."""
    table = ConsoleTable(title="Units that need another look first", title_justify="left")
    for heading in ("unit", "chance by noise", "why"):
        table.add_column(heading, justify="right" if heading == "chance by noise" else "left")
    for each in overview.looks[:_SHOWN]:
        more = [f"{len(each.reasons) - _REASONS} more"] if len(each.reasons) > _REASONS else []
        table.add_row(short_name(each.unit), chance_words(each.chance), "; ".join([*each.reasons[:_REASONS], *more]))
    if len(overview.looks) > _SHOWN:
        table.add_row(f"{len(overview.looks) - _SHOWN} more", "", "")
    return table


def _population_table(populations: Sequence[ParameterPopulation]) -> ConsoleTable:
    table = ConsoleTable(title="Parameters over the runs (spread, sigma: 1σ)", title_justify="left")
    for heading in ("parameter", "runs", "median less nominal", "spread", "sigma of a run", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for population in populations:
        unit = shown(population.unit)
        cells = (
            unit.number(value, 3)
            for value in (population.median - population.nominal, population.spread, population.sigma)
        )
        table.add_row(symbol(population.symbol), str(population.runs), *cells, unit.label)
    return table


_LEAST = 1e-6


def short_name(unit: str) -> str:
    """The name of a unit; of one that goes by its recording, the name of the file."""
    return unit.rsplit("/", 1)[-1] if unit.startswith("/") or "://" in unit else unit


def chance_words(chance: float) -> str:
    """A chance, for a reader who asks no more than how small it is."""
    return f"{chance:.1g}" if chance >= _LEAST else f"< {_LEAST:.0e}"
