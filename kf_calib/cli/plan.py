"""The command plan: orientations for the bench at hand, before a run or in the course of one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import rich_click as click

from kf_calib.bench.keys import BenchKeys
from kf_calib.cli.command import POSITIVE, NumberInRange, command, option
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.files import FigureFiles, claimed, delivery, output_option
from kf_calib.cli.options import EvaluationOptions, Json, Overwrite, ReadingOptions, ShownUnits, opened, target_option
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
    from kf_calib.design.gimbal_limits import GimbalLimits
    from kf_calib.design.optimality_criteria import Aim
    from kf_calib.design.predicted_information import PredictedInformation

_USUAL_DWELL_S = 30.0
_AIM = "What to aim at"
Criterion = Literal["D", "A", "E", "minimax", "condition"]


_of_aim, _of_reach, _of_dwell = (
    partial(option, panel=panel) for panel in (_AIM, "What the bench can do", "What a dwell tells")
)


@dataclass(frozen=True)
class PlanOptions:
    """What is aimed at, what the bench can do, what a dwell tells, and where its angles go."""

    # fmt: off
    count: Annotated[int | None, _of_aim("--count", type=click.IntRange(min=1), metavar="N",
                                         help="Dwells; 12, and 1 where a recording is given.")] = None
    criterion: Annotated[Criterion, _of_aim(
        "--criterion", help="Least generalised variance, mean variance, largest principal sigma, largest sigma (rad, "
        "1, g), or the paper's condition number.")] = "D"
    targets: Annotated[tuple[str, ...], target_option(panel=_AIM)] = ()
    fewest: Annotated[bool, _of_aim("--fewest", help="The fewest dwells that reach all targets.")] = False
    recording: Annotated[Path | None, _of_aim(
        "--recording", metavar="REC", help="A run so far: what comes next, from the filter's own covariance.")] = None
    beside_paper: Annotated[bool, _of_aim(
        "--beside-paper", help="The paper's optimal set beside it, as many readings a dwell.")] = False
    limits: Annotated[tuple[str, ...], _of_reach(
        "--limit", metavar="AXIS=LOW:HIGH", help="Range of a gimbal in deg, as z=-90:90; AXIS: its axis, number, or "
        "outer, middle, inner; repeatable.")] = ()
    zones: Annotated[tuple[str, ...], _of_reach(
        "--forbid", metavar="AXIS=LOW:HIGH,...",
        help="Angles not to be taken, of one gimbal or of several at once; repeatable.")] = ()
    grid_deg: Annotated[float | None, _of_reach(
        "--grid-deg", type=POSITIVE, help="Angles are multiples of this.")] = None
    positions: Annotated[Path | None, _of_reach(
        "--positions", metavar="FILE.csv",
        help="Choose from these orientations, a line of gimbal angles in deg each.")] = None
    repeats: Annotated[int, _of_reach(
        "--repeats", type=click.IntRange(min=1), metavar="N",
        help="Visits to each orientation, coming from others: scatter and hysteresis show.")] = 1
    antipodal: Annotated[bool, _of_reach(
        "--antipodal", help="Each orientation with its opposite, gravity turned over.")] = False
    slew_degps: Annotated[float, _of_reach("--slew-degps", type=POSITIVE, help="Greatest speed, deg/s.")] = 20.0
    time_correlation: Annotated[float, _of_reach(
        "--time-correlation", type=NumberInRange(0, 1), help="Correlation of time with the direction of gravity that "
        "the order may have; slews are the shortest below it.")] = 0.1
    seed: Annotated[int, _of_reach(
        "--seed", type=click.IntRange(min=0), metavar="N", help="Seed of the order of visits.")] = 0
    dwell_s: Annotated[float | None, _of_dwell(
        "--dwell-s", type=POSITIVE, help="Seconds in each orientation; as in the recording, or 30.")] = None
    sample_hz: Annotated[float, _of_dwell("--sample-hz", type=POSITIVE, help="Rate of the readings.")] = 100.0
    readings: Annotated[float | None, _of_dwell(
        "--readings", type=POSITIVE, help="Readings of a dwell that are used, in place of the two above.")] = None
    white_mps2: Annotated[float, _of_dwell(
        "--white", type=POSITIVE, help="White noise of a reading, m/s^2, where no recording tells it.")] = 1e-4
    csv_file: Annotated[Path | None, output_option(
        "--csv", metavar="FILE.csv", help="Save the angles, for simulate --plan.")] = None
    # fmt: on


@command(
    "plan --count 12 --limit z=-90:90 --csv plan.csv", "plan --target K=2ppm --fewest", "plan --recording run.mcap",
    seldom=("beside_paper", "zones", "grid_deg", "repeats", "antipodal", "time_correlation", "seed", "readings",
            "white_mps2", "sample_hz", "accel_unit", "angle_unit", "columns", "effects", "model_file", "left_out"),
)  # fmt: skip
def plan(
    options: PlanOptions, figures: FigureFiles, overwrite: Overwrite, reading: ReadingOptions,
    evaluation: EvaluationOptions, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Orientations that determine the parameters best: which, in which order, and the sigmas to expect."""
    from kf_calib.design import orientation_plan
    from kf_calib.design.exact_design import Scheme, Search
    from kf_calib.design.gimbal_limits import Timing
    from kf_calib.views import plan as views

    _refuse_contradictions(options, figures, reading, evaluation)
    if reading.no_angles:
        _plan_by_hand(options, reading, evaluation, as_json)
        return
    outputs = claimed(overwrite=overwrite)
    information = _information(options, reading, evaluation, as_json)
    limits = _limits(information.model.bench, options)
    scheme = Scheme.of(limits, options.repeats, options.antipodal)
    search = Search(information, limits, _aim(options, information.model.bench.gravity_mps2), scheme)
    timing = Timing(information.dwell_s, options.slew_degps, options.time_correlation)
    with progress("planning", as_json):
        if options.fewest:
            made = orientation_plan.fewest(search, timing, options.seed)
        else:
            count = options.count or (scheme.copies if options.recording else 12)
            made = orientation_plan.plan(search, count, timing, options.seed)
    print_result(as_json, views.plan_object, views.plan_report, made, options.beside_paper)
    with delivery(outputs, as_json) as deliver:
        deliver.file(options.csv_file, lambda path: views.write_csv(made, path))
        figures.save(deliver, made)


