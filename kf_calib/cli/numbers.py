"""Numbers on the command line: finite, within their range, with a decimal point."""

from __future__ import annotations

import math
from typing import Any

import rich_click as click

from kf_calib.errors import how_to_write


class Number(click.types.FloatParamType):
    """A finite number; what is none is refused, with how to write it where that can be told."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, str):
            try:
                number = float(value)
            except ValueError:
                self.fail(f"{value!r} is not a number{how_to_write(value)}.", param, ctx)
            if not math.isfinite(number):
                self.fail(f"{value!r} is not a finite number.", param, ctx)
        return float(super().convert(value, param, ctx))


class NumberInRange(Number, click.FloatRange):
    """The same from ``min`` to ``max``."""

    name = "number"


NUMBER = Number()
NOT_NEGATIVE = NumberInRange(min=0)
POSITIVE = NumberInRange(min=0, min_open=True)
