"""The page itself: its parts, and how they become one file: templates, filled in, in which everything is escaped that
is not markup of its own.

What the console prints, part by part, for a page: paragraphs, and tables with decimal points in line.

What the residual explorer of a page draws: residuals of every dwell against everything that varies in the run.

Results in a notebook: what the console prints of them, as HTML; registered for ``as_html`` when imported.

Without Jinja2, which comes with the extra ``report``, a notebook shows them as text.
"""

from __future__ import annotations

import hashlib
import json
import re
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import EffectShape
from kf_calib.diagnosis.residual_drivers import Driver, drivers_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.support.output_files import write_whole
from kf_calib.support.text import as_html, printable
from kf_calib.support.units import shown, shown_whole
from kf_calib.views import console, diagnosis, improvement
from kf_calib.views.json import clean
from kf_calib.views.report.drawing import Drawing, draw_all
from kf_calib.views.terminal import Bar, ConsoleTable, Note

_NUMBER = re.compile(r"(?P<whole>.*?\d)(?P<fraction>\.\d+)?(?P<power>e[-+]\d+)?(?P<rest>[^\d.].*)?", re.DOTALL)

_MINUS = re.compile(r"(?<![\w.])-(?=\d)")  # a hyphen that is a minus, which is as wide as a plus


@dataclass(frozen=True)
class Paragraph:
    """A sentence or more; a note is a remark beside a result."""

    text: str
    kind: Literal["paragraph", "note"] = "paragraph"


@dataclass(frozen=True)
class PageCell:
    """The text of a cell; of a number, its parts before the decimal point, behind it, and after the last digit.

    A page leaves room for what the longest fraction of the column has more, and for the longest text after a number.
    """

    whole: str
    fraction: str = ""
    fraction_room: str = ""
    rest: str = ""
    rest_room: str = ""
    bar: float = 0.0
    """Length of a bar, in characters, in place of text."""

    def __str__(self) -> str:
        return self.whole + self.fraction + self.rest


@dataclass(frozen=True)
class Heading:
    """The heading of a column, of numbers or of text."""

    text: str
    is_number: bool


@dataclass(frozen=True)
class PageTable:
    """A table; ends: numbers of the rows below which there is a line."""

    kind: ClassVar[str] = "table"
    title: str
    headings: tuple[Heading, ...]
    rows: tuple[tuple[PageCell, ...], ...]
    ends: frozenset[int]


def parts_of(drawn: RenderableType) -> list[Paragraph | PageTable]:
    """The parts of what the console draws, in its order; a text without words is none."""
    return list(_parts(drawn))


def _parts(drawn: RenderableType) -> Iterator[Paragraph | PageTable]:
    if isinstance(drawn, Group):
        for each in drawn.renderables:
            yield from _parts(each)
    elif isinstance(drawn, ConsoleTable):
        yield _table(drawn)
    elif isinstance(drawn, Text | str) and str(drawn).strip():
        text = printable(str(drawn))
        yield Paragraph(text.removeprefix("Note: "), "note") if isinstance(drawn, Note) else Paragraph(text)


def _table(drawn: ConsoleTable) -> PageTable:
    numbers = [column.justify == "right" for column in drawn.columns]
    columns = [_column(list(column.cells), each) for column, each in zip(drawn.columns, numbers, strict=True)]
    headings = [Heading(_said(column.header), each) for column, each in zip(drawn.columns, numbers, strict=True)]
    ends = frozenset(k for k, row in enumerate(drawn.rows[:-1]) if row.end_section)
    return PageTable(_said(drawn.title or ""), tuple(headings), tuple(zip(*columns, strict=True)), ends)


def _column(cells: Iterable[RenderableType], is_number: bool) -> list[PageCell]:
    """Return the cells of a column; those of numbers with the room that keeps their decimal points in line."""
    if not is_number:
        return [PageCell("", bar=each.length) if isinstance(each, Bar) else PageCell(_said(each)) for each in cells]
    split = [_split(_MINUS.sub("−", _said(each))) for each in cells]
    fraction = max((each[1] for each in split), key=len, default="")
    rest = max((each[2] for each in split), key=len, default="")
    return [PageCell(own[0], own[1], fraction[len(own[1]) :], own[2], rest) if own[0] else PageCell("")
            for own in split]  # fmt: skip


def _split(text: str) -> tuple[str, str, str]:
    """Return a number's text before its decimal point, from there to the last digit, and after it."""
    match = _NUMBER.fullmatch(text)
    if match is None:  # words, such as "not seen"
        return text, "", ""
    return match["whole"], (match["fraction"] or "") + (match["power"] or ""), match["rest"] or ""


def _said(cell: RenderableType) -> str:
    """Return the text of a cell or title on one line."""
    return printable(" ".join(str(cell).split()))


_DIGITS = 5  # significant ones, which a page needs


@dataclass(frozen=True)
class Explorer:
    """A part of a page; content: what its program reads."""

    kind: ClassVar[str] = "explorer"
    content: dict[str, Any]


