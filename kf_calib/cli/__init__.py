"""The command line: options in, one call of the library, a view out.

Every command with ``--json`` prints one JSON object on stdout and nothing else there. Exit 0: done; 1: the model is
inconsistent and ``--strict`` asked; 2: anything else, with one sentence on stderr; 130: Ctrl-C.
"""

from __future__ import annotations

import gc
import os
import re
import sys
from importlib import import_module
from pathlib import Path

import click
import rich_click

from kf_calib.cli.command import HELP_NAMES
from kf_calib.cli.echo import fall_silent, open_streams
from kf_calib.cli.failures import tell

SECTIONS = {
    "Evaluate a recording": {"replay": "cli.replay.replay", "diagnose": "cli.evaluate.diagnose",
                             "improve": "cli.improve.improve", "compare": "cli.evaluate.compare",
                             "report": "report.command.report", "noise": "cli.noise.noise"},
    "Evaluate many": {"fleet": "fleet.command.fleet"},
    "Use a calibration": {"apply": "cli.exchange.apply", "verify": "cli.exchange.verify",
                          "history": "cli.exchange.history", "export": "exports.command.export",
                          "certificate": "certificate.command.certificate"},
    "Run a bench": {"plan": "cli.plan.plan", "record": "cli.acquire.record", "live": "cli.live.live",
                    "run": "positioning.command.run"},
    "Try it without a bench": {"demo": "cli.acquire.demo", "simulate": "cli.acquire.simulate"},
    "Look up": {"info": "cli.info.info", "effects": "cli.evaluate.list_effects", "paper": "reproduction.command.paper"},
}  # fmt: skip
"""The commands, as ``--help`` has them, and where each is; a leaf is a folder with a command of its own."""

_HOMES = {name: home for own in SECTIONS.values() for name, home in own.items()}


class _Commands(rich_click.RichGroup):
    """Commands that are imported when one of them runs."""

    listed = False

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in _HOMES and not self.listed:
            module, _, function = _HOMES[cmd_name].rpartition(".")
            return getattr(import_module(f"kf_calib.{module}"), function)
        for name in _HOMES.keys() - self.commands:  # a mistyped one is compared with all
            self.add_command(rich_click.RichCommand(name=name, help=_summary(_HOMES[name])))
        return super().get_command(ctx, cmd_name)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_HOMES)

    def format_help(self, ctx: rich_click.RichContext, formatter: rich_click.RichHelpFormatter) -> None:
        self.listed = True
        super().format_help(ctx, formatter)
        self.listed = False


def _summary(home: str) -> str:
    """Return the first paragraph of a command's docstring as it stands in its file: to import all takes 0.3 s."""
    module, _, function = home.rpartition(".")
    text = Path(__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py").read_text("utf-8")
    found = re.search(rf'^def {function}\(.*?"""(.*?)(?:\n\n|""")', text, re.DOTALL | re.MULTILINE)
    return " ".join(found[1].split()) if found else ""


_HELP = {
    "theme": "default-slim",
    "max_width": 110,
    "force_terminal": None,  # colours on a terminal only, whatever the environment of a build says
    "options_table_column_types": ["opt_all_metavar", "help"],
    "options_table_help_sections": ["help", "default"],
    "default_string": r"\[default: {}]",
    "command_groups": {"*": [{"name": name, "commands": [*own]} for name, own in SECTIONS.items()]},
}


@rich_click.group(cls=_Commands, context_settings={**HELP_NAMES, "rich_help_config": _HELP})
@rich_click.version_option(package_name="kf_calib")
def cli() -> None:
    """Calibrate accelerometers on a stationary gimballed bench with a Kalman filter."""


def main() -> None:
    """Entry point of ``kf-calib``."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # all linear algebra takes one: 20 ms less to start
    open_streams()
    try:
        code = cli.main(standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt):
        code = 130
    except (BrokenPipeError, SystemExit):  # click's and rich's way out where nobody reads any more
        code = 0
    except Exception as error:
        tell(error)
        code = 2
    for stream in (sys.stdout, sys.stderr):  # Python would change the exit code where its end cannot print what is left
        try:
            stream.flush()
        except OSError:
            fall_silent(stream)
    gc.freeze()  # as the process ends, Python would look for cycles in all that is left, which takes 40 ms
    sys.exit(code if isinstance(code, int) else 0)
