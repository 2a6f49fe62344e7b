"""The command that writes a calibration for another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, command, option
from kf_calib.cli.echo import print_result
from kf_calib.cli.files import claimed, output_option
from kf_calib.cli.options import CalibrationFile, Json, Overwrite, ProgramOptions, ShownUnits
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.exports.noise_keys import NoiseExport


ExportKind = Literal[
    "px4", "ardupilot", "imucal", "imu_calib", "kalibr", "openvins", "imu_tk", "vectornav", "csv", "c",
    "robot_localization",
]  # fmt: skip


@command(
    "export cal.json --to c -o kf_calib_correct.h", "export cal.json --to ardupilot --lossy -o accelerometer.param",
    "export cal.json --noise noise.json --to kalibr --lossy -o imu.yaml", "export noise.json --to px4 -o noise.params",
)  # fmt: skip
def export(
    calibration: CalibrationFile,
    to: Annotated[ExportKind, option("--to", required=True, help="The program that is to take it.", panel=OUTPUT)],
    output: Annotated[Path, output_option(
        "-o", "--out", required=True, metavar="FILE", help="The file for that program.")],
    lossy: Annotated[bool, option(
        "--lossy", panel=OUTPUT,
        help="Export though the program cannot hold all; what is lost, and the error left, are told.",
    )],
    noise: Annotated[Path | None, option(
        "--noise", metavar="NOISE.json", panel=INPUT, help="The noise, too, as kf-calib noise --save has written it: "
        "for Kalibr, OpenVINS and PX4.")],
    programs: ProgramOptions, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Write a calibration as the file of an autopilot, of another calibration tool, or as a function in C.

    Where the program cannot hold the alignment or an effect, the numbers are those with the least rms error, over all
    directions of gravity and the temperatures of the run; how large it is is said, and --lossy is needed. CAL may be
    what kf-calib noise --save has written: then the file has the noise alone.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exports import exported
    from kf_calib.exports import text as views
    from kf_calib.support.output_files import write_whole

    outputs = claimed(overwrite=overwrite)
    if _is_noise_alone(calibration, to, noise):
        target = _noise_for(calibration if noise is None else noise, to)
        shown_by = views.noise_export_object, views.noise_export_report
    else:
        saved = calibration_file.open_calibration(calibration)
        target = exported(saved, saved.correction(calibration, programs.effects_from, programs.trust), to, lossy)
        target.noise = None if noise is None else _noise_for(noise, to)
        shown_by = views.exported_object, views.exported_report
    content = target.text().encode()
    outputs.write(output, lambda path: write_whole(path, content))
    print_result(as_json, *shown_by, target, to, output)


def _is_noise_alone(path: Path, to: str, noise: Path | None) -> bool:
    """Whether noise is exported and no calibration. Raises UsageError where robot_localization lacks one."""
    from kf_calib.exchange.noise_file import is_noise_file

    if is_noise_file(path):
        if noise is not None:
            raise click.UsageError(f"{path} is noise already: leave out --noise, or give a calibration before it.")
        return True
    if to == "robot_localization" and noise is None:
        raise click.UsageError("robot_localization takes the noise, no calibration: name it with --noise NOISE.json.")
    return to == "robot_localization"


def _noise_for(path: Path, to: str) -> NoiseExport:
    """The noise of a file for a program. Raises InputError where that has no keys for it."""
    from kf_calib.exchange.noise_file import open_noise
    from kf_calib.exports.noise_keys import NoiseExport

    for program in NoiseExport.titles:
        if program == to:
            return NoiseExport(open_noise(path), program)
    raise InputError(f"{to} takes no noise: leave out --noise, or export to {', '.join(NoiseExport.titles)}.")
