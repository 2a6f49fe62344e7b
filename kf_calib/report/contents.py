"""What is on the page of a result: what was measured, and for each kind of result its verdict, and sections of figures,
tables and words.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import singledispatch
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType

from kf_calib.diagnosis.data_sheet import DataSheet
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.results import Diagnosis, SideBySide, differences
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.engine_comparison import Comparison
from kf_calib.estimation.results import Calibration
from kf_calib.report import data_sheet
from kf_calib.report.drawing import Drawing
from kf_calib.report.explorer import Explorer, explorer
from kf_calib.report.page import Agreement, Facts, Page, PagePart, Section
from kf_calib.views import console, diagnosis, improvement
from kf_calib.views.figures import DIRECTIONS, FALL, NO_FALL, ON_THEIR_WAY, PROBABILITIES, figures
from kf_calib.views.html import Paragraph, parts_of

_PACKAGE = Path(__file__).parents[1]
_NOTES = {"block_serial": "Sensor block", "bench": "Bench", "operator": "Operator", "note": "Note"}


@dataclass(frozen=True)
class Measured:
    """The recording of a result.

    began: when its run did, where that is known. decisions, ends: records of a bench that drove itself.
    """

    name: str
    sha256: str
    began: datetime | None = None
    decisions: Sequence[Mapping[str, str]] = ()
    ends: Sequence[Mapping[str, str]] = ()

    @property
    def date(self) -> str:
        """When it was begun, in words; empty where nothing tells."""
        return "" if self.began is None else f"{self.began:%Y-%m-%d %H:%M:%S} UTC"


def facts(measured: Measured, result: Calibration) -> list[tuple[str, str]]:
    """What was measured, a heading and words each."""
    return [each for each in _facts(measured, result) if each[1]]


def _facts(measured: Measured, result: Calibration) -> Iterator[tuple[str, str]]:
    bench, counts = result.bench, result.counts
    dwells = result.fit.dwells
    yield "Recording", measured.name
    yield "SHA-256", measured.sha256
    yield "Begun", measured.date
    for key, words in _NOTES.items():
        yield words, bench.notes.get(key, "")
    used = counts.used - counts.gated
    yield "Readings", f"{used} of {counts.read} used; {counts.moving} moving, {counts.settling} settling"
    last = dwells[-1].end_s
    yield "Dwells", f"{len(dwells)} in {len(orientations(dwells))} orientations, over {_duration(last)}"
    yield "Gimbals", _gimbals(result)
    yield "Gravity", f"{bench.gravity_mps2:.7g} m/s²"
    yield "Setting of angles", _stated(bench.angle_sigma_deg, "deg") if bench.angles else ""
    yield "Scatter from dwell to dwell", _stated(bench.scatter_sigma_mps2, "m/s²")
    yield "Model", result.model.sum


def _duration(seconds: float) -> str:
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {left} s" if minutes else f"{left} s"


def _gimbals(result: Calibration) -> str:
    bench = result.bench
    if not bench.angles:
        return "no angles are used; the frame is that of the sensors"
    said = bench.to_metadata()
    axes = f"axes {said['axes']}, outer to inner" if bench.axes else "attitude recorded"
    held = "held in inertial space" if bench.reference == "inertial" else "angles relative to the bench"
    return f"{axes}; {held}; {said.get('up', 'y')} is up where all angles are zero"


def _stated(sigma: float | None, unit: str) -> str:
    return "estimated from the run where it can be" if sigma is None else f"stated: {sigma:.3g} {unit}, 1σ"


MEASURED = "What was measured"
"""Title of the section of recordings, benches and noise."""
_EXPLORED = 3
"""Explanations, at most, of which the explorer offers what they leave."""


def page_of(result: Any, measured: Sequence[Measured], commands: Sequence[str], remarks: Sequence[str] = ()) -> Page:
    """The page of a result.

    measured: its recordings, one or two. commands: what gives the numbers again, a line each. remarks: sentences that
    go with the verdict.
    """
    page = _page(result, measured)
    return replace(page, verdict=(*page.verdict, *remarks), commands=tuple(commands))


@singledispatch
def _page(result: Any, measured: Sequence[Measured]) -> Page:
    """Return the same without commands and remarks."""
    raise TypeError(f"there is no report of {type(result).__name__}: give what diagnose, improve or compare returns, "
                    "or two diagnoses side by side.")  # fmt: skip


@_page.register
def _(diagnosed: Diagnosis, measured: Sequence[Measured]) -> Page:
    return Page(
        measured[0].name, "Calibration report", *_HEADLINES[diagnosed.test.consistent],
        (diagnosis.verdict(diagnosed),),
        (
            figures_of("Probabilities", diagnosed, "likely", [PROBABILITIES]),
            measured_section(facts(measured[0], diagnosed.before)),
            figures_of("Residuals", diagnosed, "found", less=[PROBABILITIES]),
            Section("Explore the residuals", (_explorer_of(diagnosed),)),
            Section("Parameters", (*_tables(diagnosed.before), *_with_what_is_missing(diagnosed))),
            figures_of("The calibration", diagnosed.before, "run", less=[ON_THEIR_WAY, DIRECTIONS]),
            Section("Suspects, and what this run could show", _evidence(diagnosed)),
            *_of_leaves(measured[0]),
            warnings_of(diagnosed.before.warnings),
        ),
    )  # fmt: skip


@_page.register
def _(state: Improvement, measured: Sequence[Measured]) -> Page:
    start, last, steps = state.start.before, state.result, improvement.progress(state)
    explanation = Explanation(state.effects, start, last)
    explained = {f"{last.model.sum}": explanation.unexplained_mps2} if state.steps else {}
    fall = figures_of("The error, step by step", state, "fall", [FALL, NO_FALL])
    return Page(
        measured[0].name, "Improvement of the model", *_HEADLINES[state.diagnosis.test.consistent],
        tuple(improvement.story(state)),
        (
            Section(fall.title, (*fall.parts, *in_text(steps))),
            measured_section(facts(measured[0], last)),
            figures_of("Residuals", state, "steps", less=[FALL, NO_FALL]),
            Section("Explore the residuals", (explorer(start, explained, explanation.shapes),)),
            Section("Parameters with the last model", in_text(improvement.last_parameters(state))),
            figures_of("The calibration with the last model", last, "run", less=[ON_THEIR_WAY]),
            Section("What is left, and what this run could show", _evidence(state.diagnosis)),
            warnings_of(state.warnings),
        ),
    )  # fmt: skip


@_page.register
def _(compared: Comparison, measured: Sequence[Measured]) -> Page:
    result = compared.result
    said = f"Filter, filterpy and batch least squares differ by at most {compared.max_difference_sigma:.1e} σ."
    return Page(
        measured[0].name, "Filter against batch", *_HEADLINES[result.consistency.consistent],
        (said, console.verdict(result)),
        (
            measured_section(facts(measured[0], result)),
            Section("Time, memory and difference", in_text(console.comparison_table(compared), with_notes=True)),
            figures_of("Figures of the comparison", compared, "compared"),
            Section("Parameters", _calibrated(result)),
            Section("Explore the residuals", (explorer(result, {}),)),
            figures_of("The calibration", result, "run"),
            warnings_of(result.warnings),
        ),
    )  # fmt: skip


@_page.register
def _(pair: SideBySide, measured: Sequence[Measured]) -> Page:
    both = pair.first, pair.second
    recordings = [measured[0], measured[-1]]
    names = [each.before.model.sum if pair.same_recording else own.name
             for each, own in zip(both, recordings, strict=True)]  # fmt: skip
    told = [f"{name}: {diagnosis.verdict(each)}" for name, each in zip(names, both, strict=True)]
    table = console.difference_table(pair.differences, names[0], names[1])
    standing, headline = _HEADLINES[pair.second.test.consistent]
    measurements = [("" if pair.same_recording else name, tuple(facts(own, each.before)))
                    for name, own, each in zip(names, recordings, both, strict=True)]  # fmt: skip
    return Page(
        measured[0].name if pair.same_recording else f"{names[1]} beside {names[0]}", "Side by side",
        standing, f"{names[1]}: {headline[0].lower()}{headline[1:]}",
        (console.difference_in_words(pair), *told),
        (
            Section("Difference of the parameters", tuple(parts_of(table))),
            Section(MEASURED, (Facts(tuple(measurements[1:] if pair.same_recording else measurements)),)),
            *(_run(name, each, f"found{k}-") for k, (name, each) in enumerate(zip(names, both, strict=True))),
        ),
    )  # fmt: skip


def with_data_sheet(page: Page, sheet: DataSheet) -> Page:
    """The page with a data sheet after its tables of parameters, or at the end."""
    section = Section(data_sheet.TITLE, in_text(data_sheet.data_sheet_report(sheet)))
    places = [k for k, each in enumerate(page.sections) if each.title.startswith("Parameters")]
    at = places[0] + 1 if places else len(page.sections)
    return replace(page, sections=(*page.sections[:at], section, *page.sections[at:]))


def measured_section(rows: Iterable[tuple[str, str]]) -> Section:
    """The section of what was measured, a heading and words each."""
    return Section(MEASURED, (Facts((("", tuple(rows)),)),))


def _run(name: str, diagnosed: Diagnosis, prefix: str) -> Section:
    """Return all of one diagnosis as a section."""
    parts = (*figures_of("", diagnosed, prefix).parts, _explorer_of(diagnosed), *_evidence(diagnosed))
    return Section(name, (*parts, *warnings_of(diagnosed.before.warnings).parts))


_HEADLINES: dict[bool | None, tuple[Agreement, str]] = {
    True: ("agrees", "Model and measurements agree"),
    False: ("disagrees", "Model and measurements disagree"),
    None: ("open", "There is nothing to judge the model by"),
}


def figures_of(title: str, result: object, prefix: str, only: Sequence[str] = (), less: Sequence[str] = ()) -> Section:
    """Return the section of a result's figures, of those alone or but for those of some titles.

    It has no part where there is no figure of such a result.
    """
    known = figures.dispatch(type(result)) is not figures.dispatch(object)
    drawn = figures(result) if known else {}
    return Section(title, tuple(
        Drawing(name, draw, f"{prefix}{k}") for k, (name, draw) in enumerate(drawn.items())
        if name not in less and (not only or name in only)
    ))  # fmt: skip


def _explorer_of(diagnosed: Diagnosis) -> Explorer:
    """Return the explorer of a diagnosed run, with what its explanations leave."""
    offered = diagnosed.explanations[:_EXPLORED]
    left = {f"with {each.name}": each.unexplained_mps2 for each in offered}
    return explorer(diagnosed.before, left, [shape for each in offered for shape in each.shapes])


def in_text(drawn: RenderableType, with_notes: bool = False) -> tuple[PagePart, ...]:
    """Return what the console draws, without its notes, which have a section of their own."""
    return tuple(each for each in parts_of(drawn) if with_notes or each.kind != "note")


def _calibrated(result: Calibration) -> tuple[PagePart, ...]:
    """Return the tables of a calibration, less the counts of readings, which are among what was measured."""
    return in_text(console.summary(result))[1:]


def _tables(result: Calibration) -> tuple[PagePart, ...]:
    """Return the tables alone: of the misfit as a whole, the page would say that it agrees where another test fails."""
    return tuple(each for each in _calibrated(result) if each.kind == "table")


def _evidence(diagnosed: Diagnosis) -> tuple[PagePart, ...]:
    """Return the evidence for a diagnosis, as the console has it."""
    return in_text(Group(*diagnosis.details_of(diagnosed)))


def _of_leaves(measured: Measured) -> Iterator[Section]:
    """Yield what folders that nothing here knows by name say of a recording: ``section_of`` of their ``section.py``."""
    for path in sorted(_PACKAGE.glob("*/section.py")):
        yield import_module(f"kf_calib.{path.parent.name}.section").section_of(measured)


def _with_what_is_missing(diagnosed: Diagnosis) -> tuple[PagePart, ...]:
    """Return the parameters with the missing effects beside those without; nothing where none is missing."""
    if diagnosed.after is None:
        return ()
    both = differences(diagnosed.before, diagnosed.after, same_recording=True)
    table = console.difference_table(both, "model as it is", f"with {' + '.join(diagnosed.missing)}")
    return (*parts_of(table), *parts_of(console.effect_table(diagnosed.after)))


def warnings_of(said: Iterable[str]) -> Section:
    return Section("Warnings", tuple(Paragraph(text, "note") for text in said))
