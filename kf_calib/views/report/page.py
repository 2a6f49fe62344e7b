"""The page itself: its parts, and how they become one file: templates, filled in, in which everything is escaped that
is not markup of its own.
"""

from __future__ import annotations

import hashlib
import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any, ClassVar, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from kf_calib.support.output_files import write_whole
from kf_calib.views.report.drawing import Drawing, draw_all
from kf_calib.views.report.explorer import Explorer
from kf_calib.views.report.parts import PageTable, Paragraph

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
