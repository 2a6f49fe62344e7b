"""The command line: options in, one call of the library, a view out.

Every command with ``--json`` prints one JSON object on stdout and nothing else there. Exit 0: done; 1: the model is
inconsistent and ``--strict`` asked; 2: bad usage or input, with one sentence on stderr.
"""

from __future__ import annotations

import sys
from itertools import chain

import click
import rich_click

from kf_calib.cli.live import live
from kf_calib.cli.making import demo, record, simulate
from kf_calib.cli.paper import paper
from kf_calib.cli.plan import plan
from kf_calib.cli.runs import compare, diagnose, improve, list_effects, replay
from kf_calib.errors import KfCalibError

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
    try:
        code = cli.main(standalone_mode=False)
    except click.exceptions.Abort:
        sys.exit(130)
    except KeyboardInterrupt:
        sys.exit(130)
    except click.ClickException as error:
        ctx = getattr(error, "ctx", None)
        hint = f" (see {ctx.command_path} --help)" if ctx is not None else ""
        click.echo(f"kf-calib: {error.format_message().rstrip()}{hint}", err=True)
        sys.exit(2)
    except KfCalibError as error:
        click.echo(f"kf-calib: {error}", err=True)
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(0)
    sys.exit(code if isinstance(code, int) else 0)
