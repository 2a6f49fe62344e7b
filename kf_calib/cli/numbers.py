"""Numbers on the command line: finite, within their range, with a decimal point."""

from __future__ import annotations

import math
from typing import Any

import click

from kf_calib.errors import how_to_write


class Number(click.ParamType[float]):
    """A finite number; what is none is refused, with how to write it where that can be told."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _finite(value, param, ctx)


class NumberInRange(click.FloatRange):
    """The same from ``min`` to ``max``."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return super().convert(_finite(value, param, ctx), param, ctx)


def _finite(value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
    """The number that ``value`` is, in words; one that is no word is a default, and may be infinite: never."""
    try:
        number = float(value)
    except ValueError:
        raise click.BadParameter(f"{value!r} is not a number{how_to_write(str(value))}.", ctx, param) from None
    if isinstance(value, str) and not math.isfinite(number):
        raise click.BadParameter(f"{value!r} is not a finite number.", ctx, param)
    return number


NUMBER = Number()
NOT_NEGATIVE = NumberInRange(min=0)
POSITIVE = NumberInRange(min=0, min_open=True)
