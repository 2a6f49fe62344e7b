"""The Rerun view of a run: sigmas by orientation, the platform, innovations, correlations.

A thin bridge: every number comes from the ``Calibration``, is scaled to a unit an engineer reads, and is sent in
columns. Two timelines: ``bench_time`` (since the first sample; points within the dwells too) and ``orientation``
(the count of dwells from 1; 0 is a stated prior). Angles are in arcsec, scale factors in ppm, biases and innovations
in µg, or all in SI (``support.units.shown_in``). Where the orientations so far do not determine a parameter there is no
point.

Entities: ``parameters/ACCELEROMETER/SYMBOL/{sigma,deviation,band}``, ``parameters/effects/SYMBOL/...``, the charts
``sigmas``, ``each``, ``estimates``, ``fit`` and ``innovations``, ``platform/...``,
``innovation/CHANNEL/{value,bound,in_sigma}``, ``nis/{value,above,band}``, ``correlation/{picture,matrix,...}``,
``bench/pose/...``, ``summary``.
"""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path
from typing import Any

import rerun as rr

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.engine_comparison import Comparison
from kf_calib.estimation.results import Calibration
from kf_calib.fleet.overview import FleetOverview
from kf_calib.online.status import Judgement
from kf_calib.support.plain_text import printable
from kf_calib.views.rerun.ahead import log_next, words
from kf_calib.views.rerun.comparison import save as save_comparison
from kf_calib.views.rerun.correlation import log_correlation
from kf_calib.views.rerun.diagnosis import save as save_diagnosis
from kf_calib.views.rerun.estimates import log_estimates
from kf_calib.views.rerun.file import rrd_file, strict
from kf_calib.views.rerun.fleet import save as save_fleet
from kf_calib.views.rerun.improvement import save as save_improvement
from kf_calib.views.rerun.layout import TABS, layout
from kf_calib.views.rerun.names import BENCH_TIME, ORIENTATION
from kf_calib.views.rerun.platform import log_platform
from kf_calib.views.rerun.residuals import log_fit
from kf_calib.views.rerun.series import History, log_bench, log_innovations, log_nis, log_parameters
from kf_calib.views.rerun.sigmas import Falling
from kf_calib.views.rerun.summary import summary

__all__ = ["BENCH_TIME", "ORIENTATION", "TABS", "grow", "layout", "log", "save"]


@singledispatch
def save(result: Any, path: str | Path) -> Path:
    """Write the view of a result to an .rrd file that opens laid out, and return its path.

    Of a calibration, ``timeline`` (BENCH_TIME or ORIENTATION) and ``tab`` (which of TABS is in front) may be chosen.
    Raises InputError where the file cannot be written.
    """
    raise TypeError(f"there is no Rerun view of {type(result).__name__}: give the result of calibrate, diagnose, "
                    "improve, compare or the overview of a fleet.")  # fmt: skip


@save.register
def _(result: Calibration, path: str | Path, timeline: str = BENCH_TIME, tab: str = TABS[0]) -> Path:
    history = History.of(result)
    falling = Falling.of(result, history)
    with rrd_file(Path(path), layout(result, history, falling, timeline, tab)) as stream:
        _log(result, history, falling, stream)
    return Path(path)


@save.register
def _(result: Diagnosis, path: str | Path) -> Path:
    return save_diagnosis(result, Path(path))


@save.register
def _(result: Improvement, path: str | Path) -> Path:
    return save_improvement(result, Path(path))


@save.register
def _(result: Comparison, path: str | Path) -> Path:
    return save_comparison(result, Path(path))


@save.register
def _(result: FleetOverview, path: str | Path) -> Path:
    return save_fleet(result, Path(path))


def log(result: Calibration, stream: rr.RecordingStream) -> None:
    """Send everything a run showed to a recording stream: a file, or a viewer that is open."""
    with strict():
        history = History.of(result)
        _log(result, history, Falling.of(result, history), stream)


def grow(
    result: Calibration, stream: rr.RecordingStream, shown: int, lay_out: bool, judgement: Judgement | None = None
) -> None:
    """Send what a run shows beyond its first ``shown`` dwells, which were sent already, and the layout if asked to.

    A dwell stays in the curves as it was known when it was sent; platform, charts and the page of text are made anew.
    judgement: of the run so far, for its targets, its verdict and the next orientation.
    """
    with strict():
        history = History.of(result)
        falling = Falling.of(result, history, None if judgement is None else judgement.wanted)
        _log(result, history, falling, stream, shown, "" if judgement is None else words(judgement))
        if judgement is not None:
            log_next(judgement, stream)
        if lay_out:
            stream.send_blueprint(layout(result, history, falling, BENCH_TIME, TABS[0]))


def _log(
    result: Calibration, history: History, falling: Falling, stream: rr.RecordingStream, shown: int = 0, said: str = ""
) -> None:
    """Send what a run shows beyond its first ``shown`` dwells; ``said``: what stands above its page of text."""
    fresh = result.visits[shown:]
    if fresh:
        log_parameters(history.after(result.visits[:shown]), stream, shown > 0)
        falling.log(stream)
        log_estimates(history, stream)
        log_fit(result, stream)
        log_platform(result, stream)
        log_innovations(fresh, stream, shown)
        log_nis(fresh, stream, shown)
        log_correlation(fresh, history.shown, stream)
        log_bench(result, stream, shown)
    text = "\n\n".join([*([said] if said else []), summary(result)])
    stream.log("summary", rr.TextDocument(printable(text), media_type=rr.MediaType.MARKDOWN), static=True)
