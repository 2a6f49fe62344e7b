"""What is on the page of a fleet: what its runs come to together."""

from __future__ import annotations

from collections.abc import Sequence

import kf_calib.views.figures.fleet  # noqa: F401  # registers the figures of a fleet
from kf_calib.fleet.overview import FleetOverview
from kf_calib.views import pooled_diagnosis
from kf_calib.views.report.contents import figures_of, in_text, warnings_of
from kf_calib.views.report.page import Facts, Page, Section, Standing
from kf_calib.views.report.parts import Paragraph


def fleet_page(found: FleetOverview, commands: Sequence[str]) -> Page:
    """The page of a fleet. commands: what gives the numbers again, a line each."""
    together = in_text(pooled_diagnosis.pooled_report(found.pooled)) if found.pooled else ()
    said = [each.text for each in together if isinstance(each, Paragraph)]
    standing, headline = _standing_of(found)
    return Page(
        found.name, "Fleet report", standing, headline, tuple(said),
        (Facts("", tuple(_facts_of(found))),),
        (
            figures_of("The runs together", found, "fleet"),
            Section("Effects that all runs show", tuple(each for each in together if not isinstance(each, Paragraph))),
            warnings_of(found.remarks),
        ), tuple(commands),
    )  # fmt: skip


def _standing_of(found: FleetOverview) -> tuple[Standing, str]:
    """Return whether models and measurements agree over a fleet, and in how many runs they do not."""
    if not found.failed and not found.inconsistent:
        return "agrees", f"{found.runs} runs agree with their models"
    told = [f"{count} {word}" for count, word in ((found.inconsistent, "disagree"), (found.failed, "failed")) if count]
    return "disagrees", f"Of {found.runs} runs {' and '.join(told)}"


def _facts_of(found: FleetOverview) -> list[tuple[str, str]]:
    """Return what was measured, a heading and words each."""
    dates = f"{found.first:%Y-%m-%d} to {found.last:%Y-%m-%d}" if found.first and found.last else ""
    every = [("Runs", str(found.runs)), ("Units", str(len(found.units))), ("Benches", ", ".join(found.benches)),
             ("Dates", dates)]  # fmt: skip
    return [each for each in every if each[1]]
