"""The files that commands write, pictures and pages among them: which they are, and their turn, which comes when the
result has been printed.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none
from click.core import ParameterSource

from kf_calib.cli.command import OUTPUT, option
from kf_calib.cli.echo import echo
from kf_calib.cli.failures import tell
from kf_calib.support.output_files import Outputs

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.diagnosis.stepwise_selection import Improvement
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


RerunFile = Annotated[Path | None, output_option("--rrd", metavar="FILE.rrd", help="Save the Rerun view here.")]


@dataclass(frozen=True)
class FigureFiles:
    """The files of figures that a command is to save."""

    png: Annotated[Path | None, output_option("--png", metavar="FILE.png", help="Save the main figure here.")] = None
    svg: Annotated[Path | None, output_option("--svg", metavar="FILE.svg", help="Save the main figure here.")] = None
    pdf: Annotated[
        Path | None, output_option("--pdf", metavar="FILE.pdf", help="Save the figures, one a page here.")
    ] = None

    def save(self, deliver: Delivery, result: object) -> None:
        """Save what was asked for of a result; matplotlib is imported when it has something to draw."""
        for kind, path in (("png", self.png), ("svg", self.svg), ("pdf", self.pdf)):
            deliver.file(path, lambda path, kind=kind: _save_figures(result, path, kind))


@dataclass(frozen=True)
class Pictures:
    """The files of pictures that a command is to save."""

    rrd: RerunFile = None
    figures: FigureFiles = FigureFiles()

    def save(self, deliver: Delivery, result: Any) -> None:
        """Save what was asked for of a result; Rerun and matplotlib are imported when they have something to draw."""
        deliver.file(self.rrd, lambda path: write_view(result, path))
        self.figures.save(deliver, result)


def _save_figures(result: object, path: Path, kind: str) -> None:
    """Save figures as the kind that the option names, whatever the name of the file ends in."""
    from kf_calib.views.figures import figures, save

    save(figures(result), path, kind)


def write_view(result: Calibration | Diagnosis | Improvement, path: Path) -> None:
    """The Rerun view of a result; Rerun is imported when there is one to save."""
    from kf_calib.views import rerun

    rerun.save_view(result, path)


ReportFile = Annotated[Path | None, output_option(
    "--report", metavar="FILE.html", help="Save a page with figures and tables here; it needs no network.",
)]  # fmt: skip


_HOW_IT_ENDS = ("overwrite", "strict", "as_json")
"""Options that change no number and no page."""


def commands_of(ctx: click.Context) -> list[str]:
    """The command that runs, as it could be typed again, and what prints its tables alone."""
    commands = [f"kf-calib {ctx.info_name} {typed(ctx, _HOW_IT_ENDS)}"]
    against = ctx.params.get("against")
    if ctx.info_name == "report" and against is None:
        shared = typed(ctx, ("output", *_HOW_IT_ENDS))
        commands += [f"kf-calib {name} {shared}" for name in ("replay", "diagnose")]
    others = [against] if against is not None and against.suffix != ".toml" else []
    named = [ctx.params["recording"]] if "recording" in ctx.params else []
    return [*commands, *(f"sha256sum {shlex.quote(str(path))}" for path in [*named, *others] if path.is_file())]


def given(ctx: click.Context) -> Iterator[tuple[click.Parameter, Any]]:
    """The arguments and options that the command line has, with their values."""
    for param in ctx.command.params:
        if param.name and ctx.get_parameter_source(param.name) is ParameterSource.COMMANDLINE:
            yield param, ctx.params[param.name]


def words_of(option: click.Option, value: Any) -> list[list[str]]:
    """An option as words of a shell, each time that it was given."""
    if option.is_flag:
        return [[option.opts[-1] if value else option.secondary_opts[-1]]]
    return [[option.opts[-1], str(each)] for each in (value if isinstance(value, tuple) else [value])]


def typed(ctx: click.Context, less: Sequence[str]) -> str:
    """Return the arguments and options that were given, but for some, as words of a shell."""
    words = list[str]()
    for param, value in given(ctx):
        if isinstance(param, click.Argument):
            words.insert(0, str(value))
        elif isinstance(param, click.Option) and param.name not in (*less, "units"):
            words += chain.from_iterable(words_of(param, value))
    return shlex.join(words)
