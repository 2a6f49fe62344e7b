"""Checks values of files and streams against types with limits; a misfit is described in words.

Keys of a bench are checked without it (``bench.keys``), because every run has them and importing pydantic takes as long
as evaluating a short recording.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any

from pydantic import Field, StringConstraints, TypeAdapter, ValidationError

from kf_calib.support.plain_text import COMMANDS, LONGEST, cut

TEXT = Annotated[str, StringConstraints(max_length=LONGEST, pattern=rf"\A[^{COMMANDS}]*\z")]
"""Text for people and names; line ends and tabs may be in it."""
FINITE = Annotated[float, Field(allow_inf_nan=False)]


class Misfit(ValueError):
    """A value is not what it must be; the text says where in it and why, without a full stop."""


def converted(value: Any, kind: Any) -> Any:
    """The value as ``kind``, a type with limits as pydantic has them; text is no number, nor is true. Raises Misfit."""
    try:
        return _adapter(kind).validate_python(value, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        reason = first["msg"].replace("Input should", "it must").replace("Field required", "it is missing")
        reason = reason.replace("Extra inputs are not permitted", "it is unknown")
        if first["type"] == "string_pattern_mismatch":
            reason = "it must hold no control characters"
        location = cut(".".join(map(str, first["loc"])), 100)
        raise Misfit(f"{location}: {reason}" if location else reason) from None
    except (OverflowError, RecursionError, UnicodeError):
        raise Misfit("it is larger or deeper than any value, or no text") from None


@lru_cache(maxsize=64)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
