"""TOML files as tables."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from kf_calib.errors import InputError

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
