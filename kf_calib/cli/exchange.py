"""Commands that use calibrations: apply, verify, history."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.echo import complain
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.options import (
    BENCH_OPTIONS,
    INPUT,
    MODEL,
    OUTPUT,
    effects_from_option,
    examples,
    filter_options,
    json_option,
    opened,
    overrides,
    overwrite_option,
    print_json,
    progress,
    recording_of,
    recording_options,
    show,
    strict_option,
    trust_option,
)
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.estimation.correction import Correction

calibration_argument = partial(click.argument, type=click.Path(path_type=Path))


@click.command(
    epilog=examples("apply cal.json flight.mcap -o flight_calibrated.mcap", "apply cal.json - < lines.csv > out.csv")
)
@calibration_argument("calibration", metavar="CAL")
@calibration_argument("recording", metavar="REC")
@output_option("-o", "--out", metavar="OUT.mcap", panel=OUTPUT,
               help="The copy with /accelerometer/calibrated beside the raw topic.")  # fmt: skip
@recording_options
@effects_from_option
@trust_option
@overwrite_option
@json_option
def apply(
    calibration: Path, recording: Path, out: Path | None, overwrite: bool, as_json: bool, **options: Any
) -> None:
    """Correct the readings of a recording: specific force in the frame of the block, as one more topic.

    REC may be any recording of the block, without platform angles too; - reads lines from standard input and writes
    corrected ones to standard output. Effects that need more than specific force and temperature are left out and named.
    """  # fmt: skip
    from kf_calib.exchange.corrected_file import apply_to_file
    from kf_calib.sources.files.recording import Recording
    from kf_calib.views import exchange as views

    if out is None:
        raise click.UsageError("apply writes a copy of the recording: say where, with -o OUT.mcap.")
    outputs = claimed(overwrite=overwrite)
    saved, correction = _correction(calibration, options)
    source = recording_of(recording, options, angles=False, gravity_mps2=saved.bench.gravity_mps2)
    assert isinstance(source, Recording)
    with progress(f"correcting {recording.name}", as_json) as tick:
        found = []
        outputs.write(out, lambda path: found.append(apply_to_file(correction, source, path, tick)))
    content = views.applied_object(correction, found[0], out, source.warnings)
    if as_json:
        print_json(content)
    else:
        show(views.applied_report(content))


def _correction(path: Path, options: Mapping[str, Any]) -> tuple[SavedCalibration, Correction]:
    """The calibration of a file, and what it corrects."""
    from kf_calib.exchange import calibration_file

    saved = calibration_file.read(path)
    return saved, saved.correction(path, [Path(each) for each in options["effects_from"]], options["trust"])
