"""The Rerun view of a fleet: what its runs come to together, by date and by unit.

Timeline ``date``: of the first reading of each run. Entities: ``bench/EFFECT/BENCH/SYMBOL/{all,part,band}``,
``weeks/VERDICT``, ``scatter/{SYMBOL,limits}`` and ``control/SYMBOL/{run,outside,sigma,limits}``, the charts ``units``,
``sigma/SYMBOL/{run,target}``, ``summary``. Numbers are those of the ``FleetOverview``, in the units that people are
shown. Of a large fleet some runs are left out (``Thinned``), which the page of text says.
"""

from __future__ import annotations

from datetime import UTC, datetime, time, timedelta
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from kf_calib.fleet.overview import FleetOverview
from kf_calib.fleet.track import Track
from kf_calib.fleet.weeks import Weeks
from kf_calib.support.plain_text import printable
from kf_calib.support.units import shown
from kf_calib.views.rerun.chart import Ink, sheet
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.fleet_dates import (
    DATE,
    Panel,
    log_bench,
    log_control,
    log_sigmas,
    log_weeks,
    panels_of,
)
from kf_calib.views.rerun.fleet_summary import summary
from kf_calib.views.rerun.fleet_units import UNITS, charts_of, draw
from kf_calib.views.rerun.layout import WHOLE_RUN
from kf_calib.views.rerun.names import entity, label_of

TABS = ("Overview", "Control charts", "Units", "Sigmas", "Bench")
_WIDE = 4
_ROOM = 0.3  # of the campaign


def save(found: FleetOverview, path: Path, tab: str = TABS[0]) -> Path:
    """Write the view of a fleet to an .rrd file that opens laid out, ``tab`` (one of TABS) in front."""
    with rrd_file(path, _layout(found, tab)) as stream:
        for panel in panels_of(found):
            log_bench(panel, found, stream)
        log_weeks(found.weeks, stream)
        for track in found.tracks:
            log_control(track, stream)
            log_sigmas(track, stream)
        ink = Ink()
        for track, chart in zip(found.tracks, charts_of(found), strict=True):
            draw(track, found.units, chart, ink)
        ink.send(stream, UNITS)
        text = rr.TextDocument(printable(summary(found)), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", text, static=True)
    return path


def _layout(found: FleetOverview, tab: str) -> rrb.Blueprint:
    """The blueprint for a window of about 1600 x 1000; what needs dates is left out where no run has one."""
    tabs, panels = {TABS[0]: _overview(found)}, panels_of(found)
    dated = found.tracks if found.first is not None else ()
    if dated:
        tabs[TABS[1]] = rrb.Grid(*map(_control, dated), grid_columns=_WIDE, name=TABS[1])
    if found.tracks:
        name = "less nominal, units by name; pale: runs; lines: median of the units ± 2 spreads; red: outliers"
        tabs[TABS[2]] = rrb.Horizontal(sheet(UNITS, name, charts_of(found)), name=TABS[2])
    if dated:
        tabs[TABS[3]] = rrb.Grid(*map(_sigma, dated), grid_columns=_WIDE, name=TABS[3])
    if len(panels) > 1:
        tabs[TABS[4]] = rrb.Grid(*map(_bench, panels), grid_columns=2, name=TABS[4])
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=[*tabs].index(tab)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=DATE, play_state="following"),
    )


def _overview(found: FleetOverview) -> rrb.Container:
    text = rrb.TextDocumentView(origin="summary", name="what was found")
    if found.first is None:
        return rrb.Horizontal(text, name=TABS[0])
    first = [_bench(panel) for panel in panels_of(found)[:1]]
    name = "all parameters: run less mean of its unit, in sigma of that scatter"
    control = [_series("scatter", name)] if found.tracks else []
    return rrb.Horizontal(rrb.Vertical(*first, _weeks(found.weeks), *control), text, column_shares=[6, 5], name=TABS[0])


def _bench(panel: Panel) -> rrb.TimeSeriesView:
    return _series(panel.path, panel.title)


def _weeks(weeks: Weeks) -> rrb.TimeSeriesView:
    """Verdicts by week, with room for their names before the first."""
    span = (weeks.begins[-1] - weeks.begins[0]) + timedelta(weeks=1)
    first = datetime.combine(weeks.begins[0] - _ROOM * span, time(), UTC)
    room = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seconds=first.timestamp()), end=rr.TimeRangeBoundary.infinite()
    )
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    return _series("weeks", "verdicts: runs a week", rrb.TimeAxis(view_range=room), legend)


def _control(track: Track) -> rrb.TimeSeriesView:
    return _series(entity("control", track.symbol), f"{_named(track)}: run less mean of its unit")


def _sigma(track: Track) -> rrb.TimeSeriesView:
    return _series(entity("sigma", track.symbol), f"{_named(track)}: σ of a run")


def _named(track: Track) -> str:
    return printable(f"{label_of(track.symbol)}, {shown(track.unit).label}".rstrip(", "))


def _series(
    path: str, name: str, across: rrb.TimeAxis = WHOLE_RUN, legend: rrb.PlotLegend | None = None
) -> rrb.TimeSeriesView:
    """The curves below a path, over the dates of the whole campaign."""
    hidden = rrb.PlotLegend(visible=False)
    return rrb.TimeSeriesView(contents=[f"{path}/**"], name=name, plot_legend=legend or hidden, axis_x=across)
