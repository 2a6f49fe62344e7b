"""A command, its options, its examples, and its ``--help``, which fits two screens.

A command is a function whose parameters say what the command line has, in this order: one of type
``Annotated[float, option("--settle-s", ...)]`` is an option, with ``argument`` in its place an argument, and one whose
type is a dataclass stands for the options of its fields, which are annotated in the same way, or, where the dataclass
is not of the command line, in a mapping that annotates the parameter. Whether an option takes a
number, a path or one of several words, is a flag or may be repeated, and what its default is, follows from type and
default of the parameter as far as ``option`` does not say it.

Numbers on the command line: finite, within their range, with a decimal point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, partial, wraps
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

import rich_click as click

from kf_calib.errors import how_to_write
from kf_calib.support.text import number_from

HELP_NAMES = {"help_option_names": ["-h", "--help"]}
"""Of every command by itself: click keeps the names with which its help was asked for first."""

INPUT = "Input and bench"
MODEL = "Model and evaluation"
OUTPUT = "Output"
"""Groups of options in ``--help``: an option joins one by ``panel=``, and stands where its decorator does."""

_SELDOM = (
    "joints", "up", "channels", "latitude_deg", "height_m", "angle_sigma_deg", "scatter_sigma_mps2", "square_sigma_deg",
    "reference", "azimuth_deg", "date", "nominal", "accel_scale", "counts", "restate_input", "g_unit", "rate_hz",
    "where", "accel_topic", "pose_topic", "temperature_topic", "fields", "max_chunk_mb", "effects_from", "trust",
    "settle_s", "still_deg", "gate", "gate_sigma", "prior", "bias_walk", "engine", "bench_model", "svg", "pdf",
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


_hints = cache(get_type_hints)
"""Groups of options are asked for theirs once for each command that has them, and when it runs."""

option, argument = partial(partial, click.option), partial(partial, click.argument)
"""What a parameter's annotation says of it: what ``click.option`` or ``click.argument`` takes, but for its name."""


def command(
    *examples: str, name: str | None = None, seldom: Collection[str] = ()
) -> Callable[[Callable[..., None]], click.RichCommand]:
    """A command of ``kf-calib``; examples: what follows its options in ``--help``, a line each.

    seldom: options of this command that ``--help`` leaves out, besides those of unusual benches and files.
    """
    epilog = "\n\n".join(["Examples:", *(f"$ kf-calib {line}" for line in examples)])

    def made(function: Callable[..., None]) -> click.RichCommand:
        kinds = _hints(function)

        @wraps(function)
        def callback(*args: Any, **values: Any) -> None:
            groups = {name: grouped(kind, values) for name, kind in kinds.items() if _is_group(kind)}
            function(*args, **{name: value for name, value in values.items() if name in kinds}, **groups)

        for declare in reversed([*_declarations(function, {})]):
            declare(callback)
        return click.command(name, cls=_Command, seldom=seldom, epilog=epilog, context_settings=HELP_NAMES)(callback)

    return made


def _declarations(owner: Any, options: Mapping[str, Any]) -> Iterator[Callable[..., Any]]:
    """Decorators that declare to click the parameters of a function, or the fields of a dataclass and of those in it.

    options: those of fields that are not annotated.
    """
    defaults = {field.name: field.default for field in fields(owner)} if is_dataclass(owner) else {}
    for name, hint in _hints(owner, include_extras=True).items():
        kind, declare = get_args(hint) if get_origin(hint) is Annotated else (hint, options.get(name))
        if is_dataclass(kind):
            yield from _declarations(kind, declare or options)
        elif is_typeddict(kind):
            yield from _of_library(kind, str(declare))
        elif declare is not None:
            implied = _implied(kind, defaults.get(name), is_option=declare.func is click.option)
            yield declare(name, **implied | declare.keywords)


def _of_library(kind: Any, panel: str) -> Iterator[Callable[..., Any]]:
    """Decorators that declare the options of a mapping of the library's; panel: their group in ``--help``."""
    for name, hint in _hints(kind, include_extras=True).items():
        of_key, own = get_args(hint)
        said: dict[str, Any] = {"help": own.help, "metavar": own.metavar, "panel": panel}
        said |= {} if own.default is None else {"show_default": own.default}
        said |= {} if own.least is None else {"type": NumberInRange(min=own.least, min_open=own.is_open)}
        yield option(own.name)(name, **_implied(of_key, None, is_option=True) | said)


def _implied(kind: Any, default: object, is_option: bool) -> dict[str, Any]:
    """What type and default of a parameter say of its option; of several types, the first is that of the shell."""
    if get_origin(kind) in (Union, UnionType):
        kind = get_args(kind)[0]
    implied = dict[str, Any]()
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
        implied |= {"multiple": True} if is_option else {"nargs": -1}
    if get_origin(kind) is Literal:
        implied["type"] = click.Choice(get_args(kind))
    elif kind is bool:
        implied["is_flag"] = True
    elif kind is not str:
        implied["type"] = {float: NUMBER, int: click.INT, Path: click.Path(path_type=Path)}[kind]
    if default is None or default is False or default == ():
        return implied
    return implied | {"default": default, "show_default": True}


def _is_group(kind: Any) -> bool:
    return is_dataclass(kind) or is_typeddict(kind)


def grouped(kind: Any, values: Mapping[str, Any]) -> Any:
    """A dataclass or mapping of options, and those in it, with the values that click has of them by their names.

    A mapping has those that are given.
    """
    hints = _hints(kind)
    if is_typeddict(kind):
        return {name: value for name in hints if (value := values[name]) is not None and value is not False}
    groups = {name: grouped(hint, values) for name, hint in hints.items() if _is_group(hint)}
    return kind(**{name: values[name] for name in hints if name in values}, **groups)


def values_of(*groups: Any) -> Iterator[tuple[str, Any]]:
    """Names and values of all options of dataclasses."""
    for group in groups:
        for name, value in group.items() if isinstance(group, dict) else vars(group).items():
            yield from values_of(value) if is_dataclass(value) or isinstance(value, dict) else [(name, value)]


class Number(click.ParamType[float]):
    """A finite number; what is none is refused, with how to write it where that can be told."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            number = number_from(value) if isinstance(value, str) else float(value)
        except ValueError:
            raise click.BadParameter(f"{value!r} is not a number{how_to_write(str(value))}.", ctx, param) from None
        if isinstance(value, str) and not math.isfinite(number):  # one that is no word is a default: never, say
            raise click.BadParameter(f"{value!r} is not a finite number.", ctx, param)
        return number


NUMBER = Number()


class NumberInRange(click.FloatRange):
    """The same from ``min`` to ``max``."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return super().convert(NUMBER.convert(value, param, ctx), param, ctx)


NOT_NEGATIVE = NumberInRange(min=0)
POSITIVE = NumberInRange(min=0, min_open=True)
