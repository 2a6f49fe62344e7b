"""What the console prints, as HTML: paragraphs, and tables with decimal points in line; everything in them is escaped.

A notebook shows results so (``as_html``, for which each kind is registered here), and pages are made of the same parts.
Without Jinja2, which comes with the extra ``report``, a notebook shows them as text.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.errors import need
from kf_calib.estimation.results import Calibration
from kf_calib.support.text import as_html, printable
from kf_calib.views import console, diagnosis, improvement
from kf_calib.views.terminal import Bar, ConsoleTable, Note

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

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


def parts_of(drawn: RenderableType) -> Iterator[Paragraph | PageTable]:
    """The parts of what the console draws, in its order; a text without words is none."""
    if isinstance(drawn, Group):
        for each in drawn.renderables:
            yield from parts_of(each)
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


@cache
def templates(package: str) -> Environment:
    """The templates of a package, and those of parts; raises MissingExtraError without Jinja2."""
    need("jinja2", "report", "HTML")
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    made = Environment(
        loader=ChoiceLoader([PackageLoader(package, ""), PackageLoader("kf_calib.views", "")]), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"json": _json, "markup": Markup}
    return made


def _json(value: Any) -> Markup:
    """Return JSON for a script element: no text in it can end the element."""
    from markupsafe import Markup

    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _html(drawn: RenderableType) -> str | None:
    """Return what the console draws as HTML, or None where the package that fills in templates is not installed."""
    if find_spec("jinja2") is None:
        return None
    return templates("kf_calib.views").get_template("fragment.html").render(parts=parts_of(drawn))


_SHOWN: dict[type, Callable[[Any], RenderableType]] = {
    Calibration: console.summary,
    Diagnosis: diagnosis.diagnosis_report,
    Improvement: lambda state: improvement.improvement_report(state, None),
}
for _kind, _draw in _SHOWN.items():
    as_html.register(_kind, lambda result, draw=_draw: _html(draw(result)))
