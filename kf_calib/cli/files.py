"""The files that commands write: which they are, and their turn, which comes when the result has been printed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none

from kf_calib.cli.command import OUTPUT, option
from kf_calib.cli.echo import echo
from kf_calib.cli.failures import tell
from kf_calib.support.output_files import Outputs

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.estimation.results import Calibration


class OutputFile(click.Path):
    """The type of an option or argument that names a file to write."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)


output_option = partial(option, type=OutputFile(), panel=OUTPUT)
"""An option that names a file to write."""


def claimed(
    inputs: Iterable[Path] = (), beside: Mapping[str, Path] = MappingProxyType({}), overwrite: bool = False
) -> Outputs:
    """The outputs of the command that runs, seen to harm nothing; every path among its options is one, or is read.

    inputs: files that it reads besides. beside: files that it writes besides.
    """
    ctx = get_current_context()
    files, read = dict[str, Path | None](beside), list(inputs)
    for param in ctx.command.params:
        value = ctx.params.get(param.name or "")
        if isinstance(param.type, OutputFile):
            files[param.opts[0] if isinstance(param, click.Option) else param.make_metavar(ctx)] = value
        else:
            read += [each for each in (value if isinstance(value, tuple) else [value]) if isinstance(each, Path)]
    outputs = Outputs(files, read, overwrite)
    if ctx.params.get("model_file"):
        from kf_calib.exchange import calibration_file

        outputs.spare([each.path for each in calibration_file.read_model(ctx.params["model_file"]).programs])
    return outputs


class Delivery:
    """Writes one file after another; what fails is told when all have had their turn. Each that is done is printed."""

    def __init__(self, outputs: Outputs, quiet: bool) -> None:
        self._outputs, self._quiet = outputs, quiet
        self.failures = dict[Path, Exception]()

    def keep(self, path: Path | None, save: Callable[[Path], object]) -> bool:
        """Write a file without a word, if there is to be one; whether it is there."""
        if path is None:
            return False
        try:
            self._outputs.write(path, save)
        except Exception as error:
            self.failures[path] = error
            return False
        self.failures.pop(path, None)
        return True

    def file(self, path: Path | None, save: Callable[[Path], object]) -> None:
        """Write a file, if there is to be one."""
        if self.keep(path, save) and not self._quiet:
            echo(f"saved {path}")

    def model(self, path: Path | None, result: Calibration) -> None:
        """Write the model of a result, if there is to be a file of it."""
        if path is not None:
            from kf_calib.estimation import model_file

            self.file(path, lambda path: model_file.write_model_file(path, result))

    def calibration(self, path: Path | None, result: Calibration, source: Source) -> None:
        """Write the calibration file of a result, if there is to be one; source: what it was made from."""
        if path is not None:
            from kf_calib.exchange import calibration_file

            self.file(
                path, lambda path: calibration_file.write_calibration(path, calibration_file.of_source(result, source))
            )


@contextmanager
def delivery(outputs: Outputs, quiet: bool) -> Iterator[Delivery]:
    """What writes the files of a run; in the end it tells what could not be written, and the command exits with 2."""
    delivering = Delivery(outputs, quiet)
    try:
        yield delivering
    finally:
        for error in delivering.failures.values():
            tell(error)
    if delivering.failures:
        get_current_context().exit(2)
