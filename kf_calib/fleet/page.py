"""What is on the page of a fleet: what its runs come to together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import kf_calib.fleet.figures  # noqa: F401  # registers the figures of a fleet
from kf_calib.fleet import text as fleet
from kf_calib.fleet.overview import FleetOverview
from kf_calib.report.contents import figures_of, in_text, measured_section, warnings_of
from kf_calib.report.page import Agreement, Page, Section, save
from kf_calib.views.html import Paragraph


def save_page(overview: FleetOverview, commands: Sequence[str], path: Path) -> None:
    """Write the page of a fleet as one file. Raises InputError where it cannot be written."""
    save(fleet_page(overview, commands), path)


def fleet_page(overview: FleetOverview, commands: Sequence[str]) -> Page:
    """The page of a fleet. commands: what gives the numbers again, a line each."""
    together = in_text(fleet.pooled_report(overview.pooled)) if overview.pooled else ()
    said = [each.text for each in together if isinstance(each, Paragraph)]
    standing, headline = _standing_of(overview)
    return Page(
        overview.name, "Fleet report", standing, headline, tuple(said),
        (
            measured_section(_facts_of(overview)),
            figures_of("The runs together", overview, "fleet"),
            Section("Effects that all runs show", tuple(each for each in together if not isinstance(each, Paragraph))),
            warnings_of(overview.remarks),
        ), tuple(commands),
    )  # fmt: skip


def _standing_of(overview: FleetOverview) -> tuple[Agreement, str]:
    """Return whether models and measurements agree over a fleet, and in how many runs they do not."""
    if not overview.failed and not overview.inconsistent:
        return "agrees", f"{overview.runs} runs agree with their models"
    told = [
        f"{count} {word}" for count, word in ((overview.inconsistent, "disagree"), (overview.failed, "failed")) if count
    ]
    return "disagrees", f"Of {overview.runs} runs {' and '.join(told)}"


def _facts_of(overview: FleetOverview) -> list[tuple[str, str]]:
    """Return what was measured, a heading and words each."""
    dates = f"{overview.first:%Y-%m-%d} to {overview.last:%Y-%m-%d}" if overview.first and overview.last else ""
    facts = [("Runs", str(overview.runs)), ("Units", str(len(overview.units))),
             ("Benches", ", ".join(overview.benches)), ("Dates", dates)]  # fmt: skip
    return [fact for fact in facts if fact[1]]
