"""Options that commands share, and how they print."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.calibration import Settings
    from kf_calib.sources.recording import Recording

F = TypeVar("F", bound=Callable[..., Any])

BENCH_OPTIONS = {
    "axes": ("--axes", 'Gimbal axes, outer to inner, for example "y z x".'),
    "joints": ("--joints", 'Names of the gimbals among the joints of a bag, outer to inner, as "outer middle inner".'),
    "reference": ("--reference", "base (angles relative to the bench) or inertial (stabilised platform)."),
    "gravity_mps2": ("--gravity", "Local gravity, m/s^2."),
    "latitude_deg": ("--latitude", "Latitude, deg; gives normal gravity where --gravity is not stated."),
    "height_m": ("--height", "Height, m, for normal gravity."),
    "azimuth_deg": ("--azimuth", "Azimuth of the bench's x axis from North toward East, deg."),
    "angle_sigma_deg": ("--angle-sigma", "Repeatability of setting an orientation, 1 sigma, deg (0: exact)."),
    "scatter_sigma_mps2": ("--scatter-sigma", "Scatter of each sensor from dwell to dwell, 1 sigma, m/s^2."),
    "nominal": ("--nominal", "Nominal parameters that differ, JSON, for example '{\"theta1\": 0}'."),
}
_ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
_ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "ug": 9.80665e-6}


def bench_options(command: F) -> F:
    """The keys of the bench's record, for recordings that lack them; ``--bench`` reads them from a TOML file."""
    for key, (name, text) in reversed(BENCH_OPTIONS.items()):
        command = click.option(name, key, default=None, help=text)(command)
    return click.option("--bench", "bench_file", type=click.Path(path_type=Path), help="TOML file of bench keys.")(
        command
    )


