"""Results as text: what prints a result knows it, and the result does not know what prints it."""

from __future__ import annotations

from functools import singledispatch


@singledispatch
def printed(value: object) -> str:
    """The value as plain text; ``views`` register how for each kind of result."""
    return repr(value)
