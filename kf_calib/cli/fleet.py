"""The command that evaluates many recordings: fleet."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.echo import complain
from kf_calib.cli.failures import sentence
from kf_calib.cli.options import (
    OUTPUT,
    examples,
    filter_options,
    json_option,
    opened,
    overrides,
    print_json,
    progress,
    recording_options,
    settings_of,
    show,
    units_option,
)
from kf_calib.cli.signals import Interrupter, answered
from kf_calib.support import stage
from kf_calib.support.extras import need

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.estimation.results import Calibration
    from kf_calib.fleet.batch import Progress
    from kf_calib.fleet.run_list import Run

WORK = "Who does the work"
_PACKAGES = ("distributed", "pyarrow", "fsspec")


@dataclass(frozen=True)
class SingleCommands:
    """What ``replay`` and ``diagnose`` do with one recording and these options; sent to the workers."""

    options: Mapping[str, Any]

    def replay(self, path: Path) -> tuple[Source, Calibration]:
        from kf_calib.estimation.calibration import calibrate

        source, settings = opened(path, self.options)
        return source, calibrate(source, settings)

    def diagnose(self, source: Source, result: Calibration) -> Diagnosis:
        from kf_calib.diagnosis.missing_effect import diagnose
        from kf_calib.diagnosis.refits import Refits

        return diagnose(result, Refits(source))

    def replay_document(self, result: Calibration) -> dict[str, Any]:
        from kf_calib.views.json import replay_object

        return replay_object(result)

    def diagnosis_document(self, found: Diagnosis) -> dict[str, Any]:
        from kf_calib.views.diagnosis import diagnosis_object

        return diagnosis_object(found)

    def sentence(self, error: BaseException) -> str:
        return sentence(error)

    @property
    def checksum(self) -> str:
        """Of all that numbers depend on besides the recording: options, the files they name, and the program."""
        told = {key: _content(value) for key, value in sorted(self.options.items())}
        text = json.dumps(told | {"kf_calib": version("kf_calib")})
        return hashlib.sha256(text.encode()).hexdigest()


def _content(value: Any) -> Any:
    """An option as it counts: a file by what is in it."""
    if isinstance(value, Path):
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return [_content(each) for each in value] if isinstance(value, tuple | list) else value


@click.command(
    epilog=examples("fleet campaign/ -o fleet", "fleet 's3://lab/2026/*.mcap' -o fleet --scheduler tcp://host:8786")
)
@click.argument("runs", nargs=-1, required=True)
@click.option("-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path), metavar="FOLDER",
              panel=OUTPUT, help="The table of runs; runs that are in it already are not evaluated again.")  # fmt: skip
@click.option("--workers", type=click.IntRange(min=1), show_default="one a core", panel=WORK,
              help="Number of processes on this machine.")  # fmt: skip
@click.option("--scheduler", metavar="URL", panel=WORK,
              help="A scheduler of Dask whose workers do it, for example tcp://host:8786.")  # fmt: skip
@recording_options
@filter_options
@units_option
@json_option
def fleet(
    runs: tuple[str, ...], out: Path, workers: int | None, scheduler: str | None, as_json: bool, **options: Any
) -> None:
    """Replay and diagnose many recordings, each by itself, on many processes; one table of all.

    RUNS are recordings, folders of them, globs, or lists (.txt with one of these a line, .csv with the columns run,
    unit, bench, date), here or at URLs such as s3://. A run that fails is a row that says why. The table is Parquet:
    docs/fleet.md has its columns.
    """  # fmt: skip
    for package in _PACKAGES:
        need(package, "fleet", "kf-calib fleet")
    if workers is not None and scheduler is not None:
        raise click.UsageError(
            "--workers are processes of this machine, --scheduler has workers of its own: choose one."
        )
    from kf_calib.fleet.results import Fleet, populations
    from kf_calib.fleet.run_list import runs_of
    from kf_calib.views import fleet as views

    commands = _checked(options)
    done = _evaluated(commands, runs_of(runs), out, workers, scheduler, as_json)
    found = Fleet(out)
    if as_json:
        print_json(views.fleet_object(found, populations(found), done))
    else:
        show(views.fleet_report(found, populations(found), done))


def _checked(options: Mapping[str, Any]) -> SingleCommands:
    """The commands; options that would fail in every run are refused at once."""
    settings_of(options)
    overrides(options)
    return SingleCommands(options)


def _evaluated(
    commands: SingleCommands, runs: Sequence[Run], out: Path, workers: int | None, scheduler: str | None, quiet: bool
) -> Progress:
    """Evaluate the runs that are not in the table yet; where it is stopped, all that is done is kept."""
    import dask.system

    from kf_calib.fleet.batch import evaluate_all
    from kf_calib.fleet.cluster import cluster
    from kf_calib.fleet.evaluation import Evaluation
    from kf_calib.fleet.store import Store

    store, interrupt = Store(out), Interrupter()
    with store.taken(), answered(interrupt), progress(f"{len(runs)} runs", quiet) as tick:

        def tell(now: Progress) -> None:
            with interrupt.finished_first():  # where it takes effect, too, if it came while Python was cleaning up
                stage.say(f"{now.done} done, {now.failed} failed")
                tick(now.done / now.total)

        try:
            with cluster(workers or dask.system.CPU_COUNT, scheduler) as client:
                return evaluate_all(client, Evaluation(commands, commands.checksum), runs, store, tell)
        except KeyboardInterrupt:
            complain(f"stopped: {out} has {len(store.known())} runs so far, and the same command goes on from there.")
            raise
