"""Values of results in types that JSON has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any


def json_value(value: Any, digits: int | None = None) -> Any:
    """A value in types that JSON has: a dataclass as the mapping of its fields, an array as a list, a path as its text,
    and null for a number that is not finite.

    digits: significant ones of the numbers; None: all of them.
    """
    if hasattr(value, "tolist"):  # an array or a number of numpy
        value = value.tolist()
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: json_value(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(item, digits) for item in value]
    if isinstance(value, float):
        return float(value if digits is None else f"{value:.{digits}g}") if math.isfinite(value) else None
    return str(value) if isinstance(value, PurePath) else value