def explorer(first: Calibration, others: Mapping[str, Floats], shapes: Sequence[EffectShape] = ()) -> Explorer:
    """The explorer of a run.

    others: residuals (D, 3) that other models leave, m/s^2, by what each is called. shapes: of effects; they come
    first.
    """
    dwells = first.linearised.dwells
    models, unit = {f"{first.model.sum}": first.residuals_mps2, **others}, shown("m/s^2")
    return Explorer(
        _short(
            {
                "dwells": [dwell.number for dwell in dwells],
                "begin_s": [dwell.start_s for dwell in dwells],
                "gimbals_deg": np.degrees([dwell.recorded_pose for dwell in dwells]) if first.bench.axes else None,
                "unit": unit.label,
                "sigma": mean_sigmas(first) * unit.per_si,
                "drivers": [*map(_shape, shapes), *map(_driver, drivers_of(first))],
                "models": [{"name": name, "residual": left_mps2 * unit.per_si} for name, left_mps2 in models.items()],
            }
        )
    )


def _shape(shape: EffectShape) -> dict[str, Any]:
    """Return what an effect must explain, over the quantity that it goes with, in the units of people."""
    across, unit = shown_whole(shape.unit, float(np.nanmax(np.abs(shape.values)))), shown(shape.quantity)
    return {
        "name": shape.words, "unit": across.label, "explains": "", "values": shape.values * across.per_si,
        "shown": f"what {shape.effect} must explain", "shown_unit": unit.label, "channels": shape.channels,
        "readings": shape.readings * unit.per_si, "sigma": shape.sigma * unit.per_si,
        "component": shape.component * unit.per_si,
    }  # fmt: skip


def _driver(driver: Driver) -> dict[str, Any]:
    """Return a driver with its values in the unit in which people read them."""
    unit = shown_whole(driver.unit, float(np.abs(driver.values).max()))
    explains = f"explains {driver.share:.0%}" if driver.share >= 0.005 and driver.p_value <= 0.01 else ""
    of_all = driver.values[:, 0] if np.ptp(driver.values, axis=1).max() == 0.0 else driver.values  # such as an angle
    return {"name": driver.words, "unit": unit.label, "explains": explains, "values": of_all * unit.per_si}


def _short(value: Any) -> Any:
    """Return what JSON can hold, with numbers of a few digits."""
    if isinstance(value, dict):
        return {key: _short(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_short(each) for each in value]
    value = clean(value)
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


Agreement = Literal["agrees", "disagrees", "open"]


@dataclass(frozen=True)
class Facts:
    """What was measured, a heading and words each, of each recording by its name; one alone needs none."""

    kind: ClassVar[str] = "facts"
    of: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]


PagePart = Paragraph | PageTable | Drawing | Explorer | Facts


@dataclass(frozen=True)
class Section:
    """A section of a page; one without parts is left out."""

    title: str
    parts: tuple[PagePart, ...]


@dataclass(frozen=True)
class Page:
    """A page. standing: whether model and measurements agree, which the headline says in words. verdict: what is found,
    a paragraph each."""

    title: str
    what: str
    standing: Agreement
    headline: str
    verdict: tuple[str, ...]
    sections: tuple[Section, ...]
    commands: tuple[str, ...]

    @property
    def html(self) -> str:
        """The whole page; what comes from recordings is escaped, and no script runs but the page's own."""
        draw_all([part for section in self.sections for part in section.parts if isinstance(part, Drawing)])
        scripts = [own_text("uPlot.iife.min.js"), own_text("explorer.js")]
        return filled_in(
            "page.html",
            page=self,
            sections=[each for each in self.sections if each.parts],
            version=metadata.version("kf_calib"),
            styles=[Markup(own_text(name)) for name in ("uPlot.min.css", "style.css")],
            licence=Markup(own_text("uPlot.LICENSE")),
            scripts=[Markup(each) for each in scripts],
            allowed=Markup(" ".join(f"'sha256-{_digest(each)}'" for each in scripts)),
        )


def save(page: Page, path: Path) -> None:
    """Write a page as one file; the same page is the same file. Raises InputError where it cannot be written."""
    write_whole(path, page.html.encode())


def _digest(script: str) -> str:
    return b64encode(hashlib.sha256(script.encode()).digest()).decode()


def fragment(parts: Sequence[Paragraph | PageTable]) -> str:
    """Paragraphs and tables as HTML that is a part of another page, such as a notebook."""
    return filled_in("fragment.html", parts=parts)


def filled_in(name: str, **content: Any) -> str:
    """A template with this content."""
    return _environment().get_template(name).render(content)


def own_text(name: str) -> str:
    """A text file of this package."""
    return resources.files("kf_calib.views.report").joinpath(name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("kf_calib.views.report", ""), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"json": _json, "markup": Markup}
    return made


def _json(value: Any) -> Markup:
    """Return JSON for a script element: no text in it can end the element."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@as_html.register
def _(result: Calibration) -> str | None:
    return _html(console.summary(result))


@as_html.register
def _(found: Diagnosis) -> str | None:
    return _html(diagnosis.diagnosis_report(found))


@as_html.register
def _(state: Improvement) -> str | None:
    return _html(improvement.improvement_report(state, None))


def _html(drawn: RenderableType) -> str | None:
    """Return what the console draws as HTML, or None where the package that fills in templates is not installed."""
    if find_spec("jinja2") is None:
        return None

    return fragment(parts_of(drawn))
