"""Equations as MathML, which browsers draw themselves: no script, nothing from the network."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.util.logging import getLogger
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator

_LATEX = LatexToMathML(fancy_error=False)  # one line, for a log
_LOGGER = getLogger(__name__)


def inline(writer: HTML5Translator, node: nodes.math) -> None:
    writer.body.append(_mathml(node, displayed=False))
    raise nodes.SkipNode


def display(writer: HTML5Translator, node: nodes.math_block) -> None:
    writer.body.append(writer.starttag(node, "div", CLASS="math"))
    if node["number"]:
        writer.body.append(f'<span class="eqno">({get_node_equation_number(writer, node)})</span>')
    writer.body.append(_mathml(node, displayed=True) + "</div>\n")
    raise nodes.SkipNode


def _mathml(node: nodes.Element, displayed: bool) -> str:
    """Of a formula in LaTeX; one that is wrong is a warning, and so ends the build."""
    try:
        return _LATEX.convert_with_local_state(node.astext(), displaystyle=displayed)
    except LatexError as error:
        _LOGGER.warning("%s: %s", error, node.astext(), location=node)
        return ""


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
