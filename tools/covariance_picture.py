"""The covariance that shrinks orientation by orientation: the moving picture of README, from recordings/hidden.mcap.

It is the Rerun view of the run, a screenshot of it with the time cursor at each orientation: the sigmas so far, and the
ellipsoids of 1 sigma of the sensitive axes. The panels are those of the view's overview, laid out for a narrow page.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from PIL import Image
from screenshot import screenshots

import kf_calib
from kf_calib.views.rerun import ORIENTATION, grow, platform_panel, sigma_panels
from kf_calib.views.rerun.names import rrd_file
from kf_calib.views.rerun.series import VisitHistory

RECORDING = Path(__file__).resolve().parents[1] / "recordings" / "hidden.mcap"
_SIZE_PX = 800, 520
_COLOURS = 128
_FRAME_MS, _LAST_MS = 500, 3000


def frames() -> list[Image.Image]:
    """A picture after each dwell."""
    run = kf_calib.calibrate(RECORDING, kf_calib.Settings(effects=("hysteresis",)))
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder, "view.rrd")
        with rrd_file(rrd, _layout(run)) as stream:
            grow(run, stream, shown=0, lay_out=False)
        return screenshots(rrd, _SIZE_PX, ORIENTATION, [visit.dwell.number for visit in run.visits])


def save(path: Path) -> Path:
    """Write the frames as a GIF that begins again, with a rest at the end."""
    drawn = frames()
    palette = drawn[-1].quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, 1)  # everything is drawn in the last one
    pictures = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in drawn]
    durations = [_FRAME_MS] * (len(pictures) - 1) + [_LAST_MS]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=True)
    return path


def _layout(run: kf_calib.Calibration) -> rrb.Blueprint:
    """The panels of sigmas, whose curves end at the time cursor, beside the platform."""
    endless, now = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative(seq=-1)
    panels = sigma_panels(VisitHistory.of(run))[:3]
    for panel in panels:
        panel.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(
            [rrb.VisibleTimeRange(ORIENTATION, start=endless, end=now)]
        )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*panels), platform_panel(run), column_shares=[2, 3]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=ORIENTATION),
    )
