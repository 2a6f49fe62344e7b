"""A fleet in one page of Markdown: what was found, errors of the bench, units to look at, and what is not drawn."""

from __future__ import annotations

import numpy as np

from kf_calib.fleet.overview import FleetOverview
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, Finding, PooledEstimate
from kf_calib.support.units import shown
from kf_calib.views.fleet_words import chance_words, day, short_name
from kf_calib.views.pooled_diagnosis import sentences
from kf_calib.views.rerun.fleet_thinned import every
from kf_calib.views.rerun.names import label_of

_LISTED = 20
_REASONS = 2


def summary(found: FleetOverview) -> str:
    """The page in Markdown, in the units that people are shown."""
    blocks = [_head(found), *_found(found), *_benches(found), *_looks(found), *_targets(found)]
    return "\n\n".join([*blocks, *(f"**Note**: {said}" for said in [*found.remarks, *_left_out(found)])]) + "\n"


def _head(found: FleetOverview) -> str:
    dates = f", {day(found.first)} to {day(found.last)}" if found.first and found.last else ""
    benches = f" on {_counted(len(found.benches), 'bench', 'benches')}" if found.benches else ""
    fail = f"{found.inconsistent} do not fit their model, {found.failed} failed"
    return f"**{_counted(found.runs, 'run')}** of {_counted(len(found.units), 'unit')}{benches}{dates}; {fail}."


def _counted(count: int, one: str, many: str = "") -> str:
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def _found(found: FleetOverview) -> list[str]:
    if found.pooled is None:
        return []
    return ["**Together**: " + "\n\n".join(_plain(said) for said in sentences(found.pooled))]


def _benches(found: FleetOverview) -> list[str]:
    """The errors of each bench as a table."""
    terms = [each for each in (found.pooled.findings if found.pooled else ()) if each.benches]
    rows = [row for term in terms for bench in term.benches for row in _rows(term, bench)]
    return ["\n".join(["| error of the bench | | | value ± σ | |", "|:--|:--|:--|--:|:--|", *rows])] if rows else []


def _rows(term: Finding, bench: BenchCoefficients) -> list[str]:
    since = f" since {bench.since[:10]}" if bench.since else ""
    names = [(_plain(term.effect), _plain(f"{bench.bench or 'the bench'}{since}"))]
    return [f"| {effect} | {of} | {_plain(label_of(each.symbol))} | {_value(each)} | {shown(each.unit).label} |"
            for each, (effect, of) in zip(bench.coefficients, [*names, *[("", "")] * len(bench.coefficients)],
                                          strict=False)]  # fmt: skip


def _value(each: PooledEstimate) -> str:
    if each.value is None or each.sigma is None:
        return "not seen"
    value, sigma = shown(each.unit).rounded(each.value, each.sigma)
    return f"{value} ± {sigma}".replace("-", "−")


def _looks(found: FleetOverview) -> list[str]:
    """The units that need another look first; a list, as lines of a table are cut where a panel ends."""
    if not found.looks:
        return ["No unit needs another look."]
    rows = list[str]()
    for look in found.looks[:_LISTED]:
        more = [f"{len(look.reasons) - _REASONS} more"] if len(look.reasons) > _REASONS else []
        why = _plain("; ".join([*look.reasons[:_REASONS], *more]))
        rows.append(f"- **{_plain(short_name(look.unit))}** ({_plain(chance_words(look.chance))}): {why}")
    if len(found.looks) > _LISTED:
        rows.append(f"- {len(found.looks) - _LISTED} more")
    head = "**Units that need another look first** (chance that it is noise):"
    return ["\n".join([head, "", *rows])]


def _targets(found: FleetOverview) -> list[str]:
    """In how many runs each target was reached."""
    return [
        f"**Target** σ({label_of(track.symbol)}) ≤ {shown(track.unit).text(track.target)}: reached in "
        f"{int(np.sum(track.sigmas <= track.target))} of {_counted(len(track.sigmas), 'run')}."
        for track in found.tracks if track.target is not None
    ]  # fmt: skip


def _left_out(found: FleetOverview) -> list[str]:
    """What is not drawn."""
    out = list[str]()
    if found.weeks.undated:
        out.append(f"{_counted(found.weeks.undated, 'run')} without a date cannot be drawn by date.")
    most = max((len(track.values) for track in found.tracks), default=0)
    for count, what in ((most, "run"), (len(found.units), "unit")):
        if every(count) > 1:
            out.append(f"of each parameter one {what} in {every(count)} is drawn, and all that lie outside.")
    return out


def _plain(text: str) -> str:
    """A text that Markdown takes for what it is, in a table too."""
    return " ".join("".join(f"\\{each}" if each in "|*_`<[\\" else each for each in text).split())
