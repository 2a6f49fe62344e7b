"""The page of the Python interface: every name of ``kf_calib.__all__``, from its docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import kf_calib

_LITERAL = re.compile(r"(``.*?``)", re.DOTALL)
_MARKUP = re.compile(r"(?<=\w)_(?=\W|$)|[\\*|`]")
_KINDS = ("function", "class", "exception", "data")


class PublicNames(SphinxDirective):
    """``.. public-names::`` functions, classes and exceptions, each documented by autodoc."""

    def run(self) -> list[nodes.Node]:
        lines = StringList(list(_directives()), source=__file__)
        holder = nodes.Element()
        self.state.nested_parse(lines, self.content_offset, holder)
        return holder.children


def _directives() -> Iterator[str]:
    for name in sorted(kf_calib.__all__, key=lambda name: (_KINDS.index(_kind(name)), name.lower())):
        yield f".. auto{_kind(name)}:: kf_calib.{name}"
        if _kind(name) == "class":
            yield "   :members:"
        if _kind(name) == "data":
            yield "   :no-value:"
        yield ""


def _kind(name: str) -> str:
    found = getattr(kf_calib, name)
    if inspect.ismodule(found):  # which stands for another one, and so is documented as an attribute
        return "data"
    if not inspect.isclass(found):
        return "function"
    return "exception" if issubclass(found, Exception) else "class"


def as_plain_text(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Docstrings are plain text with ``code``: no other sign in them is markup."""
    parts = _LITERAL.split("\n".join(lines))
    lines[:] = "".join(part if k % 2 else _MARKUP.sub(r"\\\g<0>", part) for k, part in enumerate(parts)).split("\n")


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", as_plain_text)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
