"""One pass over a source, which folds its readings into dwells.

A model with an oscillation needs another pass, which folds the dwells on a carrier near the frequency of the
oscillation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import lengths
from kf_calib.bench.bench import Bench
from kf_calib.bench.counts import refuse_unread
from kf_calib.bench.raw_input import LEVELS, wrong_unit
from kf_calib.bench.streams import Source, Table
from kf_calib.dwells import window_average
from kf_calib.dwells.blocks import LARGEST, Block, SampleCounts
from kf_calib.dwells.folding import Folder, dwells_of_table, rows_of_table
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.line_spectrum import SpectralLine
from kf_calib.dwells.rest_in_readings import segmenter_of
from kf_calib.dwells.rows import Rows, model_rows
from kf_calib.dwells.segmenter import Segmenter, dwell_blocks
from kf_calib.dwells.sufficient_statistics import lines_of
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import InputError
from kf_calib.estimation import setup_blunders
from kf_calib.estimation.dwell_columns import without_known
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import consistency
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.signal_quality import ReadingsMonitor
from kf_calib.support import stage

_CARRIERS = 3  # largest number of passes in search of a carrier
_CYCLES = 50.0  # cycles per dwell; a line below may be the remainder of a slow oscillation
_SLOW, _LEFT = 0.3, 1e-3  # cycles per dwell; of a slower oscillation a parabola leaves less than this of the power
_APART = 3.0  # cycles per dwell between a slow oscillation and the strongest line that it leaves, at most
_NEAR = 0.06  # cycles by which oscillation and carrier may differ in a piece; a parabola then leaves 1e-3 of it


@dataclass
class Pass:
    """One pass over a source, with the counts and observations made on the way and the dwells folded so far."""

    source: Source
    settings: Settings
    counts: SampleCounts = field(default_factory=SampleCounts)
    folder: Folder = field(default_factory=Folder)
    watch: ReadingsMonitor = field(default_factory=ReadingsMonitor)
    tabulated: DwellTable | None = None
    """The dwells of a table, which are taken as they are; None for a source of readings."""

    @cached_property
    def model(self) -> Model:
        """The model with the effects that the settings name."""
        return Model.of(self.source.bench, self.settings.effects, self.settings.bench_model)

    def segmenter(self) -> Segmenter:
        """The segmenter for this source, which also returns slews if the model has effects that show in slews only."""
        return segmenter_of(self.source.bench, self.settings.stillness, self.counts, bool(self.model.dynamic))

    def rows(self) -> Iterator[Rows]:
        """Rows of all blocks of the source; of a table, with every reading at its mean."""
        if isinstance(self.source, Table):
            return rows_of_table(self.source.orientations, self.source.bench)
        return self.rows_of(dwell_blocks(self.source, self.segmenter()))

    def rows_of(self, blocks: Iterable[Block]) -> Iterator[Rows]:
        """Rows of the given blocks, averaged over windows if the settings or the model's effects require it."""
        usual_s = window_average.WINDOW_S if self.model.averages else 0.0
        window_s = 0.0 if self.model.oscillates else self.settings.window_s or usual_s
        return model_rows(blocks, self.source.bench, self.counts, self.settings.gate_sigma, window_s)

    def add(self, rows: Rows) -> None:
        """Fold the rows of one block and record what they show."""
        self.folder.add(rows)
        self.watch.add(rows.raw or rows)

    def fold(self, on_progress: Callable[[float], None] | None = None) -> DwellTable:
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
        self.tabulated = dwells_of_table(table.orientations, table.bench)
        read = int(table.orientations.counts.sum())
        self.counts.read, self.counts.used, self.counts.poses = read, read, len(table.orientations)

    @property
    def folded(self) -> DwellTable:
        """All dwells so far, usable or not."""
        return DwellTable.of(self.folder.dwells) if self.tabulated is None else self.tabulated

    @property
    def dwells(self) -> DwellTable:
        """The usable dwells so far: not left out by the settings and, but for those of a table, of at least 8 readings,
        since fewer do not show their own noise. Known errors of the bench are subtracted from their readings."""
        dwells, left_out = self.folded, self.settings.left_out
        least = FEWEST_READINGS if self.tabulated is None else 1
        unused = (dwells.folded.counts < least) | np.isin(dwells.folded.numbers, left_out)
        if left_out:
            dwells = dwells.without(np.flatnonzero(unused).tolist())
        elif unused.any():
            dwells = dwells.take(np.flatnonzero(~unused))
        return without_known(dwells, self.model)


