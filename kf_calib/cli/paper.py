"""The command that repeats the seed paper's experiment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kf_calib.cli.files import claimed, delivery
from kf_calib.cli.options import (
    json_option,
    overwrite_option,
    png_option,
    print_json,
    progress,
    rrd_option,
    show,
)

if TYPE_CHECKING:
    from kf_calib.experiment import Experiment


@click.command()
@click.option("--repetitions", type=click.IntRange(1, 20000), default=200, show_default=True, help="Runs of each set.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the noise.")
@click.option(
    "--period-s",
    type=click.FloatRange(min=0, min_open=True, max=3600),
    default=25.0,
    show_default=True,
    help="From reading to reading in the non-optimal set, s; inferred, not printed in the paper.",
)
@click.option(
    "--latitude",
    type=click.FloatRange(-85, 85),
    default=55.75,
    show_default=True,
    help="Latitude of the bench, deg; inferred.",
)
@click.option(
    "--azimuth",
    type=click.FloatRange(-360, 360),
    default=0.0,
    show_default=True,
    help="Azimuth of the bench's x axis, deg; inferred.",
)
@click.option(
    "--turns",
    type=click.Choice(["platform", "platform-after-2", "bench", "bench-after-2"]),
    default="platform",
    show_default=True,
    help="Whose axes the turns are about, and whether the third orientation goes on after the second.",
)
@click.option(
    "--sampled",
    type=click.Choice(["together", "123", "132", "213", "231", "312", "321"]),
    default="together",
    show_default=True,
    help="Accelerometers read at once, or in turn in each orientation.",
)
@rrd_option
@png_option
@overwrite_option
@json_option
def paper(
    repetitions: int, seed: int, period_s: float, latitude: float, azimuth: float, turns: str, sampled: str,
    rrd: Path | None, png: Path | None, overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    """The seed paper's experiment again: its Table 2, by least squares and by the filter, beside the print."""
    from kf_calib.experiment import Conditions, repeat
    from kf_calib.inferred import search
    from kf_calib.views import paper as views

    outputs = claimed(overwrite=overwrite)
    conditions = Conditions(period_s, latitude, azimuth, turns, sampled)  # type: ignore[arg-type]  # click's choices
    with progress("repeating the experiment", as_json) as tick:
        found = repeat(conditions, repetitions, seed)
        tick(0.5)
        searched = search(latitude)
    if as_json:
        print_json(views.paper_object(found, searched))
    else:
        show(views.paper_report(found, searched))
    with delivery(outputs, as_json) as deliver:
        deliver.view(lambda path: _save_view(found, views.markdown(found, searched), path), rrd, png)


def _save_view(found: Experiment, words: str, path: Path) -> None:
    from kf_calib.views.rerun.experiment import save

    save(found, words, path)
