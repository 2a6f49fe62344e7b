"""The command that evaluates many recordings: fleet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none

from kf_calib.cli.command import MODEL, OUTPUT, POSITIVE, argument, command, option
from kf_calib.cli.echo import complain, echo, print_json, progress, show
from kf_calib.cli.failures import Interrupter, answered
from kf_calib.cli.files import Delivery, FigureFiles, ReportFile, claimed, commands_of, delivery
from kf_calib.cli.options import EvaluationOptions, Json, Overwrite, ReadingOptions, ShownUnits, target_option
from kf_calib.errors import InputError, need
from kf_calib.support import stage
from kf_calib.support.leaves import leaf

if TYPE_CHECKING:
    from kf_calib.fleet.batch import BatchProgress, RunEvaluation
    from kf_calib.fleet.results import BenchModelFiles
    from kf_calib.fleet.run_factor import ReferenceUnit
    from kf_calib.fleet.run_list import ListedRun
    from kf_calib.support.output_files import Outputs

WORK = "Who does the work"
_PACKAGES = ("distributed", "pyarrow", "fsspec")


@dataclass(frozen=True)
class FleetOptions:
    """Who does the work, and what is made of all runs together."""

    # fmt: off
    workers: Annotated[int | None, option(
        "--workers", type=click.IntRange(min=1), show_default="one a core", panel=WORK,
        help="Number of processes on this machine.")] = None
    scheduler: Annotated[str | None, option(
        "--scheduler", metavar="URL", panel=WORK,
        help="A scheduler of Dask whose workers do it, for example tcp://host:8786.")] = None
    limit_s: Annotated[float, option(
        "--limit-s", type=POSITIVE, metavar="S", panel=WORK,
        help="Seconds that one run may take; if it takes longer, its row says so.")] = 3600.0
    pooled: Annotated[bool, option(
        "--pooled/--no-pooled", panel=MODEL,
        help="Whether two runs or more are diagnosed together: errors of the bench, of sensors.")] = True
    reference_unit: Annotated[Path | None, option(
        "--reference-unit", metavar="CAL.json", panel=MODEL,
        help="A calibration from elsewhere of a unit among the runs: against its scale factors, an error of the "
        "gravity of the bench shows.")] = None
    targets: Annotated[tuple[str, ...], target_option(panel=OUTPUT)] = ()
    # fmt: on

    def refuse_contradictions(self) -> None:
        """Raise UsageError for options that exclude one another."""
        if self.workers is not None and self.scheduler is not None:
            raise click.UsageError(
                "--workers are processes of this machine, --scheduler has workers of its own: choose one."
            )
        if self.reference_unit is not None and not self.pooled:
            raise click.UsageError("--reference-unit is for the diagnosis of all runs together: leave out --no-pooled.")


@command(
    "fleet campaign/ -o fleet", "fleet s3://lab/2026/ -o fleet --scheduler tcp://host:8786",
    seldom=("reference_unit", "model_file", "left_out", "accel_unit", "angle_unit", "columns"),
)  # fmt: skip
def fleet(
    runs: Annotated[tuple[str, ...], argument(required=True)],
    output: Annotated[Path, option(
        "-o", "--out", required=True, type=click.Path(file_okay=False, path_type=Path), metavar="FOLDER", panel=OUTPUT,
        help="The table of runs; runs that are in it already are not evaluated again.",
    )],
    options: FleetOptions, report: ReportFile, figures: FigureFiles, overwrite: Overwrite, reading: ReadingOptions,
    evaluation: EvaluationOptions, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Replay and diagnose many recordings, each by itself, on many processes, and then all of them together.

    RUNS are recordings, folders of them, globs, or lists (.txt with one of these a line, .csv with the columns run,
    unit, bench, date), here or at URLs such as s3://. A run that fails is a row that says why. The table is Parquet:
    docs/fleet.md has its columns. Errors of a bench that all runs on it show become a bench model, in the folder of the
    table.
    """
    for package in _PACKAGES:
        need(package, "fleet", "kf-calib fleet")
    options.refuse_contradictions()
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.fleet import text as views
    from kf_calib.fleet.batch import RunEvaluation
    from kf_calib.fleet.results import BenchModelFiles, Fleet
    from kf_calib.fleet.run_list import runs_of

    outputs = claimed(overwrite=overwrite)
    if report:  # what is not installed is told before the work
        leaf("report.command", "--report").need_page()
    if figures != FigureFiles():
        import kf_calib.views.figures  # noqa: F401
    wanted, reference = targets_of(options.targets), _reference(options.reference_unit)
    one_run = RunEvaluation.of(reading, evaluation, options.limit_s)
    done = _evaluated(one_run, runs_of(runs), output, options.workers, options.scheduler, as_json)
    table = Fleet(output)
    with progress("diagnosing the runs together", as_json):
        overview = table.overview(wanted, pooled=options.pooled, reference_unit=reference)
    models = BenchModelFiles(output, overview.pooled, overwrite)
    if as_json:
        print_json(views.fleet_object(table, done, overview, list(models.models)))
    else:
        show(views.fleet_report(table, done, overview))
    with delivery(outputs, as_json) as deliver, progress("drawing the pictures", as_json):
        _deliver_bench_models(models, outputs, deliver, as_json)
        if report:
            from kf_calib.fleet.page import save_page

            deliver.file(report, partial(save_page, overview, commands_of(get_current_context())))
        figures.save(deliver, overview)


