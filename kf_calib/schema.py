"""Values from outside as the types they must have, with limits; what does not fit is told in words."""

from __future__ import annotations

import re
from typing import Annotated, Any

import msgspec

# control characters, what turns the direction of writing, and halves of characters, which no file can hold
_COMMANDS = r"\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff"
TEXT = Annotated[str, msgspec.Meta(max_length=1000, pattern=rf"\A[^{_COMMANDS}]*\Z")]
"""Text for people and names; line ends and tabs may be in it."""
FINITE = Annotated[float, msgspec.Meta(ge=-1.7e308, le=1.7e308)]
_WORDS = {"`str`": "text", "`float`": "a number", "`int`": "a whole number", "`bool`": "true or false",
          "`array`": "a list", "`object`": "a table", "`null`": "nothing"}  # fmt: skip


class Misfit(ValueError):
    """A value is not what it must be; the text says where in it and why, without a full stop."""


def converted(value: Any, kind: Any, strict: bool = False) -> Any:
    """The value as ``kind``, a type with limits as msgspec has them. Raises Misfit.

    strict: text cannot stand for a number.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except (msgspec.ValidationError, OverflowError, RecursionError, UnicodeError) as error:
        raise Misfit(_in_words(str(error))) from None


def _in_words(said: str) -> str:
    """``steps[3].by: expected text, got a list`` of msgspec's message."""
    if "matching regex" in said:
        said = re.sub(r"Expected .*(?= - at |$)", "expected no control characters", said, flags=re.DOTALL)
    what, _, place = said.partition(" - at `$")
    for word, plain in _WORDS.items():
        what = what.replace(word, plain)
    what = what[:1].lower() + what[1:].replace("`", "")
    return f"{place.strip('`.')}: {what}" if place else what
