"""A command, its examples, and its ``--help``, which fits two screens."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import rich_click as click

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
