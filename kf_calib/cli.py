"""The command line: options in, one call of the library, a view out.

Every command with ``--json`` prints one JSON object on stdout and nothing else there. Exit 0: done; 1: the model is
inconsistent and ``--strict`` asked; 2: bad usage or input, with one sentence on stderr.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from kf_calib.errors import InputError, KfCalibError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kf_calib.bench import Vector
    from kf_calib.calibration import Settings
    from kf_calib.samples import Source
    from kf_calib.sources.plans import Visit
    from kf_calib.sources.recording import Recording
    from kf_calib.sources.simulator import Simulation

F = TypeVar("F", bound=Callable[..., Any])

_BENCH_OPTIONS = {
    "axes": ("--axes", 'Gimbal axes, outer to inner, for example "y z x".'),
    "reference": ("--reference", "base (angles relative to the bench) or inertial (stabilised platform)."),
    "gravity_mps2": ("--gravity", "Local gravity, m/s^2."),
    "latitude_deg": ("--latitude", "Latitude, deg; gives normal gravity where --gravity is not stated."),
    "height_m": ("--height", "Height, m, for normal gravity."),
    "azimuth_deg": ("--azimuth", "Azimuth of the bench's x axis from North toward East, deg."),
    "angle_sigma_deg": ("--angle-sigma", "Repeatability of setting an orientation, 1 sigma, deg (0: exact)."),
    "scatter_sigma_mps2": ("--scatter-sigma", "Scatter of each sensor from dwell to dwell, 1 sigma, m/s^2."),
    "nominal": ("--nominal", "Nominal parameters that differ, JSON, for example '{\"theta1\": 0}'."),
}
_ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "ug": 9.80665e-6}


def bench_options(command: F) -> F:
    """The keys of the bench's record, for recordings that lack them; ``--bench`` reads them from a TOML file."""
    for key, (name, text) in reversed(_BENCH_OPTIONS.items()):
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
    ]
    for option in reversed(options):
        command = option(command)
    return bench_options(command)


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


def _overrides(options: Mapping[str, Any]) -> dict[str, str]:
    """Bench keys from the TOML file and, over them, from options."""
    keys: dict[str, str] = {}
    if options["bench_file"]:
        keys |= _bench_from_toml(options["bench_file"])
    keys |= {key: options[key] for key in _BENCH_OPTIONS if options[key] is not None}
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


def _recording(path: Path, options: Mapping[str, Any]) -> Recording:
    from kf_calib.sources.recording import Recording

    return Recording(
        path,
        _overrides(options),
        _ACCEL_UNITS[options["accel_unit"]] * options["accel_scale"],
        accel_topic=options["accel_topic"],
        pose_topic=options["pose_topic"],
        temperature_topic=options["temperature_topic"],
    )


def _settings(options: Mapping[str, Any]) -> Settings:
    from kf_calib.calibration import Settings
    from kf_calib.dwells import Stillness
    from kf_calib.model import PRIORS

    return Settings(
        engine=options["engine"],
        prior=PRIORS[options["prior"]],
        stillness=Stillness(tolerance_deg=options["still_deg"], settle_s=options["settle_s"]),
        gate_sigma=options["gate_sigma"] if options["gate"] else None,
        walk_mps2_per_sqrt_s=options["bias_walk"],
        effects=_effects(options),
    )


def _opened(path: Path, options: Mapping[str, Any]) -> tuple[Recording, Settings]:
    """A recording and how to evaluate it; a model that cannot be made is refused before any reading is read."""
    from kf_calib.model import Model

    settings = _settings(options)
    source = _recording(path, options)
    Model.of(source.bench, settings.effects)
    return source, settings


def _effects(options: Mapping[str, Any]) -> tuple[str, ...]:
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


def _print_json(content: Mapping[str, Any]) -> None:
    click.echo(json.dumps(content, ensure_ascii=False, allow_nan=False))


def _show(renderable: Any) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else 110, highlight=False, soft_wrap=not sys.stdout.isatty())
    console.print(renderable)


