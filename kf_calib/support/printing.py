"""Results as text and as HTML: ``views`` register how, so that results need not import them."""

from __future__ import annotations

from functools import singledispatch


@singledispatch
def printed(value: object) -> str:
    """The value as plain text; ``views`` register how for each kind of result."""
    return repr(value)


@singledispatch
def as_html(value: object) -> str | None:
    """The value as HTML for a notebook; ``views`` register how for each kind of result. None: it is shown as text."""
    return None