def _reference(path: Path | None) -> ReferenceUnit | None:
    """The unit of a calibration, whose scale factors are taken for known."""
    if path is None:
        return None
    from kf_calib.exchange import calibration_file
    from kf_calib.fleet.run_factor import ReferenceUnit

    saved = calibration_file.open_calibration(path)
    unit = saved.provenance.bench.get("block_serial")
    if not unit:
        raise InputError(f"{path} does not say of which unit it is: name one made from a run with a block_serial.")
    own = [each for each in saved.parameters if each.symbol in ("K1", "K2", "K3")]
    scale, sigma = ([getattr(each, part) for each in own] for part in ("value", "sigma"))
    if None in (*scale, *sigma):
        raise InputError(f"{path} does not determine all three scale factors: name one that does.")
    known = (scale[0], scale[1], scale[2]), (sigma[0], sigma[1], sigma[2])
    return ReferenceUnit(unit, *known, saved.provenance.sha256)


def _deliver_bench_models(files: BenchModelFiles, outputs: Outputs, deliver: Delivery, quiet: bool) -> None:
    """Write the bench model of each bench that has errors; those of before that no longer hold are removed."""
    words = {path: f"saved {path}: for --bench-model" for path in files.models}
    words |= {path: f"removed {path}, which no longer holds" for path in files.outdated}
    for path, said in words.items():
        outputs.allow_replacing(path)  # which files may be replaced is seen by what is in them
        done = deliver.keep(path, files.write if path in files.models else Path.unlink)
        if done and not quiet:
            echo(said)


def _evaluated(
    evaluation: RunEvaluation, runs: Sequence[ListedRun], folder: Path, workers: int | None, scheduler: str | None,
    quiet: bool,
) -> BatchProgress:  # fmt: skip
    """Evaluate the runs that are not in the table yet; where it is stopped, all that is done is kept."""
    import dask.system

    from kf_calib.fleet.batch import cluster, evaluate_all
    from kf_calib.fleet.store import Store

    store, interrupt = Store(folder), Interrupter()
    with store.taken(), answered(interrupt), progress(f"{len(runs)} runs", quiet) as tick:

        def tell(now: BatchProgress) -> None:
            with interrupt.finished_first():  # where it takes effect, too, if it came while Python was cleaning up
                stage.say(f"{now.done} done, {now.failed} failed")
                tick(now.done / now.total)

        try:
            with cluster(workers or dask.system.CPU_COUNT, scheduler) as client:
                return evaluate_all(client, evaluation, runs, store, tell)
        except KeyboardInterrupt:
            complain(
                f"stopped: {folder} has {len(store.known())} runs so far, and the same command goes on from there."
            )
            raise
