"""How a bench drove itself, by the records of its recording: a section of the report."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Group
from rich.text import Text

from kf_calib.report.contents import Measured, in_text
from kf_calib.report.page import Section
from kf_calib.sources.files.record_files import angles_of, number_of
from kf_calib.support.text import angles_in_words
from kf_calib.support.units import span
from kf_calib.views.terminal import table


def section_of(measured: Measured) -> Section:
    """The decisions of a bench that drove itself; a section without parts where a person chose."""
    rows = list[tuple[str, ...]]()
    for record in measured.decisions:
        angles = angles_of(record.get("gimbal_deg", ""))
        where = ", ".join(f"{angle:g}" for angle in angles)
        stay = span(number_of(record, "stay_s")) if angles else ""
        after = span(number_of(record, "at_s"))
        rows.append((record.get("number", ""), after, where, stay, record.get("why", "")))
    decisions = table("", ("", "after", "gimbals, deg", "stay", "why"), rows)
    told = Group(decisions, *(Text(_end_in_words(record)) for record in measured.ends[-1:]))
    return Section("How the bench drove itself", in_text(told) if measured.decisions else ())


def _end_in_words(record: Mapping[str, str]) -> str:
    """Return how a run ended, by its record."""
    ended, why = record.get("ended", ""), record.get("why", "")
    where = angles_in_words(angles_of(record.get("stands_at_deg", "")))
    lasted = span(number_of(record, "lasted_s"))
    return f"The run ended ({ended}) after {lasted}: {why}. The table stands at {where}."
