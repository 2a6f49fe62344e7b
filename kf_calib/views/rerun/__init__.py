"""The Rerun view of what moves: a run in time, the residuals of explanations, the error falling from step to step.

A thin bridge: every number comes from the result, is scaled to a unit an engineer reads, and is sent in columns; Rerun
draws curves and axes. Angles are in arcsec, scale factors in ppm, biases and innovations in µg, or all in SI
(``support.units.shown_in``). Where the orientations so far do not determine a parameter there is no point.

A run has two timelines: ``orientation`` (the count of dwells from 1; 0 is a stated prior) and ``bench_time`` (since the
first sample; points within the dwells too). Entities: ``parameters/ACCELEROMETER/SYMBOL/{log10_sigma,log10_target,
deviation,band}``, ``parameters/effects/SYMBOL/...``, ``platform/...``, ``innovation/CHANNEL/{value,bound,in_sigma}``,
``nis/{value,above,band}``, ``residual/CHANNEL``, ``bench/pose/...``, ``summary``.
"""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.results import Calibration
from kf_calib.online.status import Judgement
from kf_calib.support.plain_text import printable
from kf_calib.views.rerun.ahead import log_next, words
from kf_calib.views.rerun.diagnosis import save_diagnosis_view as save_diagnosis
from kf_calib.views.rerun.improvement import save_improvement_view as save_improvement
from kf_calib.views.rerun.layout import layout
from kf_calib.views.rerun.names import BENCH_TIME, ORIENTATION, rrd_file, strict
from kf_calib.views.rerun.platform import log_platform
from kf_calib.views.rerun.series import (
    VisitHistory,
    log_bench,
    log_innovations,
    log_nis,
    log_parameters,
    log_residuals,
    predicted,
)
from kf_calib.views.rerun.summary import markdown_summary

__all__ = ["BENCH_TIME", "ORIENTATION", "grow", "save"]

_NO_TARGET = np.full(12, np.nan)


@singledispatch
def save_view(result: Any, path: str | Path) -> Path:
    """Write the view of a result to an .rrd file that opens laid out, and return its path.

    Raises InputError where the file cannot be written.
    """
    raise TypeError(f"there is no Rerun view of {type(result).__name__}: give the result of calibrate, diagnose or "
                    "improve; kf_calib.plot draws figures of the others.")  # fmt: skip


@save_view.register
def _(result: Calibration, path: str | Path) -> Path:
    history = VisitHistory.of(result)
    with rrd_file(Path(path), layout(result, history)) as stream:
        _log(result, history, stream)
        if not predicted(result):
            log_residuals(result, stream)
    return Path(path)


@save_view.register
def _(result: Diagnosis, path: str | Path) -> Path:
    return save_diagnosis(result, Path(path))


@save_view.register
def _(result: Improvement, path: str | Path) -> Path:
    return save_improvement(result, Path(path))


def grow(
    result: Calibration, stream: rr.RecordingStream, shown: int, lay_out: bool, judgement: Judgement | None = None
) -> None:
    """Send what a run shows beyond its first ``shown`` dwells, which were sent already, and the layout if asked to.

    A dwell stays in the curves as it was known when it was sent; platform and page of text are made anew.
    judgement: of the run so far, for its targets, its verdict and the next orientation.
    """
    with strict():
        history = VisitHistory.of(result)
        target = _NO_TARGET if judgement is None else judgement.wanted
        _log(result, history, stream, shown, "" if judgement is None else words(judgement), target)
        if judgement is not None:
            log_next(judgement, stream)
        if lay_out:
            stream.send_blueprint(layout(result, history, goes_on=True))


def _log(
    result: Calibration, history: VisitHistory, stream: rr.RecordingStream, shown: int = 0, heading: str = "",
    target: Floats = _NO_TARGET,
) -> None:  # fmt: skip
    """Send what a run shows beyond its first ``shown`` dwells; ``heading``: what stands above its page of text."""
    fresh = result.visits[shown:]
    if fresh:
        log_parameters(history.after(result.visits[:shown]), stream, target, shown > 0)
        log_platform(result, stream)
        log_innovations(fresh, stream, shown)
        log_nis(fresh, stream, shown)
        log_bench(result, stream, shown)
    text = "\n\n".join([*([heading] if heading else []), markdown_summary(result)])
    stream.log("summary", rr.TextDocument(printable(text), media_type=rr.MediaType.MARKDOWN), static=True)
