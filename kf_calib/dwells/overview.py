"""The dwells of a run, found before any of its readings is evaluated."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.dwells.rest_in_readings import segmenter_of
from kf_calib.dwells.segmenter import dwell_blocks
from kf_calib.dwells.stationarity import Stillness


@dataclass
class DwellSummary:
    """A dwell in a few numbers.

    - arrival_s: its arrival, since the first sample; lasts_s: how long its readings last.
    - pose: mean gimbal angles in rad, outer to inner, or attitude; empty without angles.
    - norm_mps2: length of the mean of its readings; up (3,): the unit vector along that mean.
    """

    number: int
    arrival_s: float
    lasts_s: float
    readings: int
    pose: tuple[float, ...]
    norm_mps2: float
    up: tuple[float, float, float]


def dwell_summaries(
    source: Source, stillness: Stillness | None = None, on_progress: Callable[[float], None] = lambda _: None
) -> list[DwellSummary]:
    """The dwells of a source, which is read to its end; raises what reading it raises."""
    dwells, totals = dict[int, DwellSummary](), dict[int, Floats]()
    segmenter = segmenter_of(source.bench, stillness)
    for block in dwell_blocks(source, segmenter):
        on_progress(source.fraction)
        if not len(block.elapsed_s) or block.curve is not None:
            continue
        pose = tuple(float(each) for each in np.asarray(block.pose)[0]) if source.bench.angles else ()
        new = DwellSummary(block.dwell, block.arrival_s, 0.0, 0, pose, math.nan, (0.0, 0.0, 0.0))
        dwell = dwells.setdefault(block.dwell, new)
        dwell.readings += len(block.elapsed_s)
        dwell.lasts_s = float(block.elapsed_s[-1]) - dwell.arrival_s
        totals[block.dwell] = totals.get(block.dwell, np.zeros(3)) + block.accel_mps2.sum(axis=0)
    for number, dwell in dwells.items():
        mean = totals[number] / dwell.readings
        dwell.norm_mps2 = float(np.linalg.norm(mean))
        x, y, z = (mean / max(dwell.norm_mps2, 1e-300)).tolist()
        dwell.up = x, y, z
    return list(dwells.values())