def _refuse_contradictions(
    options: PlanOptions, figures: FigureFiles, reading: ReadingOptions, evaluation: EvaluationOptions
) -> None:
    of_gimbals = (options.targets, options.fewest, options.limits, options.zones, options.grid_deg, options.positions,
                  options.beside_paper, options.csv_file, figures != FigureFiles())  # fmt: skip
    contradictions = {
        "--no-angles plans sides to turn up by hand: leave out targets, limits of gimbals, pictures, files of "
        "angles and --beside-paper.": reading.no_angles and any(of_gimbals),
        "--fewest needs a target to reach, for example --target K=2ppm.": options.fewest and not options.targets,
        "--fewest finds the count itself: leave out --count.": options.fewest and options.count,
        "--target has a criterion of its own, the worst sigma: leave out --criterion.":
            options.targets and options.criterion not in ("D", "minimax"),
        "--grid-deg and --positions are two answers to one question: choose one.":
            options.grid_deg and options.positions,
        "--with needs a recording (--recording): a plan from nothing is for the twelve parameters.":
            evaluation.effects and not options.recording,
    }  # fmt: skip
    for said, holds in contradictions.items():
        if holds:
            raise click.UsageError(said)


def _plan_by_hand(options: PlanOptions, reading: ReadingOptions, evaluation: EvaluationOptions, as_json: bool) -> None:
    """Print which sides to turn up where there are no angles."""
    from kf_calib.bench.bench import Bench
    from kf_calib.design.sides import HandPlan
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.views import plan as views

    if options.recording is not None:
        source, settings = opened(options.recording, reading, evaluation)
        with progress("reading", as_json) as tick:
            before = calibrate(source, settings, tick).fit
        counts, noise = [dwell.count for dwell in before.dwells], before.noise
        sigma = math.hypot(noise.effective_sigma_mps2.mean() / math.sqrt(sum(counts) / len(counts)),
                           noise.scatter_mps2.mean())  # fmt: skip
        made = HandPlan.of(options.count or 1, before.linearised.model, sigma, before)
    else:
        keys: BenchKeys = {"gravity_mps2": 9.80665, **reading.keys}
        bench = replace(Bench.from_metadata(keys, has_angles=False), angles=False, nominal={"theta1": 0, "theta3": 0})
        readings = options.readings or max((options.dwell_s or _USUAL_DWELL_S) * options.sample_hz, 1.0)
        made = HandPlan.of(options.count or 12, Model(bench), options.white_mps2 / math.sqrt(readings))
    print_result(as_json, views.hand_plan_object, views.hand_plan_report, made)


