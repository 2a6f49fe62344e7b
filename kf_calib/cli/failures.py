"""What a command that failed says: one sentence, whatever went wrong; and the signals that end one before its time.

What was not foreseen leaves a report for a maintainer, with nothing of the user's data: the kind of the error and of
those behind it, the lines of program that were at work, versions, and the names of the options that were given. It has
no message, no value and no name of a file: these may hold data.
"""

from __future__ import annotations

import os
import platform
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType

import click

from kf_calib.cli.echo import complain
from kf_calib.errors import KfCalibError
from kf_calib.support.text import printable

PACKAGE = Path(__file__).parents[1]
_PACKAGES = ("kf_calib", "numpy", "scipy", "filterpy", "mcap", "rerun-sdk", "matplotlib", "pydantic", "click")

_COMMAND = re.compile(r"[a-z]+")
_OPTION = re.compile(r"--[a-z][a-z-]*|-[A-Za-z]")

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


def write_error_report(error: BaseException, words: Sequence[str]) -> Path | None:
    """The file, among the temporary ones; None where it cannot be written. words: of the command line."""
    import tempfile

    name = f"kf-calib-error-{datetime.now(UTC):%Y%m%dT%H%M%S}-"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix=name, suffix=".txt", delete=False, encoding="utf-8", errors="replace"
        ) as file:
            file.writelines(f"{line}\n" for line in error_report(error, words))
            return Path(file.name)
    except OSError:
        return None


def error_report(error: BaseException, words: Sequence[str]) -> Iterator[str]:
    """The lines of the report."""
    yield "Error report of kf-calib. It holds no readings, no messages, no values and no names of files."
    yield f"command: {' '.join(without_values(words))}"
    yield f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    yield ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    yield f"standard output: {getattr(sys.stdout, 'encoding', None)}"
    cause: BaseException | None = error
    while cause is not None:  # and those in whose handling it arose
        yield ""
        yield type(cause).__name__
        for frame in traceback.extract_tb(cause.__traceback__):
            yield f"  {place(Path(frame.filename))}:{frame.lineno} in {frame.name}"
        cause = cause.__cause__ or cause.__context__


def without_values(words: Sequence[str]) -> list[str]:
    """The command and the names of its options; what else was typed is a dot."""
    names = [_OPTION.match(word) or (_COMMAND.fullmatch(word) if k == 0 else None) for k, word in enumerate(words)]
    return [name[0] if name else "·" for name in names]


def place(path: Path) -> Path:
    """The path of a module, without what lies above its package."""
    if PACKAGE in path.parents:
        return path.relative_to(PACKAGE.parent)
    parts = path.parts
    return Path(*parts[parts.index("site-packages") + 1 :]) if "site-packages" in parts else Path(path.name)


def _version(package: str) -> str:
    from importlib import metadata  # here: a run that does not fail starts 20 ms earlier

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(not installed)"


@contextmanager
def answered(answer: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Have ``answer`` called for each signal that asks a run to end: Ctrl-C, SIGTERM, and SIGHUP, which comes when the
    terminal is closed and stays ignored where it was (nohup); on Windows SIGBREAK stands for the last two.

    After a SIGHUP further ones are ignored for good: terminal and shell both send one, and the second must not kill
    the process while it writes its results and ends.
    """
    came: set[int] = set()

    def called(number: int, _: FrameType | None) -> None:
        came.add(number)
        answer(signal.Signals(number))

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    if (broken := getattr(signal, "SIGBREAK", None)) is not None:
        numbers.append(broken)
    before = {number: signal.signal(number, called) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            hung_up = number in came and number not in (signal.SIGINT, signal.SIGTERM)
            signal.signal(number, signal.SIG_IGN if hung_up else handler)


class Interrupter:
    """An answer by which any of them is Ctrl-C: what is at work lets go of what it has open.

    Within ``finished_first`` it takes effect only at the end of the block: a file that is being written stays whole.
    """

    def __init__(self) -> None:
        self._busy = self._asked = False

    def __call__(self, _: signal.Signals) -> None:
        self._asked = True
        if not self._busy:
            raise KeyboardInterrupt

    @contextmanager
    def finished_first(self) -> Iterator[None]:
        """Let the block be done before an interrupt takes effect."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
        if self._asked:
            raise KeyboardInterrupt