def refuse_unusable(dwells: DwellTable, counts: SampleCounts, bench: Bench) -> None:
    """Raise InputError if there is nothing to calibrate from or if the readings are not in m/s^2, and BlunderError for
    a set-up that cannot be right."""
    if not counts.read:
        raise InputError("the recording holds no accelerometer readings: check that the logger wrote any.")
    if not bench.angles:
        _refuse_restless(dwells, counts)
    elif counts.poses_dropped and not counts.poses:
        raise InputError(
            f"none of the {counts.poses_dropped} angle messages can be used: they are not finite, beyond "
            f"{LARGEST:.0e} rad (counts of an encoder?) or no unit quaternions; record angles in rad or deg, or "
            "unit quaternions."
        )
    elif not counts.poses:
        raise InputError(
            "the recording holds no platform angles (or attitude), so the direction of gravity is not known: "
            "record them on /platform/angles, at any rate."
        )
    elif not dwells:
        turns = counts.farthest_rad / (2.0 * math.pi)
        unit = f"; angles of up to {turns:.0f} turns look like degrees (--angle-unit deg)" if turns > 3.0 else ""
        raise InputError(
            f"no dwell was found in {counts.read} readings ({counts.moving} moving, {counts.settling} settling, "
            f"{counts.not_finite} not finite, {counts.too_large} too large, {counts.without_pose} without an angle): "
            + (counts.restless or "the platform must stand still; if it did, raise --still-deg or lower --settle-s")
            + f"{unit}."
        )
    means_mps2 = dwells.means[:, 4:]
    if not means_mps2.any():
        raise InputError("all readings are zero: check that this is the accelerometer, and that it is on.")
    still = not np.ptp(means_mps2, axis=0).any() and not dwells.folded.squares.any()
    if still and dwells.folded.counts.sum() >= FEWEST_READINGS * len(dwells):
        raise InputError(
            "the readings never change, not even by noise: the sensor or what logs it has stopped, or a channel is at "
            "the end of its range."
        )
    refuse_unread(bench.input.raw(means_mps2), bench.input.counts)
    level = float(np.median(lengths(means_mps2))) / bench.gravity_mps2
    if LEVELS[0] <= level <= LEVELS[1]:
        if bench.angles:
            setup_blunders.refuse(dwells, bench)
        return
    raise InputError(f"{wrong_unit(level, bench.input, bench.gravity_mps2).sentence}.")


def _refuse_restless(dwells: DwellTable, counts: SampleCounts) -> None:
    """Raise InputError if no dwell shows in the readings themselves."""
    if not dwells:
        raise InputError(
            f"no dwell was found in {counts.read} readings ({counts.moving} moving, {counts.settling} settling, "
            f"{counts.not_finite} not finite, {counts.too_large} too large): "
            + (
                counts.restless
                or "it never lay still: without angles it must, for at least a second and a half on each "
                "side; if it did, raise --still-deg or lower --settle-s"
            )
            + "."
        )


