"""A command, its examples, and its ``--help``, which fits two screens.

Numbers on the command line: finite, within their range, with a decimal point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any

import rich_click as click

from kf_calib.errors import how_to_write

INPUT = "Input and bench"
MODEL = "Model and evaluation"
OUTPUT = "Output"
"""Groups of options in ``--help``: an option joins one by ``panel=``, and stands where its decorator does."""

_SELDOM = (
    "joints", "up", "channels", "latitude_deg", "height_m", "angle_sigma_deg", "scatter_sigma_mps2", "square_sigma_deg",
    "reference", "azimuth_deg", "date", "nominal", "accel_scale", "restate_input", "g_unit", "accel_topic",
    "pose_topic", "temperature_topic", "fields", "max_chunk_mb", "effects_from", "trust", "settle_s", "still_deg",
    "gate", "gate_sigma", "prior", "bias_walk", "engine", "bench_model", "svg", "pdf", "screenshot",
)  # fmt: skip
"""Options that few runs need: a bench or a file that is unusual."""
_MOST_OPTIONS = 22


class _Command(click.RichCommand):
    """Where it has many options, ``--help`` leaves out those that are seldom needed, and ``--help-all`` shows them.

    seldom: names of such options of this command alone.
    """

    def __init__(self, *args: Any, seldom: Collection[str] = (), **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        names = {*_SELDOM, *seldom} if len(self.params) > _MOST_OPTIONS else {*seldom}
        self._usual = [param for param in self.params if param.name not in names]
        left_out = len(self.params) - len(self._usual)
        help_all = click.Option(
            ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_show_all, hidden=not left_out,
            help=f"Show {left_out} options more, which are seldom needed.",
        )  # fmt: skip
        self.params, self._usual = [*self.params, help_all], [*self._usual, help_all]

    def get_help(self, ctx: click.Context) -> str:
        everything = self.params
        self.params = everything if ctx.meta.get(_ALL) else self._usual
        try:
            return super().get_help(ctx)
        finally:
            self.params = everything


_ALL = f"{__name__}.all"


def _show_all(ctx: click.Context, param: click.Parameter, asked: bool) -> None:
    if asked:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


def command(
    *examples: str, name: str | None = None, seldom: Collection[str] = ()
) -> Callable[[Callable[..., Any]], click.RichCommand]:
    """A command of ``kf-calib``; examples: what follows its options in ``--help``, a line each.

    seldom: options of this command that ``--help`` leaves out, besides those of unusual benches and files.
    """
    epilog = "\n\n".join(["Examples:", *(f"$ kf-calib {line}" for line in examples)])
    return click.command(name, cls=_Command, seldom=seldom, epilog=epilog)


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
