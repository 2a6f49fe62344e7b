"""Commands that use calibrations: apply, verify, history."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.files import claimed, output_option
from kf_calib.cli.options import (
    OUTPUT,
    dwell_options,
    effects_from_option,
    examples,
    json_option,
    overwrite_option,
    print_json,
    progress,
    recording_of,
    recording_options,
    show,
    strict_option,
    trust_option,
    units_option,
    used_of,
)

if TYPE_CHECKING:
    from kf_calib.estimation.correction import Correction
    from kf_calib.exchange.calibration_file import SavedCalibration

_file = partial(click.argument, type=click.Path(path_type=Path))


@click.command(epilog=examples("apply cal.json flight.mcap -o flight_calibrated.mcap"))
@_file("calibration", metavar="CAL")
@_file("recording", metavar="REC")
@output_option("-o", "--out", required=True, metavar="OUT.mcap", panel=OUTPUT,
               help="The copy, with /accelerometer/calibrated beside the raw topic.")  # fmt: skip
@recording_options
@effects_from_option
@trust_option
@overwrite_option
@units_option
@json_option
def apply(calibration: Path, recording: Path, out: Path, overwrite: bool, as_json: bool, **options: Any) -> None:
    """Correct the readings of a recording: specific force in the frame of the block, as one more topic of a copy.

    REC may be any recording of the block; it needs no platform angles. Effects that depend on more than specific force
    and temperature cannot be corrected so; they are left out and named.
    """  # fmt: skip
    from kf_calib.exchange.corrected_file import apply_to_file
    from kf_calib.views import exchange as views

    outputs = claimed(overwrite=overwrite)
    saved, correction = _correction(calibration, options)
    options["gravity_mps2"] = options["gravity_mps2"] or saved.bench.gravity_mps2
    source = recording_of(recording, options, angles=False)
    found = []
    with progress(f"correcting {recording.name}", as_json) as tick:
        outputs.write(out, lambda path: found.append(apply_to_file(correction, source, path, tick)))
    if as_json:
        print_json(views.applied_object(correction, found[0], out, source.warnings))
    else:
        show(views.applied_report(correction, found[0], out, source.warnings))


def _correction(path: Path, options: Mapping[str, Any]) -> tuple[SavedCalibration, Correction]:
    """The calibration of a file, and what it corrects."""
    from kf_calib.exchange import calibration_file

    saved = calibration_file.read(path)
    return saved, saved.correction(path, options["effects_from"], options["trust"])


@click.command(epilog=examples("verify cal.json check.mcap", "verify cal.json check.mcap --strict --json"))
@_file("calibration", metavar="CAL")
@_file("recording", metavar="REC")
@recording_options
@dwell_options
@effects_from_option
@trust_option
@strict_option
@units_option
@json_option
@click.pass_context
def verify(ctx: click.Context, calibration: Path, recording: Path, strict: bool, as_json: bool, **options: Any) -> None:
    """Does an old calibration still hold for a new recording of the block? Which parameters have moved, and how much?

    A few orientations are enough to test it as a whole; parameters are compared that the new ones determine.
    """  # fmt: skip
    from kf_calib.estimation.settings import Settings
    from kf_calib.exchange import calibration_file, verification
    from kf_calib.views import exchange as views

    saved = calibration_file.read(calibration)
    verification.refuse_incomplete(saved)
    source = recording_of(recording, options)
    model = saved.model(calibration, options["effects_from"], options["trust"], source.bench)
    with progress(f"verifying with {recording.name}", as_json) as tick:
        found = verification.verify(saved, model, source, Settings(**used_of(options)), tick)
    if as_json:
        print_json(views.verification_object(found))
    else:
        show(views.verification_report(found))
    if strict and not found.holds:
        ctx.exit(1)


@click.command(epilog=examples("history cal_*.json --tolerance K=20ppm --tolerance b=100ug"))
@click.argument("calibrations", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CAL...")
@click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="NAME=SIZE",
    help="By how much a parameter (theta1, K2), a kind (theta, phi, nu, K, b) or all angles may be wrong, "
    "with a unit (20ppm, 100ug, 5arcsec) or in SI; repeatable. The date of the next calibration follows.",
)
@units_option
@json_option
def history(calibrations: tuple[Path, ...], tolerances: tuple[str, ...], as_json: bool) -> None:
    """The calibrations of one block over time: drift, repeatability, and when to calibrate again."""
    from kf_calib.bench.targets import targets_of
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.history import history as found_in
    from kf_calib.views import exchange as views

    wanted = targets_of(tolerances)
    found = found_in([calibration_file.read(path) for path in calibrations], wanted)
    if as_json:
        print_json(views.history_object(found))
    else:
        show(views.history_report(found))
