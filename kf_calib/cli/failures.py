"""What a command that failed says: one sentence, whatever went wrong."""

from __future__ import annotations

import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path

import click

from kf_calib.cli.echo import complain
from kf_calib.cli.error_report import PACKAGE, place, write_error_report
from kf_calib.errors import KfCalibError
from kf_calib.support.plain_text import printable

TRACEBACK = "KF_CALIB_TRACEBACK"


def tell(error: BaseException) -> None:
    """Print the sentence, after the traceback where the environment asks for it."""
    if os.environ.get(TRACEBACK):
        with suppress(OSError):
            click.echo(printable("".join(traceback.format_exception(error))), err=True)
    complain(sentence(error))


def sentence(error: BaseException) -> str:
    """What went wrong, where, and what to do next."""
    match error:
        case click.ClickException():
            ctx = getattr(error, "ctx", None)
            hint = f" (see {ctx.command_path} --help)" if ctx is not None else ""
            return f"{error.format_message().rstrip()}{hint}"
        case KfCalibError():
            return str(error)
        case MemoryError():
            return f"there is not memory enough ({_type_and_text(error)}): give it fewer readings, or more memory."
        case OSError() if error.strerror:
            where = "" if error.filename is None else f"{error.filename}: "
            return f"{where}{error.strerror} ({_place(error)}): mend that, and run it again."
        case _:
            what = f"{_type_and_text(error)}, which was not foreseen, in {_place(error)}"
            if report := write_error_report(error, sys.argv[1:]):
                return f"{what}: please report it, with {report}, which holds none of your data."
            return f"{what}: please report it, with the traceback that {TRACEBACK}=1 in the environment shows."


def _type_and_text(error: BaseException) -> str:
    """Type and text, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _place(error: BaseException) -> str:
    """The innermost line of this package that was at work, as ``kf_calib/estimation/fit.py:88``."""
    frames = traceback.extract_tb(error.__traceback__)
    in_package = [frame for frame in frames if PACKAGE in Path(frame.filename).parents]
    if not (in_package or frames):
        return "an unknown place"
    frame = (in_package or frames)[-1]
    return f"{place(Path(frame.filename))}:{frame.lineno}"
