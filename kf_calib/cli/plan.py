"""The command plan: orientations for the bench at hand, before a run or in the course of one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.command import OUTPUT, command
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.numbers import POSITIVE, NumberInRange
from kf_calib.cli.options import (
    F,
    filter_options,
    json_option,
    opened,
    overrides,
    overwrite_option,
    recording_options,
    target_option,
    units_option,
)
from kf_calib.cli.pictures import Pictures, figure_options
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
    from kf_calib.design.gimbal_limits import Reach
    from kf_calib.design.optimality_criteria import Aim
    from kf_calib.design.predicted_information import Prospect

_USUAL_DWELL_S = 30.0
_AIM = "What to aim at"
_CRITERIA = ("D", "A", "E", "minimax", "condition")


def _plan_options(command: F) -> F:
    """What is aimed at, what the bench can do, and what a dwell tells."""
    aim_option, reach_option, dwell_option = (
        partial(click.option, panel=panel) for panel in (_AIM, "What the bench can do", "What a dwell tells")
    )
    options = [
        aim_option("--count", type=click.IntRange(min=1), metavar="N",
                   help="Dwells; 12, and 1 where a recording is given."),
        aim_option("--criterion", type=click.Choice(_CRITERIA), default="D", show_default=True,
                   help="Least generalised variance, mean variance, largest principal sigma, largest sigma (rad, 1, "
                   "g), or the paper's condition number."),
        target_option(panel=_AIM),
        aim_option("--fewest", is_flag=True, help="The fewest dwells that reach all targets."),
        aim_option("--recording", type=click.Path(path_type=Path), metavar="REC",
                   help="A run so far: what comes next, from the filter's own covariance."),
        aim_option("--beside-paper", is_flag=True,
                   help="The paper's optimal set beside it, as many readings a dwell."),
        reach_option("--limit", "limits", multiple=True, metavar="AXIS=LOW:HIGH",
                     help="Range of a gimbal in deg, as z=-90:90; AXIS: its axis, number, or outer, middle, inner; "
                     "repeatable."),
        reach_option("--forbid", "zones", multiple=True, metavar="AXIS=LOW:HIGH,...",
                     help="Angles not to be taken, of one gimbal or of several at once; repeatable."),
        reach_option("--grid-deg", type=POSITIVE, help="Angles are multiples of this."),
        reach_option("--positions", type=click.Path(path_type=Path), metavar="FILE.csv",
                     help="Choose from these orientations, a line of gimbal angles in deg each."),
        reach_option("--repeats", type=click.IntRange(min=1), metavar="N", default=1, show_default=True,
                     help="Visits to each orientation, coming from others: scatter and hysteresis show."),
        reach_option("--antipodal", is_flag=True, help="Each orientation with its opposite, gravity turned over."),
        reach_option("--slew-degps", type=POSITIVE, default=20.0, show_default=True, help="Greatest speed, deg/s."),
        reach_option("--time-correlation", type=NumberInRange(0, 1), default=0.1, show_default=True,
                     help="Correlation of time with the direction of gravity that the order may have; slews are the "
                     "shortest below it."),
        reach_option("--seed", type=int, metavar="N", default=0, show_default=True,
                     help="Seed of the order of visits."),
        dwell_option("--dwell-s", type=POSITIVE, help="Seconds in each orientation; as in the recording, or 30."),
        dwell_option("--sample-hz", type=POSITIVE, default=100.0, show_default=True, help="Rate of the readings."),
        dwell_option("--readings", type=POSITIVE, help="Readings of a dwell that are used, in place of the two above."),
        dwell_option("--white", "white_mps2", type=POSITIVE, default=1e-4, show_default=True,
                     help="White noise of a reading, m/s^2, where no recording tells it."),
        output_option("--csv", "csv_file", metavar="FILE.csv", panel=OUTPUT,
                      help="Save the angles, for simulate --plan."),
        figure_options,
        overwrite_option,
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


@command(
    "plan --count 12 --limit z=-90:90 --csv plan.csv", "plan --target K=2ppm --fewest", "plan --recording run.mcap",
    seldom=("beside_paper", "zones", "grid_deg", "repeats", "antipodal", "time_correlation", "seed", "readings",
            "white_mps2", "sample_hz", "accel_unit", "angle_unit", "columns", "effects", "model_file", "left_out"),
)  # fmt: skip
@_plan_options
@recording_options
@filter_options
@units_option
@json_option
def plan(
    as_json: bool, csv_file: Path | None, overwrite: bool, **options: Any
) -> None:  # fmt: skip
    """Orientations that determine the parameters best: which, in which order, and the sigmas to expect."""
    from kf_calib.design import orientation_plan
    from kf_calib.design.exact_design import Scheme, Search
    from kf_calib.design.visit_order import Timing
    from kf_calib.views import plan as views

    _refuse_contradictions(options | {"csv_file": csv_file})
    if options["no_angles"]:
        _plan_by_hand(options, as_json)
        return
    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    prospect = _prospect(options, as_json)
    reach = _reach(prospect.model.bench, options)
    scheme = Scheme.of(reach, options["repeats"], options["antipodal"])
    search = Search(prospect, reach, _aim(options, prospect.model.bench.gravity_mps2), scheme)
    timing = Timing(prospect.dwell_s, options["slew_degps"], options["time_correlation"])
    with progress("planning", as_json):
        if options["fewest"]:
            made = orientation_plan.fewest(search, timing, options["seed"])
        else:
            count = options["count"] or (scheme.copies if options["recording"] else 12)
            made = orientation_plan.plan(search, count, timing, options["seed"])
    if as_json:
        print_json(views.plan_object(made, options["beside_paper"]))
    else:
        show(views.plan_report(made, options["beside_paper"]))
    with delivery(outputs, as_json) as deliver:
        deliver.file(csv_file, lambda path: views.write_csv(made, path))
        pictures.save(deliver, made)


def _refuse_contradictions(options: Mapping[str, Any]) -> None:
    unused = (
        "targets",
        "fewest",
        "limits",
        "zones",
        "grid_deg",
        "positions",
        "beside_paper",
        "csv_file",
        "png",
        "svg",
        "pdf",
    )
    if options["no_angles"] and any(options.get(name) for name in unused):
        raise click.UsageError(
            "--no-angles plans sides to turn up by hand: leave out targets, limits of gimbals, pictures, files of "
            "angles and --beside-paper."
        )
    if options["fewest"] and not options["targets"]:
        raise click.UsageError("--fewest needs a target to reach, for example --target K=2ppm.")
    if options["fewest"] and options["count"]:
        raise click.UsageError("--fewest finds the count itself: leave out --count.")
    if options["targets"] and options["criterion"] not in ("D", "minimax"):
        raise click.UsageError("--target has a criterion of its own, the worst sigma: leave out --criterion.")
    if options["grid_deg"] and options["positions"]:
        raise click.UsageError("--grid-deg and --positions are two answers to one question: choose one.")
    if options["effects"] and not options["recording"]:
        raise click.UsageError(
            "--with needs a recording (--recording): a plan from nothing is for the twelve parameters."
        )


def _plan_by_hand(options: Mapping[str, Any], as_json: bool) -> None:
    """Print which sides to turn up where there are no angles."""
    from kf_calib.bench.bench import Bench
    from kf_calib.design.sides import HandPlan
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.views import plan as views

    if options["recording"] is not None:
        source, settings = opened(options["recording"], options)
        with progress("reading", as_json) as tick:
            before = calibrate(source, settings, tick).fit
        counts, noise = [dwell.count for dwell in before.dwells], before.noise
        sigma = math.hypot(noise.effective_sigma_mps2.mean() / math.sqrt(sum(counts) / len(counts)),
                           noise.scatter_mps2.mean())  # fmt: skip
        made = HandPlan.of(options["count"] or 1, before.linearised.model, sigma, before)
    else:
        keys = {"gravity_mps2": "9.80665", **overrides(options)}
        bench = replace(Bench.from_metadata(keys, has_angles=False), angles=False, nominal={"theta1": 0, "theta3": 0})
        readings = options["readings"] or max((options["dwell_s"] or _USUAL_DWELL_S) * options["sample_hz"], 1.0)
        made = HandPlan.of(options["count"] or 12, Model(bench), options["white_mps2"] / math.sqrt(readings))
    if as_json:
        print_json(views.hand_plan_object(made))
    else:
        show(views.hand_plan_report(made))


def _prospect(options: Mapping[str, Any], quiet: bool) -> Prospect:
    from kf_calib.bench.bench import Bench
    from kf_calib.design.predicted_information import Prospect

    if options["recording"] is not None:
        return _after(options["recording"], options, quiet)
    keys = {"axes": "y z x", **overrides(options)}
    if "latitude_deg" not in keys:
        keys.setdefault("gravity_mps2", "9.81")
    dwell_s = options["dwell_s"] or _USUAL_DWELL_S
    made = Prospect.of_bench(Bench.from_metadata(keys), options["white_mps2"], 1.0, dwell_s)
    return replace(made, readings=options["readings"] or max(made.still_s * options["sample_hz"], 1.0))


def _after(recording: Path, options: Mapping[str, Any], quiet: bool) -> Prospect:
    import numpy as np

    from kf_calib.design.predicted_information import Prospect
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.sources.tables.table import Table

    source, settings = opened(recording, options)
    gimbals = source.bench if source.bench.axes else _with_gimbals(recording, source.bench, options)
    with progress(f"reading {recording.name}", quiet) as tick:
        result = calibrate(source, settings, tick)
    made = Prospect.after(result.fit, settings.prior)
    if gimbals is not source.bench and made.last is not None:  # where these gimbals stand is not known: at zero
        last = replace(made.last, pose=np.zeros(len(gimbals.axes)))
        made = replace(made, model=Model(gimbals, made.model.effects), last=last)
    if isinstance(source, Table):  # how long its dwells took is not known
        made = replace(made, dwell_s=options["dwell_s"] or _USUAL_DWELL_S)
    longer = (options["dwell_s"] or made.dwell_s) / made.dwell_s
    return replace(made, dwell_s=longer * made.dwell_s, readings=options["readings"] or longer * made.readings)


def _with_gimbals(recording: Path, bench: Bench, options: Mapping[str, Any]) -> Bench:
    """A bench that a run describes by attitudes or faces, with the gimbals that are to be planned for."""
    from kf_calib.bench.bench import parse_axes

    stated = overrides(options).get("axes", "")
    if not stated.strip():
        raise InputError(
            f"{recording} has attitudes or faces and no gimbal angles: say which gimbals are to be turned, for example "
            '--axes "y z x".'
        )
    return replace(bench, axes=parse_axes(stated))


def _reach(bench: Bench, options: Mapping[str, Any]) -> Reach:
    from kf_calib.bench.bench import axis_names
    from kf_calib.bench.gimbal_ranges import ranges
    from kf_calib.design.gimbal_limits import Reach
    from kf_calib.sources.simulation.visit_plans import angles_from_csv

    stated, names = Reach.of(bench), axis_names(bench.axes)
    limits = {**stated.limits_deg, **{j: ends for text in options["limits"] for j, ends in ranges(text, names).items()}}
    zones = [*stated.zones_deg, *(ranges(text, names) for text in options["zones"])]
    path = options["positions"]
    positions = angles_from_csv(path, len(bench.axes)) if path else None
    return Reach(bench, limits, zones, options["grid_deg"], positions)


def _aim(options: Mapping[str, Any], gravity_mps2: float) -> Aim:
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.design import optimality_criteria

    if options["targets"]:
        return optimality_criteria.minimax(optimality_criteria.tolerated(targets_of(options["targets"]), gravity_mps2))
    return optimality_criteria.NAMED[options["criterion"]]
