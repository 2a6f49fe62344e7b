"""TOML files as tables, and the check of values of files and streams against types with limits.

Keys of a bench are checked without pydantic (``bench.keys``), because every run has them and importing it takes as long
as evaluating a short recording.
"""

from __future__ import annotations

import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints, TypeAdapter, ValidationError

from kf_calib.errors import InputError
from kf_calib.support.plain_text import COMMANDS, LONGEST, cut

_LARGEST_BYTES = 10_000_000  # a journal of a thousand steps has two


def toml_table(path: Path, example: str) -> dict[str, Any]:
    """The content of a TOML file; raises InputError, with the path and what a line looks like, where there is none."""
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_BYTES + 1)
        text = content.decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    if len(content) > _LARGEST_BYTES:
        raise InputError(f"{path}: is larger than {_LARGEST_BYTES / 1e6:g} MB: name another.")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not TOML ({error}); write lines such as {example}.") from None


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
