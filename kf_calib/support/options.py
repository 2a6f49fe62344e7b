"""What the command line says of a field that the library has: ``Annotated[float, Option("--height", "Height, m.")]``.

So an option is one thing, with one type and one help text, whether it is given in Python or in a shell.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Option:
    """The option of a field.

    metavar: what stands for its value. default: what is used where it is left out, in words. least: the smallest
    value; is_open: whether that one is too small already.
    """

    name: str
    help: str
    metavar: str | None = None
    default: str | None = None
    least: float | None = None
    is_open: bool = False
