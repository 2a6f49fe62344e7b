"""Printing a result that may have nobody to read it."""

from __future__ import annotations

import os
import sys

import click

from kf_calib.errors import KfCalibError


def echo(text: str, end: bool = True) -> None:
    """Print, and end the line; where nobody reads any more, what follows is printed to nobody, and the work goes on."""
    try:
        click.echo(text, nl=end)
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
