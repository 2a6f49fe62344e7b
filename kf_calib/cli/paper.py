"""The command that repeats the seed paper's experiment."""

from __future__ import annotations

from functools import partial
from typing import Any

import rich_click as click

from kf_calib.cli.command import command
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import claimed, delivery
from kf_calib.cli.numbers import NumberInRange
from kf_calib.cli.options import json_option, overwrite_option, units_option
from kf_calib.cli.pictures import Pictures, figure_options

of_the_run = partial(click.option, panel="Run")
inferred = partial(click.option, panel="Conditions that the paper does not print: inferred")


@command("paper", "paper --repetitions 1000 --png paper.png")
@of_the_run(
    "--repetitions",
    type=click.IntRange(1, 20000),
    default=200,
    show_default=True,
    metavar="N",
    help="Runs of each set.",
)
@of_the_run("--seed", type=click.IntRange(min=0), default=0, show_default=True, metavar="N", help="Seed of the noise.")
@inferred(
    "--period-s",
    type=NumberInRange(min=0, min_open=True, max=3600),
    default=25.0,
    show_default=True,
    help="From reading to reading in the non-optimal set, s.",
)
@inferred("--latitude", type=NumberInRange(-85, 85), default=55.75, show_default=True, help="Of the bench, deg.")
@inferred(
    "--azimuth", type=NumberInRange(-360, 360), default=0.0, show_default=True, help="Of the bench's x axis, deg."
)
@inferred(
    "--turns",
    type=click.Choice(["platform", "platform-after-2", "bench", "bench-after-2"]),
    default="platform",
    show_default=True,
    metavar="WORD",
    help="Whose axes the turns are about, and whether the third orientation goes on after the second: platform, "
    "platform-after-2, bench or bench-after-2.",
)
@inferred(
    "--sampled",
    type=click.Choice(["together", "123", "132", "213", "231", "312", "321"]),
    default="together",
    show_default=True,
    metavar="WORD",
    help="Accelerometers read together, or in turn in each orientation: 123, 132 ... 321.",
)
@figure_options
@overwrite_option
@units_option
@json_option
def paper(
    repetitions: int, seed: int, period_s: float, latitude: float, azimuth: float, turns: str, sampled: str,
    overwrite: bool, as_json: bool, **options: Any,
) -> None:  # fmt: skip
    """The seed paper's experiment again: its Table 2, by least squares and by the filter, beside the print."""
    from kf_calib.reproduction.grebenkin2019 import Conditions, repeat
    from kf_calib.reproduction.grebenkin2019_conditions import search
    from kf_calib.views import paper as views

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    conditions = Conditions(period_s, latitude, azimuth, turns, sampled)  # type: ignore[arg-type]  # click's choices
    with progress("repeating the experiment", as_json) as tick:
        experiment = repeat(conditions, repetitions, seed)
        tick(0.5)
        searched = search(latitude)
    if as_json:
        print_json(views.paper_object(experiment, searched))
    else:
        show(views.paper_report(experiment, searched))
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, experiment)
