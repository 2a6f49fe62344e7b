"""Pictures that commands save: the Rerun view, a screenshot of it, and figures for a report."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kf_calib.cli.command import OUTPUT
from kf_calib.cli.echo import complain
from kf_calib.cli.files import Delivery, output_option

if TYPE_CHECKING:
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.diagnosis.stepwise_selection import Improvement
    from kf_calib.estimation.results import Calibration

F = TypeVar("F", bound=Callable[..., Any])

rrd_option = output_option("--rrd", metavar="FILE.rrd", help="Save the Rerun view here.", panel=OUTPUT)


@dataclass(frozen=True)
class Pictures:
    """The files that a command is to save; None where it is not asked for, or the command does not offer it."""

    rrd: Path | None
    screenshot: Path | None
    png: Path | None
    svg: Path | None
    pdf: Path | None

    @classmethod
    def taken_from(cls, options: dict[str, Any]) -> Pictures:
        """The pictures among a command's options, which have them no longer."""
        return cls(**{each.name: options.pop(each.name, None) for each in fields(cls)})

    def save(self, deliver: Delivery, result: Any) -> None:
        """Save what was asked for of a result; Rerun and matplotlib are imported when they have something to draw.

        A viewer that finds no graphics driver is a complaint; all else that fails is told as for any other file.
        """
        deliver.file(self.rrd, lambda path: write_view(result, path))
        self._screenshot(deliver, result)
        for kind, path in (("png", self.png), ("svg", self.svg), ("pdf", self.pdf)):
            deliver.file(path, lambda path, kind=kind: _save_figures(result, path, kind))

    def _screenshot(self, deliver: Delivery, result: Any) -> None:
        from kf_calib.views.screenshot import ScreenshotError, screenshot

        rrd = None if self.rrd in deliver.failures else self.rrd

        def draw(path: Path) -> None:
            with tempfile.TemporaryDirectory() as folder:
                drawn = rrd or Path(folder) / "view.rrd"
                if rrd is None:
                    write_view(result, drawn)
                screenshot(drawn, path)

        deliver.file(self.screenshot, draw)
        error = None if self.screenshot is None else deliver.failures.get(self.screenshot)
        if isinstance(error, ScreenshotError) and self.screenshot is not None:
            complain(f"the screenshot could not be taken: {error}")
            del deliver.failures[self.screenshot]


def _save_figures(result: object, path: Path, kind: str) -> None:
    """Save figures as the kind that the option names, whatever the name of the file ends in."""
    from kf_calib.views.figures import figures, save

    save(figures(result), path, kind)


def picture_options(command: F) -> F:
    """``--rrd``, ``--screenshot``, and ``--png``, ``--svg``, ``--pdf`` for figures."""
    text = "Save a screenshot of the Rerun view here; needs a graphics driver."
    screenshot = output_option("--screenshot", metavar="FILE.png", help=text, panel=OUTPUT)
    return rrd_option(figure_options(screenshot(command)))


def figure_options(command: F) -> F:
    """``--png``, ``--svg``, ``--pdf`` for figures."""
    for kind, what in (("pdf", "figures, one a page"), ("svg", "main figure"), ("png", "main figure")):
        text = f"Save the {what} here."
        command = output_option(f"--{kind}", metavar=f"FILE.{kind}", help=text, panel=OUTPUT)(command)
    return command


def write_view(result: Calibration | Diagnosis | Improvement, path: Path) -> None:
    """The Rerun view of a result; Rerun is imported when there is one to save."""
    from kf_calib.views import rerun

    rerun.save_view(result, path)