def on_carrier(
    passed: Pass, dwells: DwellTable, plain: Fit | None, on_progress: Callable[[float], None] | None
) -> tuple[Pass, Fit]:
    """The source folded again on a carrier near the frequency of the model's oscillation, and the fit to it.

    The first carrier is the strongest line in the spectrum; if there is none, the oscillation is slow and is fitted to
    the plain dwells. A line of only a few cycles per dwell may be the remainder of a slow oscillation after the
    parabola was removed; where that could leave it, both are tried and the more likely one is taken.
    """
    lines = lines_of(dwells)
    if not lines:
        plain = plain or fitted_to(passed, dwells)
        return (passed, plain) if holds_its_oscillation(plain) else _nearer(passed, plain, on_progress)
    counts, lengths_s = dwells.folded.counts, np.diff(dwells.folded.ends_s)[:, 0]
    shortest_s = float(lengths_s[counts > counts[0] // 2].min())
    on_carriers = [_nearer(passed, lines[0].frequency_hz, on_progress)]
    if lines[0].frequency_hz * shortest_s < _CYCLES:
        slow = plain or fitted_to(passed, dwells)
        if _may_leave(slow, lines[0]):
            on_carriers.append(_nearer(passed, slow, on_progress))
    return min(on_carriers, key=lambda each: _unlikeliness(each[1]))


def _may_leave(slow: Fit, line: SpectralLine) -> bool:
    """Tell whether a fitted oscillation may leave this line beside a parabola over each dwell.

    What is left is near it, or at one to two cycles a dwell. Otherwise the fit is no more than a drift that the
    oscillation mimics; less than half a cycle a run is no oscillation.
    """
    dwells, effect = slow.dwells, slow.linearised.model.oscillation
    assert effect is not None
    apart = abs(line.frequency_hz - effect.value) * float(np.diff(dwells.folded.ends_s).max())
    if apart > _APART or effect.value * float(np.ptp(dwells.folded.ends_s)) < 0.5:
        return False
    part = slow.linearised.model.parts[str(effect)]
    amplitude = float(np.linalg.norm(slow.state[part][: len(effect.coefficients)]))
    seen = float(np.linalg.norm(line.amplitude_mps2))
    return _cycles(slow) >= _SLOW or amplitude**2 * _LEFT > seen**2


def _unlikeliness(fitted: Fit) -> float:
    """Return -2 ln of the likelihood of the noise within dwells and of the misfit, up to a constant."""
    sigma, count = fitted.noise.effective_sigma_mps2, float(fitted.dwells.folded.counts.sum())
    return 2.0 * count * float(np.log(sigma).sum()) + consistency(fitted).statistic


def holds_its_oscillation(fitted: Fit) -> bool:
    """Tell whether the dwells are folded so that the model's oscillation, if it has one, can be fitted.

    They are if they are folded on a carrier, or if the oscillation is so slow that a parabola over a dwell describes it
    and its remainder shows no line.
    """
    dwells = fitted.dwells
    if not fitted.linearised.model.oscillates or dwells.folded.carrier_hz:
        return True
    return _cycles(fitted) < _SLOW and not lines_of(dwells)


def _nearer(passed: Pass, carrier: float | Fit, on_progress: Callable[[float], None] | None) -> tuple[Pass, Fit]:
    """Fold the source on a carrier, given in Hz or by the oscillation of a fit, until it is near the fitted
    oscillation."""
    carrier_hz = _oscillation_hz(carrier) if isinstance(carrier, Fit) else carrier
    for left in reversed(range(_CARRIERS)):
        stage.say(f"reading on a carrier of {carrier_hz:.3g} Hz")
        passed = Pass(passed.source, passed.settings, folder=Folder(carrier_hz))
        dwells = passed.fold(on_progress)
        fitted = fitted_to(passed, dwells)
        longest_s = float(np.diff(dwells.folded.pieces.spans_s).max())
        if not left or abs(_oscillation_hz(fitted) - carrier_hz) * longest_s < _NEAR:
            return passed, fitted
        carrier_hz = _oscillation_hz(fitted)
    raise AssertionError("unreachable: the last of the carriers is taken as it is")


def fitted_to(passed: Pass, dwells: DwellTable) -> Fit:
    """The fit of the settings' model to these dwells."""
    return fit(dwells, passed.model, passed.settings.walk_mps2_per_sqrt_s, passed.folder.slews)


def _cycles(fitted: Fit) -> float:
    """Return the cycles of the model's oscillation in the longest dwell."""
    return _oscillation_hz(fitted) * float(np.diff(fitted.dwells.folded.ends_s).max())


def _oscillation_hz(fitted: Fit) -> float:
    """Return the frequency of the model's oscillation."""
    effect = fitted.linearised.model.oscillation
    assert effect is not None
    return effect.value
