"""The Rerun view of a replay: sigmas falling, axes and their uncertainty in the platform, innovations, correlations.

A thin bridge: every number comes from the ``Calibration``, is scaled to a unit an engineer reads, and is sent in
columns. Two timelines: ``bench_time`` (since the first sample; points within the dwells too) and ``orientation``
(the count of dwells from 1; 0 is a stated prior). Angles are in arcsec, scale factors in ppm, biases and innovations
in µg, or all in SI (``support.units.shown_in``). Where the orientations so far do not determine a parameter there is no
point.

Entities: ``parameters/ACCELEROMETER/SYMBOL/{log10_sigma,deviation,band}``, ``platform/...``,
``innovation/CHANNEL/{value,bound,in_sigma}``, ``nis/{value,above,band}``, ``correlation/{picture,matrix,...}``,
``bench/{dwell,pose/...}``, ``summary``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr

from kf_calib.estimation.results import Calibration
from kf_calib.support.plain_text import printable
from kf_calib.views.rerun.correlation import log_correlation
from kf_calib.views.rerun.file import rrd_file
from kf_calib.views.rerun.layout import TABS, layout
from kf_calib.views.rerun.names import BENCH_TIME, ORIENTATION
from kf_calib.views.rerun.platform import log_platform
from kf_calib.views.rerun.series import History, log_bench, log_innovations, log_nis, log_parameters
from kf_calib.views.rerun.summary import summary

__all__ = ["BENCH_TIME", "ORIENTATION", "TABS", "grow", "layout", "log", "save"]


def save(result: Calibration, path: str | Path, timeline: str = BENCH_TIME, tab: str = TABS[0]) -> Path:
    """Write the view of a run to an .rrd file that opens laid out, at the end of the run.

    ``timeline``: BENCH_TIME or ORIENTATION; ``tab``: which of TABS is in front. Raises InputError where the
    file cannot be written.
    """
    path = Path(path)
    history = History.of(result)
    with _strict(), rrd_file(path, layout(result, history, timeline, tab)) as stream:
        _log(result, history, stream)
    return path


def log(result: Calibration, stream: rr.RecordingStream) -> None:
    """Send everything a run showed to a recording stream: a file, or a viewer that is open."""
    with _strict():
        _log(result, History.of(result), stream)


def grow(result: Calibration, stream: rr.RecordingStream, shown: int, lay_out: bool) -> None:
    """Send what a run shows beyond its first ``shown`` dwells, which were sent already, and the layout if asked to.

    A dwell stays in the curves as it was known when it was sent; the platform and the page of text are made anew.
    """
    with _strict():
        history = History.of(result)
        _log(result, history, stream, shown)
        if lay_out:
            stream.send_blueprint(layout(result, history, BENCH_TIME, TABS[0]))


def _log(result: Calibration, history: History, stream: rr.RecordingStream, shown: int = 0) -> None:
    fresh = result.visits[shown:]
    if fresh:
        log_parameters(history.after(result.visits[:shown]), stream)
        log_platform(result, stream)
        log_innovations(fresh, stream, shown)
        log_nis(fresh, stream, shown)
        log_correlation(fresh, stream)
        log_bench(result, stream, shown)
    stream.log("summary", rr.TextDocument(printable(summary(result)), media_type=rr.MediaType.MARKDOWN), static=True)


@contextmanager
def _strict() -> Iterator[None]:
    """Mistakes in what is logged raise, rather than leave a hole in the view; the caller's mode is given back."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)
