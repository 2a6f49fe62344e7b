"""The command line: options in, one call of the library, a view out.

Every command with ``--json`` prints one JSON object on stdout and nothing else there. Exit 0: done; 1: the model is
inconsistent and ``--strict`` asked; 2: anything else, with one sentence on stderr; 130: Ctrl-C.
"""

from __future__ import annotations

import sys

import click

from kf_calib.cli.echo import fall_silent, open_streams
from kf_calib.cli.failures import tell
from kf_calib.cli.live import live
from kf_calib.cli.making import demo, record, simulate
from kf_calib.cli.paper import paper
from kf_calib.cli.plan import plan
from kf_calib.cli.runs import compare, diagnose, improve, list_effects, replay


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="kf_calib")
def cli() -> None:
    """Calibrate accelerometers on a stationary gimballed bench with a Kalman filter."""


for command in (demo, simulate, record, live, replay, compare, list_effects, diagnose, improve, plan, paper):
    cli.add_command(command)


def main() -> None:
    """Entry point of ``kf-calib``."""
    open_streams()
    try:
        code = cli.main(standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt):
        code = 130
    except (BrokenPipeError, SystemExit):  # click's and rich's way out where nobody reads any more
        code = _unheard(0)
    except Exception as error:
        tell(error)
        code = _unheard(2)
    sys.exit(code if isinstance(code, int) else 0)


def _unheard(code: int) -> int:
    """The exit code, which Python would change at its end where what is left to print cannot be printed."""
    try:
        sys.stdout.flush()
    except OSError:
        fall_silent()
    return code