def recording_options(command: F) -> F:
    """How to read a recording: topics, unit of the readings, and the bench."""
    options = [
        click.option("--accel-topic", help="Topic of the accelerometer, where there are several."),
        click.option("--pose-topic", help="Topic of the platform's angles or attitude."),
        click.option("--temperature-topic", help="Topic of the temperature."),
        click.option(
            "--accel-unit", type=click.Choice(list(_ACCEL_UNITS)), default="m/s2", help="Unit of the readings."
        ),
        click.option("--accel-scale", type=float, default=1.0, help="Size of one count, in the unit of the readings."),
        click.option(
            "--angle-unit", type=click.Choice(list(_ANGLE_UNITS)), default="rad", help="Unit of the gimbal angles."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return bench_options(command)


columns_option = click.option(
    "--column", "columns", multiple=True, metavar="THEIRS=OURS",
    help='Name of a foreign column, for example --column "acc x [g]=ax_g"; repeatable.',
)  # fmt: skip
rrd_option = click.option("--rrd", type=click.Path(path_type=Path), help="Save the Rerun view here.")
png_option = click.option("--png", type=click.Path(path_type=Path), help="Save a picture of the Rerun view here.")
save_model_option = click.option(
    "--save-model", type=click.Path(path_type=Path), help="Save the model here, for --model to read."
)
effects_from_option = click.option(
    "--effects-from", "effects_from", multiple=True, type=click.Path(path_type=Path), metavar="FILE.py",
    help="A Python file with effect classes of your own, for --with to name; repeatable.",
)  # fmt: skip


def filter_options(command: F) -> F:
    """How a run is evaluated."""
    options = [
        click.option("--engine", type=click.Choice(["block", "filterpy"]), default="block", show_default=True,
                     help="Block square-root filter, or filterpy sample by sample."),
        click.option("--with", "effects", multiple=True, metavar="EFFECT",
                     help="An effect to put in the model, for example second-order, or a formula of your own, "
                     "for example 'mine = fx*fy*T'; repeatable."),
        effects_from_option,
        click.option("--model", "model_file", type=click.Path(path_type=Path),
                     help="A model file (replay --save-model); its effects come before those of --with."),
        click.option("--prior", type=click.Choice(["diffuse", "navigation", "mems"]), default="diffuse",
                     show_default=True, help="What is believed of the sensors before the run."),
        click.option("--bias-walk", type=click.FloatRange(min=0), default=0.0,
                     help="Random walk of the biases, m/s^2 per square root of a second (process noise)."),
        click.option("--gate/--no-gate", default=True, show_default=True, help="Reject outlying readings."),
        click.option("--gate-sigma", type=click.FloatRange(min=3), default=6.0, show_default=True,
                     help="Where the gate stands, robust sigma."),
        click.option("--still-deg", type=click.FloatRange(min=0, min_open=True), default=0.05, show_default=True,
                     help="Motion within a second that still counts as standing still, deg."),
        click.option("--settle-s", type=click.FloatRange(min=0), default=1.0, show_default=True,
                     help="Seconds left out after each arrival."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
strict_option = click.option("--strict", is_flag=True, help="Exit with 1 where model and measurements disagree.")


def overrides(options: Mapping[str, Any]) -> dict[str, str]:
    """Bench keys from the TOML file and, over them, from options."""
    keys: dict[str, str] = {}
    if options["bench_file"]:
        keys |= _bench_from_toml(options["bench_file"])
    keys |= {key: options[key] for key in BENCH_OPTIONS if options[key] is not None}
    return keys


def _bench_from_toml(path: Path) -> dict[str, str]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML ({error}); write lines such as gravity_mps2 = 9.81.") from None
    table = table.get("bench", table)
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in table.items()}


def recording_of(path: Path, options: Mapping[str, Any]) -> Recording:
    from kf_calib.sources.recording import Recording

    return Recording(
        path,
        overrides(options),
        _ACCEL_UNITS[options["accel_unit"]] * options["accel_scale"],
        angle_scale=_ANGLE_UNITS[options["angle_unit"]],
        accel_topic=options["accel_topic"],
        pose_topic=options["pose_topic"],
        temperature_topic=options["temperature_topic"],
    )


def settings_of(options: Mapping[str, Any]) -> Settings:
    from kf_calib.calibration import Settings
    from kf_calib.model import PRIORS
    from kf_calib.stillness import Stillness

    return Settings(
        engine=options["engine"],
        prior=PRIORS[options["prior"]],
        stillness=Stillness(tolerance_deg=options["still_deg"], settle_s=options["settle_s"]),
        gate_sigma=options["gate_sigma"] if options["gate"] else None,
        walk_mps2_per_sqrt_s=options["bias_walk"],
        effects=effects_of(options),
    )


def opened(path: Path, options: Mapping[str, Any]) -> tuple[Recording, Settings]:
    """A recording and how to evaluate it; a model that cannot be made is refused before any reading is read."""
    from kf_calib.model import Model

    settings = settings_of(options)
    source = recording_of(path, options)
    Model.of(source.bench, settings.effects)
    return source, settings


def effects_of(options: Mapping[str, Any]) -> tuple[str, ...]:
    """Effects of the model file, then those of ``--with``; the user's files are read first."""
    from kf_calib.effects import load_file, merged, refuse_unknown

    for path in options["effects_from"]:
        load_file(path)
    for text in options["effects"]:
        refuse_unknown(text)  # at once, not after a long recording was read
    if options["model_file"] is None:
        return tuple(options["effects"])
    from kf_calib import model_file

    return merged(model_file.read(options["model_file"]).effects, options["effects"])


def print_json(content: Mapping[str, Any]) -> None:
    click.echo(json.dumps(content, ensure_ascii=False, allow_nan=False))


def show(renderable: Any) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else 110, highlight=False, soft_wrap=not sys.stdout.isatty())
    console.print(renderable)


@contextlib.contextmanager
def progress(text: str, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """A progress bar on a terminal's stderr; nothing where stderr is piped."""
    if quiet or not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(text, total=1.0)
        yield lambda fraction: bars.update(task, completed=fraction if fraction == fraction else 0.0)


def save_views(result: Any, rrd: Path | None, png: Path | None) -> None:
    """The Rerun view of a run, and its picture."""
    if rrd or png:
        from kf_calib.views import rerun

        save_pictures(lambda path: rerun.save(result, path), rrd, png)


def save_pictures(save: Callable[[Path], object], rrd: Path | None, png: Path | None) -> None:
    """What ``save`` writes as a Rerun recording, and a picture of it; either may be left out."""
    if not (rrd or png):
        return
    import tempfile

    from kf_calib.views import screenshot

    with tempfile.TemporaryDirectory() as folder:
        saved = rrd or Path(folder) / "view.rrd"
        save(saved)
        if png:
            screenshot.screenshot(saved, png)
