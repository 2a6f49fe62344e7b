"""The command ``replay``, in a file of its own: it starts without the options of others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from kf_calib.cli.command import argument, command
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import Pictures, claimed, delivery
from kf_calib.cli.options import (
    BenchModelFile,
    EvaluationOptions,
    Json,
    Overwrite,
    ReadingOptions,
    Save,
    SaveModel,
    ShownUnits,
    Strict,
    exit_if,
    opened,
)


@command("replay run.mcap", 'replay bag.mcap --axes "y z x" --gravity 9.8123 --with second-order --rrd run.rrd')
def replay(
    recording: Annotated[Path, argument()], reading: ReadingOptions, evaluation: EvaluationOptions,
    bench_model: BenchModelFile, pictures: Pictures, save: Save, save_model: SaveModel, overwrite: Overwrite,
    strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Run a recording through the filter: twelve parameters, their sigma, and whether the model fits."""
    from kf_calib.estimation.calibration import calibrate

    outputs = claimed(overwrite=overwrite)
    source, settings = opened(recording, reading, evaluation, bench_model)
    with progress(f"replaying {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    if as_json:
        from kf_calib.views.json import replay_object

        print_json(replay_object(result))
    else:
        from kf_calib.views.console import summary

        show(summary(result))
    with delivery(outputs, as_json) as deliver:
        deliver.calibration(save, result, source)
        deliver.model(save_model, result)
        pictures.save(deliver, result)
    exit_if(strict and result.consistency.consistent is False)
