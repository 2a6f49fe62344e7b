"""Command export: a calibration for another program."""

from __future__ import annotations

from pathlib import Path

import rich_click as click

from kf_calib.cli.command import OUTPUT, command
from kf_calib.cli.echo import print_json, show
from kf_calib.cli.files import claimed, output_option
from kf_calib.cli.options import effects_from_option, json_option, overwrite_option, trust_option, units_option

_NAMES = ["px4", "ardupilot", "imucal", "imu_calib", "kalibr", "openvins", "imu_tk", "vectornav", "csv", "c"]


@command(
    "export cal.json --to c -o kf_calib_correct.h", "export cal.json --to ardupilot --lossy -o accelerometer.param"
)
@click.argument("calibration", type=click.Path(path_type=Path), metavar="CAL")
@click.option("--to", required=True, type=click.Choice(_NAMES), help="The program that is to take it.", panel=OUTPUT)
@output_option("-o", "--out", "output", required=True, metavar="FILE", panel=OUTPUT, help="The file for that program.")
@click.option(
    "--lossy", is_flag=True, panel=OUTPUT,
    help="Export though the program cannot hold all; what is lost, and the error left, are told.",
)  # fmt: skip
@effects_from_option
@trust_option
@overwrite_option
@units_option
@json_option
def export(
    calibration: Path, to: str, output: Path, lossy: bool, effects_from: tuple[Path, ...], trust: bool, overwrite: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Write a calibration as the file of an autopilot, of another calibration tool, or as a function in C.

    Where the program cannot hold the alignment or an effect, the numbers are those with the least rms error, over all
    directions of gravity and the temperatures of the run; how large it is is said, and --lossy is needed.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.exports import exported
    from kf_calib.support.output_files import write_whole
    from kf_calib.views import export as views

    outputs = claimed(overwrite=overwrite)
    saved = calibration_file.read(calibration)
    target = exported(saved, saved.correction(calibration, effects_from, trust), to, lossy)
    content = target.text().encode()
    outputs.write(output, lambda path: write_whole(path, content))
    if as_json:
        print_json(views.exported_object(target, to, output))
    else:
        show(views.exported_report(target, output))
