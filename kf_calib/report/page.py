"""The page itself: sections of parts, and how they become one file: a template, filled in, in which everything is
escaped that is not markup of its own."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from dataclasses import dataclass
from importlib import metadata, resources
from pathlib import Path
from typing import ClassVar, Literal

from kf_calib.report.drawing import Drawing, draw_all
from kf_calib.report.explorer import Explorer
from kf_calib.support.output_files import write_whole
from kf_calib.views.html import PageTable, Paragraph, templates

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
    commands: tuple[str, ...] = ()

    @property
    def html(self) -> str:
        """The whole page; what comes from recordings is escaped, and no script runs but the page's own."""
        draw_all([part for section in self.sections for part in section.parts if isinstance(part, Drawing)])
        scripts = [own_text("uPlot.iife.min.js"), own_text("explorer.js")]
        return (
            templates("kf_calib.report")
            .get_template("page.html")
            .render(
                page=self,
                sections=[each for each in self.sections if each.parts],
                version=metadata.version("kf_calib"),
                styles=[own_text(name) for name in ("uPlot.min.css", "style.css")],
                licence=own_text("uPlot.LICENSE"),
                scripts=scripts,
                allowed=" ".join(f"'sha256-{_digest(each)}'" for each in scripts),
            )
        )


def save(page: Page, path: Path) -> None:
    """Write a page as one file; the same page is the same file. Raises InputError where it cannot be written."""
    write_whole(path, page.html.encode())


def _digest(script: str) -> str:
    return b64encode(hashlib.sha256(script.encode()).digest()).decode()


def own_text(name: str) -> str:
    """A text file of this package."""
    return resources.files("kf_calib.report").joinpath(name).read_text(encoding="utf-8")
