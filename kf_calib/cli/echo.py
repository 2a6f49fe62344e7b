"""Printing: what comes from files and links commands no terminal, and there may be nobody to read it."""

from __future__ import annotations

import os
import sys

import click

from kf_calib.errors import KfCalibError
from kf_calib.text import printable, sentence


def echo(text: str) -> None:
    """Print, and end the line; where nobody reads any more, what follows is printed to nobody, and the work goes on."""
    echo_drawn(f"{printable(text)}\n")


def complain(said: str) -> None:
    """Print one line on the error stream."""
    click.echo(sentence(said), err=True)


def echo_drawn(text: str) -> None:
    """Print what a ``PlainConsole`` has drawn, with its colours; as ``echo`` otherwise."""
    try:
        click.echo(text, nl=False)
        sys.stdout.flush()
    except BrokenPipeError:
        fall_silent()
    except OSError as error:
        raise KfCalibError(f"standard output cannot be written to ({error.strerror}): send it elsewhere.") from None


def fall_silent() -> None:
    """Have all that is still to be printed go nowhere; Python itself prints at its end what is left."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def open_streams() -> None:
    """Standard streams that were closed lead nowhere: the next file that is opened would take their place."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123  # for as long as the program lasts
