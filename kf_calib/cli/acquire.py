"""Commands that make a recording: simulate, record, demo."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none

from kf_calib.bench.keys import BenchKeys
from kf_calib.cli.command import OUTPUT, POSITIVE, argument, command, option
from kf_calib.cli.echo import complain, echo, print_json, progress, show
from kf_calib.cli.failures import Interrupter, answered
from kf_calib.cli.files import OutputFile, claimed, delivery, write_view
from kf_calib.cli.options import BenchOptions, Device, ForeignColumns, Json, NoAngles, Overwrite, ShownUnits, renamed
from kf_calib.errors import InputError
from kf_calib.sources.simulation.settings import Ambient, SimulationOptions
from kf_calib.support.output_files import Outputs, write_whole
from kf_calib.support.text import counted, sentence

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

    from rich.console import RenderableType

    from kf_calib.bench.streams import Source
    from kf_calib.sources.simulation.simulator import Simulation


Output = Annotated[Path, argument(type=OutputFile(), metavar="OUT")]
_PERIOD_S = 3600.0  # of the temperature
_LARGE_BYTES = 1e9  # of a recording: minutes of work
_HOW_TO_HIDE = """\
--hide NAME=SIZE: one size for all coefficients, with signs drawn from the seed, or SIZE,SIZE,... one for each;
constants after semicolons: 'warm-up=20ug;tau=600'. Without :AXIS an effect is on every gimbal axis.
SIZE: a number in the SI unit, one with a unit (4ug/g^2), or 10sigma: 10 times what the noise of the run leaves
uncertain, after what the twelve parameters absorb.
--hide random, random-known (in the catalogue), random-unknown (not in it), also with =10sigma: drawn from the seed."""


def _hidden_table() -> RenderableType:
    """Every kind of hidden effect, in two lines or more."""
    from rich.console import Group

    from kf_calib.sources.simulation.injected import INNER_CONSTANTS, catalogue
    from kf_calib.views.terminal import LINED, table

    kinds = catalogue().values()
    rows = list[tuple[str, ...]]()
    for kind in kinds:
        names = kind.coefficients if len(kind.coefficients) < 7 else (*kind.coefficients[:2], "...")
        constants = [f"{name}={value:.4g} {INNER_CONSTANTS[name].unit}" for name, value in kind.inner.items()]
        sizes = [" to ".join(dict.fromkeys(sizes)) for sizes in (kind.navigation, kind.mems)]
        rows.append(
            (f"{kind.name}{':AXIS' * kind.per_axis}\n{kind.title}", "yes" if kind.known else "no",
             f"{kind.unit}\n{' '.join(names)}", "\n".join(constants), "\n".join(sizes))
        )  # fmt: skip
    whole = "in the\ncatalogue", "SI unit\ncoefficients", "constants", "navigation grade\nMEMS"
    hidden = table(f"{len(kinds)} effects to hide", ("effect\nwhat it is", *whole), rows, whole=whole, **LINED)
    return Group(hidden, _HOW_TO_HIDE)


def _list_hidden(ctx: click.Context, _: click.Parameter, texts: tuple[str, ...]) -> tuple[str, ...]:
    """``--hide help`` prints what can be hidden, and ends."""
    if "help" in texts:
        show(_hidden_table())
        ctx.exit()
    return texts


_of_run, _of_hidden, _of_noise, _of_warmth = (
    partial(option, panel=panel) for panel in ("Run", "Hidden effects", "Noise", "Temperature")
)


_OF_SIMULATION = {
    "grade": _of_run("--grade", help="Grade of the simulated sensors."),
    "plan": _of_run("--plan", help="spread, faces, or a CSV file of gimbal angles in deg, an orientation a line."),
    "count": _of_run("--orientations", type=click.IntRange(min=1), metavar="N", help="Orientations of a spread plan."),
    "dwell_s": _of_run("--dwell-s", type=POSITIVE, help="Seconds in each orientation."),
    "sample_hz": _of_run("--sample-hz", type=POSITIVE, help="Rate of the readings."),
    "angle_hz": _of_run("--angle-hz", type=POSITIVE, help="Rate of the platform angles."),
    "slew_degps": _of_run("--slew-degps", type=POSITIVE, help="Greatest speed between orientations, deg/s."),
    "seed": _of_run("--seed", metavar="N", help="Seed of sensors, plan and noise."),
    "unstated": _of_run("--unstated", help="Do not state the setting error and scatter in the recording."),
    "hidden": _of_hidden("--hide", metavar="NAME=SIZE", is_eager=True, callback=_list_hidden,
                         help="Hide an effect in the truth, for example second-order=4ug/g^2, second-order=10sigma (10 "
                         "times what noise leaves uncertain), random or random=10sigma; repeatable; help lists them "
                         "all."),
    "white_mps2": _of_noise("--white", help="White noise of a reading, m/s^2."),
    "ar1_phi": _of_noise("--ar1", help="Correlation of that noise from one reading to the next."),
    "flicker_mps2": _of_noise("--flicker", help="1/f noise: floor of the Allan deviation, m/s^2."),
    "walk_mps2_per_sqrt_s": _of_noise("--walk", help="Random walk of the biases, m/s^2/sqrt(s)."),
    "scatter_mps2": _of_noise("--scatter", help="Offset of each sensor in each dwell, m/s^2."),
    "setting_sigma_deg": _of_noise("--setting", help="Setting error of each orientation, deg."),
    "encoder_sigma_deg": _of_noise("--encoder-sigma", help="Noise of the encoders, deg."),
    "encoder_step_deg": _of_noise("--encoder-step", help="Resolution of the encoders, deg."),
    "outlier_rate": _of_noise("--outlier-rate", help="Share of readings that are outliers."),
    "outlier_mps2": _of_noise("--outlier-size", help="Size of an outlier, m/s^2."),
    "constant_c": _of_warmth("--temperature", help="Temperature about which it swings, degC."),
    "swing_c": _of_warmth("--temperature-swing", help="Swing of the temperature to either side, K."),
    "period_s": _of_warmth("--temperature-period-s", default=_PERIOD_S, help="Period of that swing, s."),
    "warm_up_c": _of_warmth("--warm-up-c", help="How much colder the start is, K."),
    "warm_up_s": _of_warmth("--warm-up-s", help="Time constant of the warming up, s."),
    "sigma_c": _of_warmth("--thermometer-sigma", help="Noise of the thermometer, K."),
    "step_c": _of_warmth("--thermometer-step", help="Resolution of the thermometer, K."),
}  # fmt: skip
"""What the simulated bench is and does."""


class _Recorded(NamedTuple):
    """notes: what an evaluation will not use of it."""

    readings: int
    dwells: int
    duration_s: float
    notes: list[str]

    def __str__(self) -> str:
        return f"{self.readings} readings, {counted(self.dwells, 'dwell')}, {self.duration_s:.0f} s"

    @property
    def keys(self) -> dict[str, Any]:
        return {"samples": self.readings, "dwells": self.dwells, "duration_s": self.duration_s}


def _record(source: Source, path: Path, overwrite: bool, tick: Callable[[float], None]) -> _Recorded:
    """Write a source to a recording as it is, a chunk closed at the end of each dwell."""
    from kf_calib.dwells.rest_in_readings import segmenter_of
    from kf_calib.sources.files.recorder import Recorder

    readings, first_ns, last_ns, segmenter = 0, None, 0, segmenter_of(source.bench)
    interrupt = Interrupter()
    with answered(interrupt), Recorder(path, source.bench, overwrite=overwrite) as recorder:
        for batch in source:
            with interrupt.finished_first():
                recorder.write(batch)
            before = segmenter.dwell_count
            for _ in segmenter.push(batch):
                pass
            if segmenter.dwell_count > before > 0:
                with interrupt.finished_first():
                    recorder.end_dwell()
            readings += len(batch.accel)
            if len(batch.accel):
                first_ns = int(batch.accel.time_ns[0]) if first_ns is None else first_ns
                last_ns = int(batch.accel.time_ns[-1])
            tick(source.fraction)
        for _ in segmenter.finish():
            pass
    duration_s = 0.0 if first_ns is None else (last_ns - first_ns) / 1e9
    notes = [f"recorded, and not used when it is evaluated: {text}" for text in segmenter.counts.sentences()]
    return _Recorded(readings, segmenter.dwell_count, duration_s, notes)


@command(
    "simulate run.mcap", "simulate run.mcap --seed 3 --hide second-order=10sigma --temperature-swing 5",
    seldom=("angle_hz", "outlier_rate", "outlier_mps2", "encoder_sigma_deg", "encoder_step_deg", "flicker_mps2",
            "period_s", "warm_up_c", "warm_up_s", "sigma_c", "step_c", "large"),
)  # fmt: skip
def simulate(
    output: Output, options: Annotated[SimulationOptions, _OF_SIMULATION],
    no_angles: Annotated[bool, option(
        "--no-angles", panel="Run", help="Record no angles, as of a board that is turned by hand.")],
    bench: BenchOptions, overwrite: Overwrite,
    large: Annotated[bool, option(
        "--large", panel=OUTPUT, help="Begin even where the disk would not hold the recording.")],
    as_json: Json,
) -> None:  # fmt: skip
    """Record a simulated bench run to OUT; its truth goes to a side file that no estimator opens."""
    from kf_calib.sources.simulation.detectability import truth_file, write_truth
    from kf_calib.sources.simulation.options import simulation

    claimed([Path(options.plan)], {"OUT, whose truth goes there": truth_file(output)}, overwrite)
    foresee = partial(_foresee, path=output, large=large)
    source = simulation(options, bench.keys, angles=not no_angles, begin=foresee)
    with progress(f"simulating {output.name}", as_json) as tick:
        recorded = _record(source.by_hand() if no_angles else source, output, overwrite, tick)
    truth = write_truth(source, output, not no_angles)
    if as_json:
        print_json({"recording": output, "truth": truth, **recorded.keys})
    else:
        echo(f"{output}: {recorded}; truth in {truth}")


def _foresee(run: Simulation, path: Path, large: bool) -> None:
    """Say how large a large run becomes, before it begins; refuse what the disk does not hold."""
    free = shutil.disk_usage(next(folder for folder in path.absolute().parents if folder.is_dir())).free
    size = f"{len(run):.3g} readings, {run.duration_s / 3600:.3g} h of the bench, about {_size(run.file_bytes)}"
    if run.file_bytes > free and not large:
        raise InputError(
            f"{path}: {size}, and the disk has {_size(free)} left: dwell shorter (--dwell-s), visit or read less "
            "(--orientations, --sample-hz), or begin nevertheless with --large."
        )
    if run.file_bytes > _LARGE_BYTES:
        complain(f"{path}: {size}.")


def _size(count: int) -> str:
    return f"{count / 1e9:.3g} GB" if count < 1e12 else f"{count / 1e12:.3g} TB"


@command(
    'record run.mcap bench.csv --axes "y z x" --gravity 9.8123',
    'record run.mcap - --bench bench.toml --column "acc x [g]=ax_g" < bench.csv',
    "record run.mcap counts.csv --bench bench.toml --accel-scale 3.9e-6 --accel-unit g --channels 1,-2,3",
)
def record(
    output: Output, lines: Annotated[Path, argument(type=click.Path(path_type=Path, allow_dash=True), default="-")],
    no_angles: NoAngles, columns: ForeignColumns, device: Device, bench: BenchOptions, overwrite: Overwrite,
    as_json: Json,
) -> None:  # fmt: skip
    """Record CSV or JSON LINES (a file, or - for standard input) to the MCAP file OUT."""
    from kf_calib.sources.text.lines import Lines

    if lines.suffix == ".mcap" and output.suffix != ".mcap":
        raise InputError(f"the recording goes before the lines: kf-calib record {lines} {output}.")
    claimed(overwrite=overwrite)
    keys: BenchKeys = {**bench.keys, **device}
    source = Lines(sys.stdin.buffer if str(lines) == "-" else lines, keys, renamed(columns), angles=not no_angles)
    with progress(f"recording {output.name}", as_json or str(lines) == "-") as tick, _told_if_table(lines):
        recorded = _record(source, output, overwrite, tick)
    warnings = [*source.warnings, *recorded.notes]
    if as_json:
        print_json({"recording": output, **recorded.keys, "warnings": warnings})
        return
    echo(f"{output}: {recorded}")
    for warning in warnings:
        echo(f"Note: {sentence(warning)}")


@contextmanager
def _told_if_table(path: Path) -> Iterator[None]:
    """Where lines cannot be recorded because they are a table of orientations, say so."""
    from kf_calib.sources.file_kind import FileKind
    from kf_calib.sources.opening import kind_of
    from kf_calib.sources.text.means import Survey

    try:
        yield
    except InputError:
        table = None
        with suppress(InputError):
            table = Survey(path) if kind_of(path) is FileKind.TABLE else None
        if table is not None and table.described_rows:
            raise InputError(
                f"{path} is a table of orientations, with a row a dwell, and is evaluated as it is: kf-calib replay "
                f"{path}."
            ) from None
        raise


def _folder() -> str:
    return "recordings" if get_current_context().params["tutorial"] else "out"


@command("demo", "demo somewhere", "demo --tutorial")
def demo(
    folder: Annotated[Path, argument(type=click.Path(path_type=Path, file_okay=False), default=_folder)],
    tutorial: Annotated[bool, option(
        "--tutorial", is_eager=True, help="Instead, copy the recordings of the tutorial to FOLDER.")],
    units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """The main job on a simulated run: record, replay, compare with least squares, save the view; files in FOLDER.

    FOLDER is "out" where you name none, with --tutorial "recordings". Files of an earlier demo there are replaced.
    """
    if tutorial:
        _copy_recordings(folder, as_json)
    else:
        _do_main_job(folder, as_json)


def _copy_recordings(folder: Path, as_json: bool) -> None:
    """The recordings that come with the package, and their truths; those that are in the folder already stay."""
    from importlib.resources import files

    contents = {folder / name: file.read_bytes() for name, file in _files_in(files("kf_calib").joinpath("recordings"))}
    for path, content in contents.items():
        if path.exists() and path.read_bytes() != content:
            raise InputError(f"{path} is there, and is not the tutorial's: move it away, or name another FOLDER.")
    for path, content in contents.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            write_whole(path, content)
    recordings = [str(path) for path in contents if path.suffix == ".mcap"]
    if as_json:
        print_json({"recordings": recordings})
    else:
        echo(f"{', '.join(recordings)}: there, each with its truth beside it.")
        echo(f"Begin with: kf-calib replay {folder / 'hidden.mcap'}")


def _files_in(folder: Traversable) -> Iterator[tuple[str, Traversable]]:
    """Files of a folder but for its description, and those of bags in it, with their paths."""
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.is_dir():
            yield from ((f"{file.name}/{name}", each) for name, each in _files_in(file))
        elif not file.name.endswith(".md"):
            yield file.name, file


def _do_main_job(folder: Path, as_json: bool) -> None:
    from rich.console import Group

    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.engine_comparison import compare as run
    from kf_calib.sources.files.recording import Recording
    from kf_calib.sources.simulation.detectability import truth_file, write_truth
    from kf_calib.sources.simulation.options import simulation
    from kf_calib.views.console import comparison_table, summary
    from kf_calib.views.json import compare_object, replay_object

    def say(shown: Any) -> None:
        if not as_json:
            show(shown)

    folder.mkdir(parents=True, exist_ok=True)
    recording, rrd = folder / "demo.mcap", folder / "demo.rrd"
    outputs = Outputs({"FOLDER": recording, "the truth": truth_file(recording), "the view": rrd}, overwrite=True)
    source = simulation(
        SimulationOptions(dwell_s=15.0, slew_degps=90.0, seed=2019, ambient=Ambient(period_s=_PERIOD_S)), {}
    )
    with progress("recording a simulated run", as_json) as tick:
        made = _record(source, recording, True, tick)
        truth = write_truth(source, recording)
    say(f"Recorded a simulated bench run to {recording}: {made}.\n")
    with progress("replaying", as_json) as tick:
        result = calibrate(Recording(recording), on_progress=tick)
    say(summary(result))
    with progress("comparing", as_json) as tick:
        compared = run(Recording(recording), on_progress=tick)
    say(Group("", comparison_table(compared)))
    say(f"\nTruth: {truth}.")
    if as_json:
        print_json({"recording": recording, "truth": truth, "view": rrd, "replay": replay_object(result),
                    "compare": compare_object(compared)})  # fmt: skip
    with delivery(outputs, as_json) as deliver, progress("saving the view", as_json):
        kept = deliver.keep(rrd, lambda path: write_view(result, path))
    if kept:
        say(f"View: {rrd} (open it with {_viewer()} {rrd}).")


def _viewer() -> str:
    """The Rerun viewer that came with this program, as one types it in this folder."""
    programs, folder = Path(sys.executable).parent, Path.cwd()
    if viewer := shutil.which("rerun", path=str(programs)):
        if programs.is_relative_to(folder):
            return str(Path(viewer).relative_to(folder))
        if shutil.which("rerun") != viewer:
            return viewer
    return "rerun"
