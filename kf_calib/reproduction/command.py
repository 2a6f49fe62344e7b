"""The command that repeats the seed paper's experiment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import rich_click as click

from kf_calib.cli.command import NumberInRange, command, option
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.files import FigureFiles, claimed, delivery
from kf_calib.cli.options import Json, Overwrite, ShownUnits

_of_the_run = partial(option, panel="Run")
_inferred = partial(option, panel="Conditions that the paper does not print: inferred")


@dataclass(frozen=True)
class PaperOptions:
    """What is repeated, under which conditions."""

    # fmt: off
    repetitions: Annotated[int, _of_the_run(
        "--repetitions", type=click.IntRange(1, 20000), metavar="N", help="Runs of each set.")] = 200
    seed: Annotated[int, _of_the_run(
        "--seed", type=click.IntRange(min=0), metavar="N", help="Seed of the noise.")] = 0
    period_s: Annotated[float, _inferred(
        "--period-s", type=NumberInRange(min=0, min_open=True, max=3600),
        help="From reading to reading in the non-optimal set, s.")] = 25.0
    latitude: Annotated[float, _inferred(
        "--latitude", type=NumberInRange(-85, 85), help="Of the bench, deg.")] = 55.75
    azimuth: Annotated[float, _inferred(
        "--azimuth", type=NumberInRange(-360, 360), help="Of the bench's x axis, deg.")] = 0.0
    turns: Annotated[Literal["platform", "platform-after-2", "bench", "bench-after-2"], _inferred(
        "--turns", metavar="WORD", help="Whose axes the turns are about, and whether the third orientation goes on "
        "after the second: platform, platform-after-2, bench or bench-after-2.")] = "platform"
    sampled: Annotated[Literal["together", "123", "132", "213", "231", "312", "321"], _inferred(
        "--sampled", metavar="WORD",
        help="Accelerometers read together, or in turn in each orientation: 123, 132 ... 321.")] = "together"
    # fmt: on


@command("paper", "paper --repetitions 1000 --png paper.png")
def paper(options: PaperOptions, figures: FigureFiles, overwrite: Overwrite, units: ShownUnits, as_json: Json) -> None:
    """The seed paper's experiment again: its Table 2, by least squares and by the filter, beside the print."""
    from kf_calib.reproduction import text as views
    from kf_calib.reproduction.grebenkin2019 import Conditions, repeat
    from kf_calib.reproduction.grebenkin2019_conditions import search

    outputs = claimed(overwrite=overwrite)
    conditions = Conditions(options.period_s, options.latitude, options.azimuth, options.turns, options.sampled)
    with progress("repeating the experiment", as_json) as tick:
        experiment = repeat(conditions, options.repetitions, options.seed)
        tick(0.5)
        searched = search(options.latitude)
    print_result(as_json, views.paper_object, views.paper_report, experiment, searched)
    with delivery(outputs, as_json) as deliver:
        figures.save(deliver, experiment)
