"""Results as text and as HTML: what shows a result knows it, and the result does not know what shows it.

What shows them is loaded when the first is shown (``shown_by``), so that a result is printed alike whatever was
imported before.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch

_loaders = list[Callable[[], object]]()


def shown_by(load: Callable[[], object]) -> None:
    """Have ``load`` called before the first result is shown: it imports the modules that register how."""
    _loaders.append(load)


@singledispatch
def printed(value: object) -> str:
    """The value as plain text; ``views`` register how for each kind of result."""
    return printed(value) if _have_loaded() else repr(value)


@singledispatch
def as_html(value: object) -> str | None:
    """The value as HTML for a notebook; ``views`` register how for each kind of result. None: it is shown as text."""
    return as_html(value) if _have_loaded() else None


def _have_loaded() -> bool:
    """Load what shows results, and tell whether anything was left to be loaded."""
    waiting = [_loaders.pop() for _ in list(_loaders)]
    for load in waiting:
        load()
    return bool(waiting)
