"""The command line: options in, one call of the library, a view out.

Every command with ``--json`` prints one JSON object on stdout and nothing else there. Exit 0: done; 1: the model is
inconsistent and ``--strict`` asked; 2: anything else, with one sentence on stderr; 130: Ctrl-C.
"""

from __future__ import annotations

import sys
from itertools import chain

import click
import rich_click

from kf_calib.cli.echo import fall_silent, open_streams
from kf_calib.cli.failures import tell
from kf_calib.cli.live import live
from kf_calib.cli.making import demo, record, simulate
from kf_calib.cli.paper import paper
from kf_calib.cli.plan import plan
from kf_calib.cli.runs import compare, diagnose, improve, list_effects, replay

SECTIONS = {
    "Evaluate a recording": (replay, diagnose, improve, compare),
    "Run a bench": (plan, record, live),
    "Try it without a bench": (demo, simulate),
    "Look up": (list_effects, paper),
}
"""The commands, as ``--help`` has them."""


_HELP = {
    "theme": "default-slim",
    "max_width": 110,
    "force_terminal": None,  # colours on a terminal only, whatever the environment of a build says
    "options_table_column_types": ["opt_all_metavar", "help"],
    "options_table_help_sections": ["help", "default"],
    "default_string": r"\[default: {}]",
    "command_groups": {
        "*": [{"name": name, "commands": [each.name for each in own]} for name, own in SECTIONS.items()]
    },
}


@rich_click.group(context_settings={"help_option_names": ["-h", "--help"], "rich_help_config": _HELP})
@rich_click.version_option(package_name="kf_calib")
def cli() -> None:
    """Calibrate accelerometers on a stationary gimballed bench with a Kalman filter."""


for command in chain.from_iterable(SECTIONS.values()):
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