@contextlib.contextmanager
def _progress(text: str, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """A progress bar on a terminal's stderr; nothing where stderr is piped."""
    if quiet or not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(text, total=1.0)
        yield lambda fraction: bars.update(task, completed=fraction if fraction == fraction else 0.0)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="kf_calib")
def cli() -> None:
    """Calibrate accelerometers on a stationary gimballed bench with a Kalman filter."""


@cli.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--rrd", type=click.Path(path_type=Path), help="Save the Rerun view here.")
@click.option("--png", type=click.Path(path_type=Path), help="Save a picture of the Rerun view here.")
@click.option("--save-model", type=click.Path(path_type=Path), help="Save the model here, for --model to read.")
@recording_options
@filter_options
@strict_option
@json_option
@click.pass_context
def replay(
    ctx: click.Context,
    recording: Path,
    rrd: Path | None,
    png: Path | None,
    save_model: Path | None,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a recording through the filter: twelve parameters, their sigma, and whether the model fits."""
    from kf_calib.calibration import calibrate

    source, settings = _opened(recording, options)
    with _progress(f"replaying {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    _save_views(result, rrd, png)
    if save_model:
        from kf_calib import model_file

        model_file.write(save_model, result)
    if as_json:
        from kf_calib.views.json import replay_object

        _print_json(replay_object(result))
    else:
        from kf_calib.views.console import summary

        _show(summary(result))
        for path in filter(None, (rrd, png, save_model)):
            click.echo(f"saved {path}")
    if strict and result.consistency.consistent is False:
        ctx.exit(1)


def _save_views(result: Any, rrd: Path | None, png: Path | None) -> None:
    if not (rrd or png):
        return
    import tempfile

    from kf_calib.views import rerun, screenshot

    with tempfile.TemporaryDirectory() as folder:
        saved = rrd or Path(folder) / "view.rrd"
        rerun.save(result, saved)
        if png:
            screenshot.screenshot(saved, png)


@cli.command()
@click.argument("recording", type=click.Path(path_type=Path))
@recording_options
@filter_options
@json_option
def compare(recording: Path, as_json: bool, **options: Any) -> None:
    """Block engine, filterpy and batch least squares on the same recording: differences, time, memory."""
    from kf_calib.comparison import compare as run

    source, settings = _opened(recording, options)
    with _progress(f"comparing on {recording.name}", as_json):
        compared = run(source, settings)
    if as_json:
        from kf_calib.views.json import compare_object

        _print_json(compare_object(compared))
    else:
        from kf_calib.views.console import comparison_table

        _show(comparison_table(compared))


@cli.command("effects")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    metavar="REC",
    help="Say of each effect what this recording shows of it: visible, smallest size, confused with what.",
)
@recording_options
@filter_options
@json_option
def list_effects(names: tuple[str, ...], recording: Path | None, as_json: bool, **options: Any) -> None:
    """The effects a model may have: all of the catalogue and your own, or those NAMEd (formulas too) in detail.

    Without --recording they are those of a bench with --axes "y z x" at --latitude 50, or as stated.
    """  # fmt: skip
    from kf_calib.bench import Bench
    from kf_calib.effects import effect_named, refuse_unknown
    from kf_calib.effects import names as known
    from kf_calib.views import catalogue

    _effects(options)
    for name in names:
        refuse_unknown(name)
    if recording is not None:
        _list_visible(recording, names, as_json, options)
        return
    bench = Bench.from_metadata({"axes": "y z x", "latitude_deg": "50"} | _overrides(options))
    chosen = [effect_named(name, bench) for name in names or known(bench)]
    if as_json:
        _print_json(catalogue.effects_object(chosen))
    else:
        _show(catalogue.details(chosen) if names else catalogue.overview(chosen))


def _list_visible(recording: Path, names: tuple[str, ...], as_json: bool, options: Mapping[str, Any]) -> None:
    """What a recording shows of effects, beside the model of the options."""
    from kf_calib.calibration import calibrate
    from kf_calib.effects import effect_named
    from kf_calib.effects import names as known
    from kf_calib.views import catalogue
    from kf_calib.views.json import clean
    from kf_calib.visibility import sights

    source, settings = _opened(recording, options)
    chosen = [effect_named(name, source.bench) for name in names or known(source.bench)]
    with _progress(f"reading {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    seen = sights(result.fit, chosen)
    if as_json:
        _print_json(clean(catalogue.sights_object(seen, [str(effect) for effect in result.model.effects])))
    else:
        title = f"What {recording.name} shows of {len(seen)} effects beside {result.model.sum}"
        _show(catalogue.sight_report(seen, title))


def _list_hidden(ctx: click.Context, _: click.Parameter, texts: tuple[str, ...]) -> tuple[str, ...]:
    """``--hide help`` prints what can be hidden, and ends."""
    if "help" in texts:
        _show(_hidden_table())
        ctx.exit()
    return texts


def _hidden_table() -> RenderableType:
    """Every kind of hidden effect, in two lines or more."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Group
    from rich.table import Table

    from kf_calib.sources.hidden import INNER, catalogue

    kinds = catalogue().values()
    table = Table(title=f"{len(kinds)} effects to hide", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("effect\nwhat it is", min_width=26)
    for heading in ("in the\ncatalogue", "SI unit\ncoefficients", "constants", "navigation grade\nMEMS"):
        table.add_column(heading, no_wrap=True)
    for kind in kinds:
        names = kind.coefficients if len(kind.coefficients) < 7 else (*kind.coefficients[:2], "...")
        constants = [f"{name}={value:.4g} {INNER[name].unit}" for name, value in kind.inner.items()]
        sizes = [" to ".join(dict.fromkeys(sizes)) for sizes in (kind.navigation, kind.mems)]
        table.add_row(
            f"{kind.name}{':AXIS' * kind.per_axis}\n{kind.title}", "yes" if kind.known else "no",
            f"{kind.unit}\n{' '.join(names)}", "\n".join(constants), "\n".join(sizes),
        )  # fmt: skip
    return Group(table, _HOW_TO_HIDE)


_HOW_TO_HIDE = """\
--hide NAME=SIZE: one size for all coefficients, with signs drawn from the seed, or SIZE,SIZE,... one for each;
constants after semicolons: 'warm-up=20ug;tau=600'. Without :AXIS an effect is on every gimbal axis.
SIZE: a number in the SI unit, one with a unit (4ug/g^2), or 10sigma: 10 times what the noise of the run leaves
uncertain, after what the twelve parameters absorb.
--hide random, random-known (in the catalogue), random-unknown (not in it), also with =10sigma: drawn from the seed."""


@cli.command()
@click.argument("recording", type=click.Path(path_type=Path))
@recording_options
@filter_options
@strict_option
@json_option
@click.pass_context
def diagnose(ctx: click.Context, recording: Path, strict: bool, as_json: bool, **options: Any) -> None:
    """Which physical effect is missing in the model: verdict, suspects, what this run cannot see, where to go next."""
    from kf_calib.calibration import calibrate
    from kf_calib.diagnosis import diagnose as run
    from kf_calib.views import diagnosis as views

    source, settings = _opened(recording, options)
    with _progress(f"diagnosing {recording.name}", as_json) as tick:
        found = run(calibrate(source, settings, tick))
    if as_json:
        _print_json(views.diagnosis_object(found))
    else:
        _show(views.diagnosis_report(found))
    if strict and found.test.consistent is False:
        ctx.exit(1)


@cli.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--interactive/--unattended", default=None, help="Ask at every step, or never; on a terminal it asks.")
@click.option("--accept-first", is_flag=True, help="Of effects that explain it equally well, take the first.")
@click.option(
    "--honest",
    is_flag=True,
    help="Held-out error with the choice of effects repeated without what is held out, in 6 folds.",
)
@click.option("--save-model", "--out-model", type=click.Path(path_type=Path), help="Save the last model here.")
@click.option("--journal", "journal_file", type=click.Path(path_type=Path), help="Keep a journal of the steps here.")
@click.option("--from-journal", type=click.Path(path_type=Path), help="First take the steps of this journal again.")
@recording_options
@filter_options
@strict_option
@json_option
@click.pass_context
def improve(
    ctx: click.Context,
    recording: Path,
    interactive: bool | None,
    accept_first: bool,
    honest: bool,
    save_model: Path | None,
    journal_file: Path | None,
    from_journal: Path | None,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Add the effects that are missing, one after another, and see the error fall, until there is a reason to stop."""
    from kf_calib import improvement, journal, model_file
    from kf_calib.calibration import calibrate
    from kf_calib.views import improvement as views

    if interactive is None:
        interactive = not as_json and sys.stdin.isatty() and sys.stdout.isatty()
    if interactive and as_json:
        raise click.UsageError("--interactive asks questions, --json prints one object and nothing else: choose one.")
    earlier = journal.read(from_journal) if from_journal else None
    if earlier is not None:
        options |= _of_journal(ctx, options, earlier.origin.options)
    _refuse_engine(options)
    settings = _settings(options)
    origin = journal.Origin.of(recording, _for_journal(options, settings.effects))
    if earlier is not None:
        earlier.refuse_other(origin, from_journal)

    def keep(state: improvement.Improvement) -> None:
        if journal_file:
            journal.write(journal_file, state, origin)

    difference = None
    with _progress(f"improving on {recording.name}", as_json) as tick:
        start = calibrate(_recording(recording, options), settings, tick)
        if earlier is not None:
            state, difference = journal.replayed(earlier, start)
        elif interactive:
            state = improvement.begun(start)
        else:
            state = improvement.improve(start, accept_first, keep)
    if interactive:
        state = views.session(state, lambda text, usual: click.prompt(text, default=usual or None), _show, keep)
    with _progress("holding out orientations", as_json or not honest) as tick:
        checked = improvement.honest(start, on_fold=tick) if honest else None
    keep(state)
    if save_model:
        model_file.write(save_model, state.result)
    files = {"saved_model": save_model, "journal": journal_file}
    if as_json:
        _print_json(views.improvement_object(state, checked, difference, files))
    else:
        _show(views.improvement_report(state, checked, difference, files))
    if strict and state.found.test.consistent is False:
        ctx.exit(1)


_BY_CONTENT = ("bench_file", "model_file", *_BENCH_OPTIONS)


def _refuse_engine(options: Mapping[str, Any]) -> None:
    if options["engine"] != "block":
        raise click.UsageError(
            "improve refits from folded dwells, as the block engine does: leave out --engine, and check what it finds "
            "with replay --model FILE --engine filterpy."
        )


def _for_journal(options: Mapping[str, Any], effects: tuple[str, ...]) -> dict[str, Any]:
    """All options that numbers depend on; files of bench keys and of models by what they say."""
    from kf_calib import model_file

    files = [*options["effects_from"]]
    if options["model_file"] is not None:
        files += model_file.read(options["model_file"]).effects_from
    kept = {key: value for key, value in options.items() if value is not None and key not in _BY_CONTENT}
    plain = {"effects": list(effects), "effects_from": [str(path.resolve()) for path in files]}
    return kept | _overrides(options) | plain


def _of_journal(ctx: click.Context, options: Mapping[str, Any], kept: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a journal, as if they had been given; raises UsageError where some are given as well."""
    from click.core import ParameterSource

    own = [param for param in ctx.command.params if param.name in options]
    given = [
        param.opts[0] for param in own if ctx.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE
    ]
    if given:
        raise click.UsageError(f"--from-journal has its options from the journal: leave out {', '.join(given)}.")
    return {param.name or "": param.type_cast_value(ctx, kept[param.name]) for param in own if param.name in kept} | {
        key: None for key in _BY_CONTENT if key not in kept
    }


def simulation_options(command: F) -> F:
    """What the simulated bench is and does."""
    options = [
        click.option("--grade", type=click.Choice(["paper", "navigation", "mems"]), default="navigation",
                     show_default=True, help="Grade of the simulated sensors."),
        click.option("--plan", default="spread", show_default=True,
                     help="spread, faces, or a CSV file of gimbal angles in deg, an orientation a line."),
        click.option("--orientations", "count", type=click.IntRange(min=1), default=24, show_default=True,
                     help="Orientations of a spread plan."),
        click.option("--dwell-s", type=click.FloatRange(min=0, min_open=True), default=30.0, show_default=True,
                     help="Seconds in each orientation."),
        click.option("--sample-hz", type=click.FloatRange(min=0, min_open=True), default=100.0, show_default=True,
                     help="Rate of the readings."),
        click.option("--angle-hz", type=click.FloatRange(min=0, min_open=True), default=10.0, show_default=True,
                     help="Rate of the platform angles."),
        click.option("--slew-degps", type=click.FloatRange(min=0, min_open=True), default=20.0, show_default=True,
                     help="Greatest speed between orientations, deg/s."),
        click.option("--white", "white_mps2", type=float, help="White noise of a reading, m/s^2."),
        click.option("--ar1", "ar1_phi", type=float, help="Correlation of that noise from one reading to the next."),
        click.option("--flicker", "flicker_mps2", type=float, help="1/f noise: floor of the Allan deviation, m/s^2."),
        click.option("--walk", "walk_mps2_per_sqrt_s", type=float, help="Random walk of the biases, m/s^2/sqrt(s)."),
        click.option("--scatter", "scatter_mps2", type=float, help="Offset of each sensor in each dwell, m/s^2."),
        click.option("--setting", "setting_sigma_deg", type=float, help="Setting error of each orientation, deg."),
        click.option("--encoder-sigma", "encoder_sigma_deg", type=float, help="Noise of the encoders, deg."),
        click.option("--encoder-step", "encoder_step_deg", type=float, help="Resolution of the encoders, deg."),
        click.option("--outlier-rate", type=float, help="Share of readings that are outliers."),
        click.option("--outlier-size", "outlier_mps2", type=float, help="Size of an outlier, m/s^2."),
        click.option("--hide", "hidden", multiple=True, metavar="NAME=SIZE", is_eager=True, callback=_list_hidden,
                     help="Hide an effect in the truth, for example second-order=4ug/g^2, second-order=10sigma (10 "
                     "times what noise leaves uncertain), random or random=10sigma; repeatable; help lists them all."),
        click.option("--temperature", "constant_c", type=float, default=25.0, show_default=True,
                     help="Temperature about which it swings, degC."),
        click.option("--temperature-swing", "swing_c", type=float, default=0.0, show_default=True,
                     help="Swing of the temperature to either side, K."),
        click.option("--temperature-period-s", "period_s", type=float, default=3600.0, show_default=True,
                     help="Period of that swing, s."),
        click.option("--warm-up-c", "warm_up_c", type=float, default=0.0, show_default=True,
                     help="How much colder the start is, K."),
        click.option("--warm-up-s", "warm_up_s", type=float, default=1800.0, show_default=True,
                     help="Time constant of the warming up, s."),
        click.option("--unstated", is_flag=True, help="Do not state the setting error and scatter in the recording."),
        click.option("--seed", type=int, default=0, show_default=True, help="Seed of sensors, plan and noise."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def _simulation(options: Mapping[str, Any]) -> Simulation:
    from dataclasses import fields, replace
    from functools import partial

    from kf_calib.bench import Bench, parse_axes
    from kf_calib.sources.hidden import parse, sized
    from kf_calib.sources.physics import Ambient
    from kf_calib.sources.sensors import GRADES
    from kf_calib.sources.simulator import Simulation

    keys = {"axes": "y z x", **_overrides(options)}
    if "latitude_deg" not in keys:
        keys.setdefault("gravity_mps2", "9.81")
    grade = GRADES[options["grade"]]
    names = {field.name for field in fields(grade.noise)}
    noise = replace(grade.noise, **{key: options[key] for key in names if options.get(key) is not None})
    axes = parse_axes(keys["axes"])
    visits = _visits(options, axes)
    if not options["unstated"]:
        keys.setdefault("angle_sigma_deg", repr(noise.setting_sigma_deg))
        keys.setdefault("scatter_sigma_mps2", repr(noise.dwell_sigma_mps2(len(visits))))
    ambient = Ambient(**{field.name: options[field.name] for field in fields(Ambient) if field.name in options})
    run = Simulation(
        Bench.from_metadata(keys), grade.sensors(options["seed"]), noise, visits,
        sample_hz=options["sample_hz"], angle_hz=options["angle_hz"], slew_rate_degps=options["slew_degps"],
        ambient=ambient, seed=options["seed"], grade=options["grade"],
    )  # fmt: skip
    return run.hiding(
        parse(options["hidden"], axes, seed=options["seed"], grade=options["grade"], sized=partial(sized, run))
    )


def _visits(options: Mapping[str, Any], axes: tuple[Vector, ...]) -> list[Visit]:
    from kf_calib.sources.plans import explicit_plan, six_faces, spread_plan

    if options["plan"] == "spread":
        return spread_plan(options["count"], axes, options["dwell_s"], options["seed"])
    if options["plan"] == "faces":
        return six_faces(axes, options["dwell_s"])
    return explicit_plan(_angles_from_csv(Path(options["plan"]), len(axes)), options["dwell_s"])


def _angles_from_csv(path: Path, width: int) -> list[list[float]]:
    """Rows of gimbal angles, deg; a first line of names is passed over."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the plan cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    rows = list[list[float]]()
    for number, line in enumerate(lines, start=1):
        cells = line.split("#")[0].replace(",", " ").split()
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            if rows or number > 1:
                raise InputError(f"{path}, line {number}: {line!r} is not {width} angles in deg.") from None
            continue
        if row and len(row) != width:
            raise InputError(f"{path}, line {number}: {len(row)} angles for {width} gimbal axes.")
        rows += [row] if row else []
    if not rows:
        raise InputError(f"{path}: holds no orientation; write a line of {width} angles in deg for each.")
    return rows


def _record(source: Source, out: Path, overwrite: bool, tick: Callable[[float], None]) -> tuple[int, int, float]:
    """Write a source to a recording, a chunk closed at the end of each dwell; readings, dwells, seconds."""
    from kf_calib.dwells import Segmenter
    from kf_calib.sources.recorder import Recorder

    readings, first_ns, last_ns, segmenter = 0, None, 0, Segmenter(source.bench)
    with Recorder(out, source.bench, overwrite=overwrite) as recorder:
        for batch in source:
            recorder.write(batch)
            before = segmenter.dwell_count
            for _ in segmenter.push(batch):
                pass
            if segmenter.dwell_count > before > 0:
                recorder.end_dwell()
            readings += len(batch.accel)
            if len(batch.accel):
                first_ns = int(batch.accel.time_ns[0]) if first_ns is None else first_ns
                last_ns = int(batch.accel.time_ns[-1])
            tick(source.fraction)
        for _ in segmenter.finish():
            pass
    return readings, segmenter.dwell_count, (last_ns - (first_ns or last_ns)) / 1e9


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")


@cli.command()
@click.argument("out", type=click.Path(path_type=Path))
@simulation_options
@bench_options
@overwrite_option
@json_option
def simulate(out: Path, overwrite: bool, as_json: bool, **options: Any) -> None:
    """Record a simulated bench run to OUT; its truth goes to a side file that no estimator opens."""
    source = _simulation(options)
    with _progress(f"simulating {out.name}", as_json) as tick:
        readings, dwells, duration_s = _record(source, out, overwrite, tick)
    truth = source.write_truth(out)
    content = {
        "recording": str(out),
        "truth": str(truth),
        "samples": readings,
        "dwells": dwells,
        "duration_s": duration_s,
    }
    if as_json:
        _print_json(content)
    else:
        click.echo(f"{out}: {readings} readings, {dwells} dwells, {duration_s:.0f} s; truth in {truth}")


@cli.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("lines", type=click.Path(path_type=Path, allow_dash=True), default="-")
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="THEIRS=OURS",
    help='Name of a foreign column, for example --column "acc x [g]=ax_g"; repeatable.',
)
@bench_options
@overwrite_option
@json_option
def record(
    out: Path, lines: Path, columns: tuple[str, ...], overwrite: bool, as_json: bool, **options: Any
) -> None:  # fmt: skip
    """Record CSV or JSON LINES (a file, or - for standard input) to the MCAP file OUT."""
    from kf_calib.sources.lines import Lines

    renamed = dict(_pair(text) for text in columns)
    source = Lines(sys.stdin.buffer if str(lines) == "-" else lines, _overrides(options), renamed)
    with _progress(f"recording {out.name}", as_json or str(lines) == "-") as tick:
        readings, dwells, duration_s = _record(source, out, overwrite, tick)
    content = {
        "recording": str(out), "samples": readings, "dwells": dwells, "duration_s": duration_s,
        "warnings": source.warnings,
    }  # fmt: skip
    if as_json:
        _print_json(content)
        return
    click.echo(f"{out}: {readings} readings, {dwells} dwells, {duration_s:.0f} s")
    for warning in source.warnings:
        click.echo(f"Note: {warning}")


def _pair(text: str) -> tuple[str, str]:
    theirs, equals, ours = text.rpartition("=")
    if not (equals and theirs and ours):
        raise InputError(f"--column {text!r} names no pair: write --column THEIRS=OURS, for example acc_x=ax_g.")
    return theirs, ours


@cli.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default="out")
@json_option
def demo(folder: Path, as_json: bool) -> None:
    """The main job on a simulated run: record, replay, compare with least squares, save the view; files in FOLDER."""
    from kf_calib.comparison import compare as run
    from kf_calib.sources.recording import Recording

    folder.mkdir(parents=True, exist_ok=True)
    recording, rrd = folder / "demo.mcap", folder / "demo.rrd"
    options = simulate.make_context("simulate", [str(recording)]).params
    source = _simulation(options | {"dwell_s": 15.0, "slew_degps": 90.0, "seed": 2019})
    with _progress("recording a simulated run", as_json) as tick:
        readings, dwells, duration_s = _record(source, recording, True, tick)
        truth = source.write_truth(recording)
    with _progress("replaying and comparing", as_json):
        compared = run(Recording(recording))
        _save_views(compared.result, rrd, None)
    if as_json:
        from kf_calib.views.json import compare_object, replay_object

        files = {"recording": str(recording), "truth": str(truth), "view": str(rrd)}
        _print_json({**files, "replay": replay_object(compared.result), "compare": compare_object(compared)})
        return
    from kf_calib.views.console import comparison_table, summary

    click.echo(
        f"Recorded a simulated bench run to {recording}: {readings} readings, {dwells} dwells, {duration_s:.0f} s.\n"
    )
    _show(summary(compared.result))
    click.echo()
    _show(comparison_table(compared))
    click.echo(f"\nTruth: {truth}. View: {rrd} (open it with .venv/bin/rerun {rrd}).")


def main() -> None:
    """Entry point of ``kf-calib``."""
    try:
        code = cli.main(standalone_mode=False)
    except click.exceptions.Abort:
        sys.exit(130)
    except KeyboardInterrupt:
        sys.exit(130)
    except click.ClickException as error:
        ctx = getattr(error, "ctx", None)
        hint = f" (see {ctx.command_path} --help)" if ctx is not None else ""
        click.echo(f"kf-calib: {error.format_message().rstrip()}{hint}", err=True)
        sys.exit(2)
    except KfCalibError as error:
        click.echo(f"kf-calib: {error}", err=True)
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(0)
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
