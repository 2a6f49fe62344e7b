"""Printing: what comes from files and links commands no terminal, and there may be nobody to read it, or no room."""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any, TextIO

import click

from kf_calib.errors import KfCalibError
from kf_calib.support.json_values import json_value
from kf_calib.support.text import printable, sentence

_SIGNS = "µσΔχ²±┃"


def echo(text: str) -> None:
    """Print, and end the line; where nobody reads any more, what follows is printed to nobody, and the work goes on."""
    echo_drawn(f"{printable(text)}\n")


def echo_drawn(text: str) -> None:
    """Print what a ``PlainConsole`` has drawn, with its colours; as ``echo`` otherwise."""
    try:
        click.echo(text, nl=False)
        sys.stdout.flush()
    except BrokenPipeError:
        fall_silent()
    except OSError as error:
        raise KfCalibError(f"standard output cannot be written to ({error.strerror}): send it elsewhere.") from None


class Printer:
    """Prints for a run that goes on whatever becomes of what it prints.

    lost: texts that could not be written, which is told once. is_heard: False as soon as nobody reads any more.
    """

    def __init__(self) -> None:
        self.lost, self.is_heard = 0, True
        self._is_amid = False  # a line, which what comes next must not go on with

    def __call__(self, text: str, end: bool = True) -> None:
        """Print what is fit for a terminal (a ``sentence``, JSON, what a ``PlainConsole`` has drawn)."""
        try:
            click.echo("\n" * self._is_amid + text, nl=end)
            sys.stdout.flush()
            self._is_amid = False
        except BrokenPipeError:
            fall_silent()
            self.is_heard = False
        except OSError as error:
            self.fail(error)

    def fail(self, error: OSError) -> None:
        """A text is lost, and what waits to be printed is dropped."""
        with suppress(OSError):
            kept = os.dup(sys.stdout.fileno())
            fall_silent()
            sys.stdout.flush()
            os.dup2(kept, sys.stdout.fileno())
            os.close(kept)
        self.lost, self._is_amid = self.lost + 1, True
        if self.lost == 1:
            complain(f"standard output cannot be written to ({error.strerror}): the run goes on, make room or end it.")


def complain(text: str) -> None:
    """Print a sentence to standard error, if that leads anywhere."""
    with suppress(OSError):
        click.echo(f"kf-calib: {sentence(text)}", err=True)


def fall_silent(stream: TextIO | None = None) -> None:
    """Have all that is still to be printed (None: on standard output) go nowhere; Python itself prints at its end what
    is left."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, (stream or sys.stdout).fileno())
    os.close(nowhere)


def open_streams() -> None:
    """Standard streams that were closed lead nowhere: the next file that is opened would take their place."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            null = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115, PTH123  # for as long as the program lasts
            setattr(sys, name, null)
    for stream in (sys.stdout, sys.stderr):
        _print_all_signs(stream)


def _print_all_signs(stream: Any) -> None:
    """Have a stream take µ, σ and the lines of tables: the code pages of Windows have not all of them.

    A terminal keeps its encoding and shows a question mark for what it lacks; a file or a pipe gets UTF-8.
    """
    try:
        _SIGNS.encode(stream.encoding or "utf-8")
    except UnicodeEncodeError:
        settings = {"errors": "replace"} if stream.isatty() else {"encoding": "utf-8"}
        stream.reconfigure(**settings)


def print_json(content: Mapping[str, Any]) -> None:
    echo(json_line(content))


def json_line(content: Mapping[str, Any]) -> str:
    """One line of JSON; what is not printable is escaped, which JSON itself asks of a part of it only."""
    text = json.dumps(json_value(content), ensure_ascii=False, allow_nan=False)
    return text if text.isprintable() else "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def show(renderable: Any) -> None:
    echo_drawn(rendered(renderable))


def print_result(
    as_json: bool, of_json: Callable[..., Mapping[str, Any]], report: Callable[..., Any], *made: Any
) -> None:
    """Print what was made: one JSON object, or what people read; both are functions of it."""
    if as_json:
        print_json(of_json(*made))
    else:
        show(report(*made))


def rendered(renderable: Any) -> str:
    """As text for standard output, its line ended; nothing is written."""
    from kf_calib.views.terminal import PlainConsole

    screen, text = sys.stdout.isatty(), io.StringIO()
    width = None if screen or os.environ.get("COLUMNS", "").isdigit() else 110
    PlainConsole(file=text, force_terminal=screen or None, width=width, soft_wrap=not screen).print(renderable)
    return text.getvalue()


@contextlib.contextmanager
def progress(text: str, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """What is being done, on a terminal's stderr; nothing where stderr is piped.

    A bar where a fraction is told; while none is known, or all of it was read and the work goes on, the bar only
    moves, beside the stage that the work is in.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    from kf_calib.support import stage
    from kf_calib.views.terminal import PlainConsole

    columns = BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False)
    with Progress(*columns, console=PlainConsole(stderr=True), transient=True, redirect_stdout=False) as bars:
        bars.add_task(text, total=None)
        (task,) = bars.tasks

        def tick(fraction: float) -> None:  # a task whose total is reached would stand still from then on
            task.completed, task.total = fraction, 1.0 if fraction < 1.0 else None

        def say(now: str) -> None:
            task.description = f"{text}: {now}"

        with stage.listener(say):
            yield tick
