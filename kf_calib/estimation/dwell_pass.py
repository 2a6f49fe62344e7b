"""One pass over a source, which folds its readings into dwells."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import lengths
from kf_calib.bench.bench import Bench
from kf_calib.bench.raw_input import LEVELS, wrong_unit
from kf_calib.bench.streams import Source
from kf_calib.dwells import tabulated, window_average
from kf_calib.dwells.blocks import LARGEST_RAD, Block, Tally
from kf_calib.dwells.folding import Folder
from kf_calib.dwells.rest_in_readings import segmenter_of
from kf_calib.dwells.rows import Rows, model_rows
from kf_calib.dwells.segmenter import Segmenter, dwell_blocks
from kf_calib.dwells.stack import DwellStack
from kf_calib.dwells.sufficient_statistics import DwellFactor, dwells_without
from kf_calib.errors import InputError
from kf_calib.estimation import setup_blunders
from kf_calib.estimation.dwell_columns import without_known
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.signal_quality import ReadingsMonitor
from kf_calib.sources.tables.table import Table

LEAST_READINGS = 8
"""Of a dwell that is used: fewer do not show their own noise."""


@dataclass
class Pass:
    """One pass over a source, with the counts and observations made on the way and the dwells folded so far."""

    source: Source
    settings: Settings
    tally: Tally = field(default_factory=Tally)
    folder: Folder = field(default_factory=Folder)
    watch: ReadingsMonitor = field(default_factory=ReadingsMonitor)
    tabulated: DwellStack | None = None
    """The dwells of a table, which are taken as they are; None for a source of readings."""

    @cached_property
    def model(self) -> Model:
        """The model with the effects that the settings name."""
        return Model.of(self.source.bench, self.settings.effects, self.settings.bench_model)

    def segmenter(self) -> Segmenter:
        """The segmenter for this source, which also returns slews if the model has effects that show in slews only."""
        return segmenter_of(self.source.bench, self.settings.stillness, self.tally, bool(self.model.dynamic))

    def rows(self) -> Iterator[Rows]:
        """Rows of all blocks of the source; of a table, with every reading at its mean."""
        if isinstance(self.source, Table):
            return tabulated.rows_of(self.source.orientations, self.source.bench)
        return self.rows_of(dwell_blocks(self.source, self.segmenter()))

    def rows_of(self, blocks: Iterable[Block]) -> Iterator[Rows]:
        """Rows of the given blocks, averaged over windows if the settings or the model's effects require it."""
        usual_s = window_average.WINDOW_S if self.model.averages else 0.0
        window_s = 0.0 if self.model.oscillates else self.settings.window_s or usual_s
        return model_rows(blocks, self.source.bench, self.tally, self.settings.gate_sigma, window_s)

    def add(self, rows: Rows) -> None:
        """Fold the rows of one block and record what they show."""
        self.folder.add(rows)
        self.watch.add(rows.raw or rows)

    def fold(self, on_progress: Callable[[float], None] | None = None) -> Sequence[DwellFactor]:
        """Read the whole source and return its usable dwells."""
        if isinstance(self.source, Table):
            self._take(self.source)
            return self.dwells
        for rows in self.rows():
            self.add(rows)
            if on_progress is not None:
                on_progress(self.source.fraction)
        return self.dwells

    def _take(self, table: Table) -> None:
        """Take the dwells of a table as they are; raises InputError if the model needs more than their means."""
        if self.folder.carrier_hz or self.settings.window_s:
            table.refuse(" and ".join(map(str, self.model.effects)) or "an average over windows")
        self.tabulated = tabulated.dwells_of(table.orientations, table.bench)
        read = int(table.orientations.counts.sum())
        self.tally.read, self.tally.used, self.tally.poses = read, read, len(table.orientations)

    @property
    def folded(self) -> Sequence[DwellFactor]:
        """All dwells so far, usable or not."""
        return self.folder.dwells if self.tabulated is None else self.tabulated

    @property
    def dwells(self) -> Sequence[DwellFactor]:
        """The usable dwells so far: not left out by the settings and, but for those of a table, of at least 8 readings,
        since fewer do not show their own noise. Known errors of the bench are subtracted from their readings."""
        dwells, left_out = self.folded, self.settings.left_out
        if self.tabulated is not None and not left_out:
            return without_known(dwells, self.model)
        least = LEAST_READINGS if self.tabulated is None else 1
        unused = {k for k, each in enumerate(dwells) if each.count < least or each.number in left_out}
        used = [dwell for k, dwell in enumerate(dwells) if k not in unused]
        return without_known(dwells_without(dwells, unused) if left_out else used, self.model)


def refuse_unusable(dwells: Sequence[DwellFactor], tally: Tally, bench: Bench) -> None:
    """Raise InputError if there is nothing to calibrate from or if the readings are not in m/s^2, and BlunderError for
    a set-up that cannot be right."""
    if not tally.read:
        raise InputError("the recording holds no accelerometer readings: check that the logger wrote any.")
    if not bench.angles:
        _refuse_restless(dwells, tally)
    elif tally.poses_dropped and not tally.poses:
        raise InputError(
            f"none of the {tally.poses_dropped} angle messages can be used: they are not finite, beyond "
            f"{LARGEST_RAD:.0e} rad (counts of an encoder?) or no unit quaternions; record angles in rad or deg, or "
            "unit quaternions."
        )
    elif not tally.poses:
        raise InputError(
            "the recording holds no platform angles (or attitude), so the direction of gravity is not known: "
            "record them on /platform/angles, at any rate."
        )
    elif not dwells:
        turns = tally.farthest_rad / (2.0 * math.pi)
        unit = f"; angles of up to {turns:.0f} turns look like degrees (--angle-unit deg)" if turns > 3.0 else ""
        raise InputError(
            f"no dwell was found in {tally.read} readings ({tally.moving} moving, {tally.settling} settling, "
            f"{tally.not_finite} not finite, {tally.too_large} too large, {tally.without_pose} without an angle): the "
            f"platform must stand still; if it did, raise --still-deg or lower --settle-s{unit}."
        )
    level = float(np.median(lengths(DwellStack.of(dwells).means[:, 4:]))) / bench.gravity_mps2
    if LEVELS[0] <= level <= LEVELS[1]:
        if bench.angles:
            setup_blunders.refuse(dwells, bench)
        return
    raise InputError(f"{wrong_unit(level, bench.input, bench.gravity_mps2).sentence}.")


def _refuse_restless(dwells: Sequence[DwellFactor], tally: Tally) -> None:
    """Raise InputError if no dwell shows in the readings themselves."""
    if not dwells:
        raise InputError(
            f"no dwell was found in {tally.read} readings ({tally.moving} moving, {tally.settling} settling, "
            f"{tally.not_finite} not finite, {tally.too_large} too large): without angles it must lie still for at "
            "least a second and a half on each side; if it did, raise --still-deg or lower --settle-s."
        )
