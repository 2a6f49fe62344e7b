"""The page itself: its parts, and how they become one file."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import ClassVar, Literal

from markupsafe import Markup

from kf_calib.support.output_files import write_whole
from kf_calib.views.report.drawing import Drawing, draw_all
from kf_calib.views.report.explorer import Explorer
from kf_calib.views.report.parts import Paragraph, Table
from kf_calib.views.report.templates import filled_in, own_text

Standing = Literal["agrees", "disagrees", "open"]


@dataclass(frozen=True)
class Facts:
    """What was measured, a heading and words each, of each recording by its name; one alone needs none."""

    kind: ClassVar[str] = "facts"
    of: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]


Part = Paragraph | Table | Drawing | Explorer | Facts


@dataclass(frozen=True)
class Section:
    """A section of a page; one without parts is left out."""

    title: str
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Page:
    """A page. standing: whether model and measurements agree, which the headline says in words. verdict: what is found,
    a paragraph each."""

    title: str
    what: str
    standing: Standing
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