def _information(
    options: PlanOptions, reading: ReadingOptions, evaluation: EvaluationOptions, quiet: bool
) -> PredictedInformation:
    from kf_calib.bench.bench import Bench
    from kf_calib.design.predicted_information import PredictedInformation

    if options.recording is not None:
        return _after(options.recording, options, reading, evaluation, quiet)
    keys: BenchKeys = {"axes": "y z x", **reading.keys}
    if "latitude_deg" not in keys:
        keys.setdefault("gravity_mps2", 9.81)
    dwell_s = options.dwell_s or _USUAL_DWELL_S
    made = PredictedInformation.of_bench(Bench.from_metadata(keys), options.white_mps2, 1.0, dwell_s)
    return replace(made, readings=options.readings or max(made.still_s * options.sample_hz, 1.0))


def _after(
    recording: Path, options: PlanOptions, reading: ReadingOptions, evaluation: EvaluationOptions, quiet: bool
) -> PredictedInformation:
    import numpy as np

    from kf_calib.bench.streams import Table
    from kf_calib.design.predicted_information import PredictedInformation
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.measurement_model import Model

    source, settings = opened(recording, reading, evaluation)
    gimbals = source.bench if source.bench.axes else _with_gimbals(recording, source.bench, reading)
    with progress(f"reading {recording.name}", quiet) as tick:
        result = calibrate(source, settings, tick)
    made = PredictedInformation.after(result.fit, settings.prior)
    if gimbals is not source.bench and made.last is not None:  # where these gimbals stand is not known: at zero
        last = replace(made.last, pose=np.zeros(len(gimbals.axes)))
        made = replace(made, model=Model(gimbals, made.model.effects), last=last)
    if isinstance(source, Table):  # how long its dwells took is not known
        made = replace(made, dwell_s=options.dwell_s or _USUAL_DWELL_S)
    longer = (options.dwell_s or made.dwell_s) / made.dwell_s
    return replace(made, dwell_s=longer * made.dwell_s, readings=options.readings or longer * made.readings)


def _with_gimbals(recording: Path, bench: Bench, reading: ReadingOptions) -> Bench:
    """A bench that a run describes by attitudes or faces, with the gimbals that are to be planned for."""
    from kf_calib.bench.bench import parse_axes

    stated = reading.keys.get("axes", "")
    if not stated.strip():
        raise InputError(
            f"{recording} has attitudes or faces and no gimbal angles: say which gimbals are to be turned, for example "
            '--axes "y z x".'
        )
    return replace(bench, axes=parse_axes(stated))


def _limits(bench: Bench, options: PlanOptions) -> GimbalLimits:
    from kf_calib.bench.bench import axis_names
    from kf_calib.bench.keys import ranges
    from kf_calib.design.gimbal_limits import GimbalLimits
    from kf_calib.sources.simulation.visit_plans import angles_from_csv

    stated, names = GimbalLimits.of(bench), axis_names(bench.axes)
    limits = {**stated.limits_deg, **{j: ends for text in options.limits for j, ends in ranges(text, names).items()}}
    zones = [*stated.zones_deg, *(ranges(text, names) for text in options.zones)]
    path = options.positions
    positions = angles_from_csv(path, len(bench.axes)) if path else None
    return GimbalLimits(bench, limits, zones, options.grid_deg, positions)


def _aim(options: PlanOptions, gravity_mps2: float) -> Aim:
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.design import optimality_criteria

    if options.targets:
        return optimality_criteria.minimax(optimality_criteria.tolerated(targets_of(options.targets), gravity_mps2))
    return optimality_criteria.NAMED[options.criterion]
