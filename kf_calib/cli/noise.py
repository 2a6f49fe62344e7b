"""The command noise: what the sensors of a recording show at rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from kf_calib.bench.keys import BenchKeys
from kf_calib.cli.command import INPUT, MODEL, NOT_NEGATIVE, POSITIVE, argument, command, option
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.files import FigureFiles, claimed, delivery, output_option
from kf_calib.cli.options import Json, Overwrite, ReadingOptions, ShownUnits, renamed
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source

_AXES = ("ax_mps2", "ay_mps2", "az_mps2")
_SIZES = {"rad/s": 1.0, "deg/s": 0.017453292519943295}


# fmt: off
@command("noise rest.csv --png noise.png --save noise.json", "noise run.mcap --json",
         "noise bag --gyro /imu:angular_velocity.x,angular_velocity.y,angular_velocity.z",
         seldom=("axes", "angle_unit", "no_angles"))
def noise(
    recording: Annotated[Path, argument()], reading: ReadingOptions,
    gyro: Annotated[str | None, option(
        "--gyro", metavar="X,Y,Z", panel=INPUT, help="Take the gyroscopes along: names of their columns, or in a bag "
        "TOPIC:PATHS, as for --field.")],
    gyro_unit: Annotated[Literal["rad/s", "deg/s"], option("--gyro-unit", default="rad/s", show_default=True,
                                                           panel=INPUT, help="Unit of the gyroscopes.")],
    temperature: Annotated[bool, option("--temperature", panel=INPUT, help="Take the thermometer along.")],
    settle_s: Annotated[float, option("--settle-s", type=NOT_NEGATIVE, default=1.0, show_default=True, panel=MODEL,
                                      help="Seconds left out after each arrival.")],
    still_deg: Annotated[float, option("--still-deg", type=POSITIVE, default=0.05, show_default=True, panel=MODEL,
                                       help="Turn within a rest that is still none, deg.")],
    save: Annotated[Path | None, output_option("--save", metavar="NOISE.json",
                                               help="Save the noise here, for export.")],
    figures: FigureFiles, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:
    """White noise, bias instability, random walk and quantisation of each channel at rest, with intervals.

    A rest of any length, or the dwells of any recording: what moves is left out. By the likelihood of the readings and,
    beside it, by the overlapping Allan variance; platform angles are not looked at.
    """
    # fmt: on
    from kf_calib.dwells.stationarity import Stillness
    from kf_calib.noise.rest_noise import noise_at_rest
    from kf_calib.views import noise as views

    outputs = claimed(overwrite=overwrite)
    reading = replace(reading, no_angles=True)
    gyroscopes = None if gyro is None else _gyroscopes(recording, reading, gyro, _SIZES[gyro_unit])
    if gyro is not None and ":" not in gyro:
        reading = replace(reading, columns=(*reading.columns, *(f"{name.strip()}=-" for name in gyro.split(","))))
    source = reading.opened(recording)
    with progress(f"reading {recording.name}", as_json) as tick:
        rest_noise = noise_at_rest(
            source, Stillness(tolerance_deg=still_deg, settle_s=settle_s), gyroscopes=gyroscopes,
            with_temperature=temperature, on_progress=tick,
        )  # fmt: skip
    told = tuple(each for each in rest_noise.warnings if not each.startswith("gravity is taken"))  # it does not matter
    rest_noise = replace(rest_noise, warnings=told)
    print_result(as_json, views.noise_object, views.noise_report, rest_noise)
    with delivery(outputs, as_json) as deliver:
        if save is not None:
            from kf_calib.exchange.noise_file import saved_noise, write_noise
            from kf_calib.sources.files.record_files import fingerprint

            content = saved_noise(rest_noise, recording.name, fingerprint(recording))
            deliver.file(save, lambda path: write_noise(path, content))
        figures.save(deliver, rest_noise)


def _gyroscopes(path: Path, reading: ReadingOptions, gyro: str, size: float) -> Source:
    """The recording once more, with the gyroscopes in place of the readings; size: of their unit, rad/s."""
    from kf_calib.sources.file_kind import FileKind
    from kf_calib.sources.files.mcap_file import McapFile
    from kf_calib.sources.files.recording import Recording
    from kf_calib.sources.text.lines import Lines
    from kf_calib.sources.text.names import meanings_of
    from kf_calib.sources.text.units import Units

    keys: BenchKeys = {"accel_scale": size, "accel_unit": "m/s2", "restate_input": True}
    if reading.kind(path) is FileKind.RECORDING:
        if ":" not in gyro:
            McapFile(path)  # refuses what is no such file
            raise InputError(f"--gyro {gyro!r} names no topic: write --gyro TOPIC:X,Y,Z with the paths of the rates.")
        return Recording(path, keys, fields=(f"accel={gyro}",), max_chunk_mb=reading.max_chunk_mb, angles=False)
    names = [name.strip() for name in gyro.split(",")]
    dataset = reading.accel_topic or ""
    header = _header(path, dataset)
    absent = [name for name in names if name not in header]
    if len(names) != len(_AXES) or absent:
        lacking = f"there is no column {absent[0]!r}" if len(names) == len(_AXES) else "it takes three names"
        raise InputError(f"--gyro {gyro!r}: {lacking}; the columns are {', '.join(header)}.")
    stated = {theirs: ours for theirs, ours in renamed(reading.columns).items() if ours.startswith("time")}
    told = dict(zip(header, meanings_of(header, stated), strict=True))
    others = {name: "-" for name, meaning in told.items() if name not in names and meaning.ours not in ("time", "")}
    columns = others | dict(zip(names, _AXES, strict=True)) | stated
    return Lines(path, keys, columns, units=replace(Units.of(keys), dataset=dataset), angles=False)


def _header(path: Path, dataset: str) -> list[str]:
    """The names of a log's columns; dataset: of a container."""
    from kf_calib.sources.text.encoding import head_of
    from kf_calib.sources.text.heading import TextHeading

    lines = [line for line in head_of(path, dataset).decode(errors="replace").splitlines() if line.strip()]
    if not lines or lines[0].lstrip("\ufeff \t").startswith(("{", "[")):
        raise InputError(f"{path}: --gyro is for columns of CSV and for bags, and this has neither.")
    return [name for name in TextHeading.of(lines).header if name]
