"""Pictures that commands save: the Rerun view, a screenshot of it, and figures for a report."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from kf_calib.cli.echo import complain
from kf_calib.cli.files import Delivery, output_option

if TYPE_CHECKING:
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.diagnosis.stepwise_selection import Improvement
    from kf_calib.estimation.results import Calibration

RerunFile = Annotated[Path | None, output_option("--rrd", metavar="FILE.rrd", help="Save the Rerun view here.")]


@dataclass(frozen=True)
class FigureFiles:
    """The files of figures that a command is to save."""

    png: Annotated[Path | None, output_option("--png", metavar="FILE.png", help="Save the main figure here.")] = None
    svg: Annotated[Path | None, output_option("--svg", metavar="FILE.svg", help="Save the main figure here.")] = None
    pdf: Annotated[
        Path | None, output_option("--pdf", metavar="FILE.pdf", help="Save the figures, one a page here.")
    ] = None

    def save(self, deliver: Delivery, result: object) -> None:
        """Save what was asked for of a result; matplotlib is imported when it has something to draw."""
        for kind, path in (("png", self.png), ("svg", self.svg), ("pdf", self.pdf)):
            deliver.file(path, lambda path, kind=kind: _save_figures(result, path, kind))


@dataclass(frozen=True)
class Pictures:
    """The files of pictures that a command is to save."""

    rrd: RerunFile = None
    figures: FigureFiles = FigureFiles()
    screenshot: Annotated[Path | None, output_option(
        "--screenshot", metavar="FILE.png",
        help="Save a screenshot of the Rerun view here; needs a graphics driver.",
    )] = None  # fmt: skip

    def save(self, deliver: Delivery, result: Any) -> None:
        """Save what was asked for of a result; Rerun and matplotlib are imported when they have something to draw.

        A viewer that finds no graphics driver is a complaint; all else that fails is told as for any other file.
        """
        deliver.file(self.rrd, lambda path: write_view(result, path))
        self._screenshot(deliver, result)
        self.figures.save(deliver, result)

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


def write_view(result: Calibration | Diagnosis | Improvement, path: Path) -> None:
    """The Rerun view of a result; Rerun is imported when there is one to save."""
    from kf_calib.views import rerun

    rerun.save_view(result, path)
