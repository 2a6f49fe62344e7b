"""The templates of this package, filled in: everything is escaped that is not markup of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from kf_calib.views.report.parts import Paragraph, Table


def fragment(parts: Sequence[Paragraph | Table]) -> str:
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
