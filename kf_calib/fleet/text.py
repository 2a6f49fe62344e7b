"""What many runs come to together as a report and as a JSON object, and how units and chances are written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.diagnosis.verdict import format_probability
from kf_calib.fleet.batch import BatchProgress
from kf_calib.fleet.overview import FleetOverview, Track
from kf_calib.fleet.pooled_diagnosis import EffectRow, Finding, PooledDiagnosis, PooledEstimate
from kf_calib.fleet.pooled_terms import Attribution
from kf_calib.fleet.results import Fleet
from kf_calib.support.units import shown
from kf_calib.views.json import members
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import ConsoleTable, note, table

_OF = {
    Attribution.BENCH: "of the bench",
    Attribution.REPAIRED: "of the bench, changed once",
    Attribution.SENSORS: "of the type of sensor",
    Attribution.SOME: "of some units",
    Attribution.RUN: "of single runs",
}
_LISTED = 12  # units that are named in a sentence
_HAS_IT = 0.5  # probability above which a unit is taken to have an effect
_LEAST_PROBABILITY = 0.01  # probability below which an effect that was not found is not shown


_BORNE_BY = {
    Attribution.BENCH: "bench",
    Attribution.REPAIRED: "bench",
    Attribution.SENSORS: "type",
    Attribution.SOME: "units",
    Attribution.RUN: "runs",
}


def pooled_objects(diagnosed: PooledDiagnosis) -> list[dict[str, Any]]:
    """The JSON objects of a pooled diagnosis, one an effect; those that were found come first."""
    findings = {each.effect: each for each in diagnosed.findings}
    return [_pooled_object(row, findings.get(row.effect)) for row in diagnosed.effects]


def _pooled_object(row: EffectRow, finding: Finding | None) -> dict[str, Any]:
    shares, people = row.probabilities or {}, finding.population if finding else None
    means = [("units", None, each) for each in (people.mean if people else ())]
    of_benches = [(each.bench, each.since, value) for each in row.benches for value in each.coefficients]
    return {
        "effect": row.effect,
        "borne_by": _BORNE_BY[finding.attribution] if finding else None if row.no_one is None else "none",
        "probability": shares[finding.attribution] if finding else row.no_one,
        "probabilities": {each.value: share for each, share in shares.items()},
        "rivals": finding.rivals if finding else {},
        "coefficients": [{"of": of, "since": since, **vars(each)} for of, since, each in [*of_benches, *means]],
        "spread": people.spread if people else None,
        "spread_interval": people.spread_interval if people else None,
        "share": finding.share if finding else None,
        "share_interval": finding.share_interval if finding else None,
        "units": finding.units if finding else [],
        "changed": finding.repair.gaps if finding and finding.repair else [],
    }  # fmt: skip


def pooled_report(pooled: PooledDiagnosis) -> RenderableType:
    """A pooled diagnosis for a console: what was found, the probabilities, and the coefficients."""
    parts: list[RenderableType] = [Text(sentence) for sentence in sentences(pooled)]
    rows = [row for row in pooled.effects if row.no_one is not None and row.no_one < 1.0 - _LEAST_PROBABILITY]
    if rows:
        parts.append(_probabilities(rows))
    return Group(*parts, *(_coefficients(each) for each in pooled.findings))


def sentences(pooled: PooledDiagnosis) -> list[str]:
    """A pooled diagnosis in sentences: what the runs show, and of what each effect is."""
    return [_summary(pooled), *map(_sentence, pooled.findings)]


def _summary(pooled: PooledDiagnosis) -> str:
    benches = f"{len(pooled.benches)} bench{'es' if len(pooled.benches) != 1 else ''}"
    names = ", ".join(each.effect for each in pooled.findings) or "no effect"
    other = "nothing else is missing" if pooled.findings else "nothing is missing"
    sure = format_probability(pooled.no_more)
    return f"{pooled.runs} runs of {pooled.units} units on {benches} show {names} ({sure}: {other})."


def _sentence(finding: Finding) -> str:
    """Return what one effect is of, in a sentence."""
    chance = finding.probabilities[finding.attribution]
    share = format_probability(chance)
    if finding.attribution is Attribution.RUN:
        sentence = f"{finding.effect} occurs in single runs, in each by another amount ({share})"
        beyond_doubt = [each.unit for each in finding.units if each.is_seen]
        sentence += f": {_listed(beyond_doubt)}" if beyond_doubt else ""
    else:
        sentence = f"{finding.effect} is {_OF[finding.attribution]} ({share})"
    if finding.attribution is Attribution.SOME and finding.share_interval is not None:
        low, high = finding.share_interval
        having = [each.unit for each in finding.units if each.probability > _HAS_IT]
        reach = "" if f"{low:.0%}" == f"{high:.0%}" else f" ({low:.0%} to {high:.0%})"
        sentence += f": {finding.share:.0%} of the units have it{reach}, most likely {_listed(having)}"
    if finding.repair is not None:
        gap = finding.repair.gaps[0]
        sentence += f": it changed between {_moment(gap.after) or gap.after_run} and "
        sentence += _moment(gap.before) or gap.before_run
        sentence += f" ({format_probability(gap.probability)})"
    rivals = [f"{name} ({format_probability(share)})" for name, share in finding.rivals.items()]
    return f"{sentence}. In its place it may be {' or '.join(rivals)}." if rivals else f"{sentence}."


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "") if names else "none for certain"


def _probabilities(rows: Sequence[EffectRow]) -> ConsoleTable:
    """Return the table of the probabilities of each attribution."""
    tried = [each for each in Attribution if any(each in (row.probabilities or {}) for row in rows)]
    shares = [[*((row.probabilities or {}).get(each, 0.0) for each in tried), row.no_one or 0.0] for row in rows]
    cells = [(row.effect, *map(format_probability, own)) for row, own in zip(rows, shares, strict=True)]
    headings = "effect", *(f">{_OF[attribution]}" for attribution in tried), ">of nothing"
    return table("What has each effect, and with what probability", headings, cells)


def _coefficients(finding: Finding) -> ConsoleTable:
    """Return the table of the coefficients of one effect."""
    rows = list[tuple[str, ...]]()
    for bench in finding.benches:
        name = bench.bench or "the bench"
        rows += _rows(f"{name}, since {_moment(bench.since)}" if bench.since else name, bench.coefficients)
    if not finding.benches and finding.population is None:
        for unit_figures in finding.units:
            if unit_figures.probability > _HAS_IT:
                rows += _rows(unit_figures.unit, unit_figures.coefficients)
    if finding.population is not None:
        rows += _rows("mean of the units", finding.population.mean)
        unit = shown(finding.population.mean[0].unit)
        low, high = map(unit.number, finding.population.spread_interval)
        rows.append(("spread", "", unit.number(finding.population.spread), f"{low} to {high}", unit.label))
    title = f"{finding.effect}, {_OF[finding.attribution]} (1σ)"
    return table(title, ("of", "coefficient", ">value", ">sigma", "unit"), rows)


def _moment(date: str) -> str:
    """A date to the minute."""
    return date[:16].replace("T", " ")


def _rows(name: str, values: Sequence[PooledEstimate]) -> Iterator[tuple[str, ...]]:
    """A row for each coefficient."""
    for k, coefficient in enumerate(values):
        cells = ("not seen", "")
        if coefficient.value is not None and coefficient.sigma is not None:
            value, sigma = shown(coefficient.unit).rounded(coefficient.value, coefficient.sigma)
            cells = value, f"± {sigma}"
        yield "" if k else name, symbol(coefficient.symbol), *cells, shown(coefficient.unit).label


_SHOWN = 6


def fleet_object(
    fleet: Fleet, done: BatchProgress, overview: FleetOverview, bench_models: Sequence[Path]
) -> dict[str, Any]:
    """The JSON object of ``fleet``."""
    failures = fleet.failures()
    return {
        "fleet": fleet.path,
        "runs": len(fleet),
        "failed": len(failures),
        **members(done, "evaluated", "kept", "cpu_s"),
        "units": fleet.distinct("unit"),
        "benches": fleet.distinct("bench"),
        "verdicts": fleet.verdicts(),
        "parameters": [members(each, "symbol", "unit", "nominal") | each.of_runs for each in overview.tracks],
        "failures": [{"run": run, "error": error} for run, error in failures.items()],
        "pooled": pooled_objects(overview.pooled) if overview.pooled else None,
        "bench_models": bench_models,
        "another_look": overview.looks,
        "remarks": [*done.notes, *overview.remarks],
    }


def fleet_report(fleet: Fleet, done: BatchProgress, overview: FleetOverview) -> RenderableType:
    """The report of ``fleet``."""
    failures = fleet.failures()
    counts = ", ".join(f"{count} {verdict}" for verdict, count in fleet.verdicts().items())
    cost = f", {done.cpu_s / done.evaluated:.2g} s of processor time each" if done.evaluated else ""
    parts: list[RenderableType] = [
        Text(f"{len(fleet)} runs in {fleet.path}: {counts}.", style="bold"),
        Text(f"{done.evaluated} evaluated now{cost}; {done.kept} were there already."),
        *([_population_table(overview.tracks)] if overview.tracks else []),
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
    rows = [(short_name(each.unit), chance_words(each.chance), each.why) for each in overview.looks[:_SHOWN]]
    if len(overview.looks) > _SHOWN:
        rows.append((f"{len(overview.looks) - _SHOWN} more", "", ""))
    return table("Units that need another look first", ("unit", ">chance by noise", "why"), rows)


def _population_table(tracks: Sequence[Track]) -> ConsoleTable:
    rows = list[tuple[str, ...]]()
    for track in tracks:
        unit, of_runs = shown(track.unit), track.of_runs
        values = of_runs["median"] - track.nominal, of_runs["spread"], of_runs["sigma"]
        cells = (unit.number(value, 3) for value in values)
        rows.append((symbol(track.symbol), str(of_runs["runs"]), *cells, unit.label))
    headings = "parameter", ">runs", ">median less nominal", ">spread", ">sigma of a run", "unit"
    return table("Parameters over the runs (spread, sigma: 1σ)", headings, rows)


_LEAST = 1e-6


def short_name(unit: str) -> str:
    """The name of a unit; of one that goes by its recording, the name of the file."""
    return unit.rsplit("/", 1)[-1] if unit.startswith("/") or "://" in unit else unit


def chance_words(chance: float) -> str:
    """A chance, for a reader who asks no more than how small it is."""
    return f"{chance:.1g}" if chance >= _LEAST else f"< {_LEAST:.0e}"
