"""When a run began, which dates what is calibrated by it, however much later it is evaluated."""

from __future__ import annotations

from datetime import datetime

from kf_calib.bench.streams import Source
from kf_calib.support import dates


def run_date(source: Source) -> datetime | None:
    """When the run of a source began; None where nothing tells.

    As its bench states it (``date``), by the stamp of its first reading, or, where stamps count from the start of the
    board's clock, by the clock of the computer that received it.
    """
    stated = source.bench.notes.get("date")
    if stated is not None:
        return dates.parse_date(stated)
    begin_ns = getattr(source, "begin_ns", None)
    return dates.of_stamp(begin_ns() if begin_ns else None) or getattr(source, "received", None)
