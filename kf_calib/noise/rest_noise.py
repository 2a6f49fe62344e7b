"""The noise of sensors at rest: Allan deviation, and sizes of its four terms with intervals, a channel at a time.

    noise = noise_at_rest(kf_calib.open_log("rest.csv", angles=False))
    noise.channels[0].terms["white"].value     # m/s^2/√Hz

A rest of any length, or the dwells of a recording that moves: rests are found in the readings, and no difference is
taken over a motion or a gap. Readings pass by once, in flat memory (``block_differences``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, Times
from kf_calib.bench.streams import LAST_NS, SECOND_NS, Source, Table
from kf_calib.dwells.blocks import BLOCK_SAMPLES, Block, SampleCounts
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.rest_in_readings import RestSegmenter
from kf_calib.dwells.stationarity import Stillness
from kf_calib.dwells.sufficient_statistics import LAGS
from kf_calib.errors import InputError
from kf_calib.noise.block_differences import FEWEST_CLUSTERS, BlockDifferences
from kf_calib.noise.power_laws import (
    POWERS,
    TERMS,
    allan_covariance,
    allan_variance,
    block_spectrum,
    cosine_transform,
    haar_freedom,
    histogram,
)
from kf_calib.noise.term_fit import AllanFit, LikelihoodFit, Minimum, Size, minimum, sizes
from kf_calib.support.tail_probabilities import LEVEL, SIGMAS_95, chi_squared_tail

_GAP = 1.5  # times the usual time between stamps, of which nine in ten are no longer
_WHOLE = 0.05  # by how much a difference of readings may be off a whole number of steps
_COARSE = math.sqrt(3.0)  # steps of readings over their sigma, from which rounding is no longer white and small

SizesOfTerms = Mapping[str, Size]


@dataclass(frozen=True, eq=False)
class ChannelNoise:
    """The noise of a channel; all in ``unit`` and s.

    - tau_s (m,), deviation (m,), low (m,), high (m,): overlapping Allan deviation of clusters, and its 95 % interval.
    - terms: sizes by the likelihood; by_allan: by least squares of the Allan variances. None where ``why_not`` has why.
    - from_s: the shortest clusters that the terms describe; shorter ones are not in the fits.
    - p_value: of the misfit of the Allan variances from there on. inflation: of the variances of all estimates for it.
    - squares (4,): of the terms that are needed to explain the data, 0 of the others.
    - unclear: terms of which some are there, but any one of which may be another one; they have no value.
    - step: smallest difference between readings where all are multiples of it; 0 where they are not.
    - reading_sigma: Allan deviation of neighbours, the sigma of a single reading where readings are independent.
    """

    name: str
    unit: str
    period_s: float
    tau_s: Floats
    deviation: Floats
    low: Floats
    high: Floats
    terms: SizesOfTerms = field(default_factory=dict[str, Size])
    by_allan: SizesOfTerms = field(default_factory=dict[str, Size])
    from_s: float = math.nan
    p_value: float = math.nan
    inflation: float = 1.0
    squares: Floats = field(default_factory=lambda: np.zeros(len(TERMS)))
    unclear: tuple[str, ...] = ()
    step: float = 0.0
    why_not: str = ""

    @property
    def reading_sigma(self) -> float:
        return float(self.deviation[0]) if len(self.deviation) else math.nan

    @property
    def is_coarse(self) -> bool:
        """Whether the noise of a reading is so much smaller than a step that rounding hides it."""
        return self.step > _COARSE * self.reading_sigma

    def model(self, tau_s: Floats) -> Floats:
        """Allan deviation (m,) of the terms that are needed, together."""
        return np.sqrt(allan_variance(tau_s) @ self.squares)


@dataclass(frozen=True, eq=False)
class RestNoise:
    """The noise of a recording's channels at rest.

    - readings: of the accelerometers at rest that were used, in so many ``stretches`` without a gap, of which the
      longest lasts ``longest_s``, all together ``rest_s``. gaps: within rests.
    - moving, settling: readings left out since it moved, or had just arrived or was about to leave; unusable: those
      that are no numbers, or whose stamps cannot be.
    - warnings: sentences.
    """

    channels: tuple[ChannelNoise, ...]
    rate_hz: float
    readings: int
    stretches: int
    gaps: int
    rest_s: float
    longest_s: float
    moving: int
    settling: int
    unusable: int
    warnings: tuple[str, ...] = ()

    def of_unit(self, unit: str) -> tuple[ChannelNoise, ...]:
        """The channels in a unit: those of the accelerometers, the gyroscopes or the thermometer."""
        return tuple(channel for channel in self.channels if channel.unit == unit)


class ChannelGroup:
    """Channels that are sampled together, as their readings come: their statistics, period and gaps.

    A gap is a step of the stamps of more than ``_GAP`` times what nine in ten of the first ones have at most.
    """

    def __init__(self, names: Sequence[str], unit: str) -> None:
        self.names, self.unit = tuple(names), unit
        self.differences = BlockDifferences(len(self.names))
        self.gaps, self.longest_s, self.total_s = 0, 0.0, 0.0
        self._last_s, self._begin_s = math.nan, math.nan
        self._most_s = math.inf
        self._first = list[Floats]()
        self._first_count = 0

    @property
    def period_s(self) -> float:
        """Mean time from reading to reading within stretches."""
        steps = self.differences.count - len(self.differences.lengths)
        return self.total_s / steps if steps else math.nan

    def push(self, elapsed_s: Floats, values: Floats) -> None:
        """Take readings (n, c) at times (n,) that follow those before, or begin a rest."""
        if not len(values):
            return
        if not math.isfinite(self._most_s) and len(elapsed_s) > FEWEST_READINGS:
            self._most_s = _GAP * float(np.quantile(np.diff(elapsed_s), 0.9))
        if self._first_count < BLOCK_SAMPLES:
            self._first.append(values[: BLOCK_SAMPLES - self._first_count].copy())
            self._first_count += len(self._first[-1])
        steps_s = np.diff(elapsed_s, prepend=self._last_s if math.isfinite(self._last_s) else elapsed_s[0])
        breaks = np.flatnonzero(steps_s > self._most_s).tolist()
        self.gaps += len(breaks)
        for begin, end in zip([0, *breaks], [*breaks, len(values)], strict=True):
            if begin in breaks:
                self._end_stretch()
            if begin < end:
                self._extend(elapsed_s[begin:end], values[begin:end])

    def _extend(self, elapsed_s: Floats, values: Floats) -> None:
        if not math.isfinite(self._begin_s):
            self._begin_s = float(elapsed_s[0])
        self._last_s = float(elapsed_s[-1])
        self.differences.push(values)

    def end_rest(self) -> None:
        """What comes next does not follow on what came."""
        self._end_stretch()

    def _end_stretch(self) -> None:
        if math.isfinite(self._begin_s):
            lasts_s = self._last_s - self._begin_s
            self.total_s, self.longest_s = self.total_s + lasts_s, max(self.longest_s, lasts_s)
        self._last_s = self._begin_s = math.nan
        self.differences.end_stretch()

    def step(self, channel: int) -> float:
        """Smallest difference of a channel's first readings, where all others are multiples of it; else 0."""
        values = np.concatenate([each[:, channel] for each in self._first]) if self._first else np.zeros(0)
        levels = np.unique(values)
        if len(levels) < 2:
            return 0.0
        smallest = float(np.diff(levels).min())
        multiples = np.diff(levels) / smallest
        is_whole = bool((np.abs(multiples - np.round(multiples)) < _WHOLE).all())
        return smallest if is_whole and len(levels) < len(values) / 4 else 0.0

    def noise(self) -> list[ChannelNoise]:
        """The noise of each channel."""
        return [channel_noise(self, channel) for channel in range(len(self.names))]


def channel_noise(group: ChannelGroup, channel: int) -> ChannelNoise:
    """The noise of one channel of a group."""
    period_s, allan = group.period_s, group.differences.allan()
    longest = max(group.differences.lengths, default=0)
    usable = allan.sizes * FEWEST_CLUSTERS <= longest
    variances, cluster_sizes = allan.variance[usable, channel], allan.sizes[usable]
    tau_s = period_s * cluster_sizes
    nothing = np.zeros(0)
    bare = ChannelNoise(group.names[channel], group.unit, period_s, nothing, nothing, nothing, nothing)
    if group.differences.count < LAGS or len(tau_s) < len(TERMS):
        return replace(bare, why_not="too few readings at rest follow each other without a gap")
    if not (variances > 0.0).all():
        return replace(bare, why_not="its readings do not change", tau_s=tau_s, deviation=np.sqrt(variances),
                       low=np.full(len(tau_s), np.nan), high=np.full(len(tau_s), np.nan))  # fmt: skip
    return _fitted(replace(bare, step=group.step(channel)), group.differences, channel, variances, cluster_sizes)


@dataclass(frozen=True, eq=False)
class _AllanOutcome:
    """A fit of the Allan variances from one size of clusters on; covariance (m, m): of all variances under it."""

    first: int
    objective: AllanFit
    best: Minimum
    p_value: float
    freedom: int
    covariance: Floats

    @property
    def inflation(self) -> float:
        """By how much the misfit is larger than by chance; 1 where chance explains it."""
        return 1.0 if self.p_value >= LEVEL else max(1.0, self.best.value / max(self.freedom, 1))


def _fitted(
    bare: ChannelNoise, differences: BlockDifferences, channel: int, variances: Floats, cluster_sizes: Ints
) -> ChannelNoise:
    """Both fits of a channel, from the shortest clusters on that the terms describe."""
    period_s, lengths = bare.period_s, histogram(differences.lengths)
    outcome = _fit_allan(variances, cluster_sizes, lengths, period_s)
    likelihood = _likelihood(differences, channel, period_s, int(cluster_sizes[outcome.first]), outcome.best.squares)
    by_likelihood = sizes(
        likelihood, minimum(likelihood, np.maximum(outcome.best.squares, likelihood.start())), outcome.inflation
    )
    by_allan = sizes(outcome.objective, outcome.best, outcome.inflation)
    expected = allan_variance(period_s * cluster_sizes.astype(float)) @ outcome.best.squares
    low, high = _deviation_interval(np.sqrt(variances), np.sqrt(np.diag(outcome.covariance)) / expected)
    unclear = tuple(TERMS[place] for place in by_likelihood.needed if by_likelihood.sizes[place].value is None)
    return replace(
        bare, tau_s=period_s * cluster_sizes, deviation=np.sqrt(variances), low=low, high=high,
        terms=dict(zip(TERMS, by_likelihood.sizes, strict=True)), unclear=unclear, squares=by_likelihood.squares,
        by_allan=dict(zip(TERMS, by_allan.sizes, strict=True)),
        from_s=float(period_s * cluster_sizes[outcome.first]), p_value=outcome.p_value, inflation=outcome.inflation,
    )  # fmt: skip


def _fit_allan(variances: Floats, cluster_sizes: Ints, lengths: Mapping[int, int], period_s: float) -> _AllanOutcome:
    """The fit that leaves out as few of the shortest clusters as it must to agree; where none does, the best one."""
    outcomes = list[_AllanOutcome]()
    for first in range(len(cluster_sizes) - len(TERMS) + 1):
        outcomes.append(_fit_allan_from(first, variances, cluster_sizes, lengths, period_s))
        if outcomes[-1].p_value >= LEVEL:
            return outcomes[-1]
    return max(outcomes, key=lambda outcome: outcome.p_value)


def _fit_allan_from(
    first: int, variances: Floats, cluster_sizes: Ints, lengths: Mapping[int, int], period_s: float
) -> _AllanOutcome:
    columns = allan_variance(period_s * cluster_sizes.astype(float))
    weight = np.diag(1.0 / cluster_sizes[first:].astype(float))
    objective = AllanFit(columns[first:], np.log(variances[first:]), weight)
    best, covariance = minimum(objective, objective.start()), np.zeros((0, 0))
    for _ in range(2):
        covariance = allan_covariance(cluster_sizes, lengths, period_s, best.squares)
        inner, model = covariance[first:, first:], columns[first:] @ best.squares
        objective = AllanFit.of(columns[first:], variances[first:], inner, model)
        best = minimum(objective, np.maximum(best.squares, 1e-3 * objective.start()))
    freedom = len(cluster_sizes) - first - int((best.squares > 0.0).sum())
    p_value = chi_squared_tail(freedom, best.value) if freedom > 0 else 1.0
    return _AllanOutcome(first, objective, best, p_value, freedom, covariance)


def _likelihood(
    differences: BlockDifferences, channel: int, period_s: float, shortest: int, squares: Floats
) -> LikelihoodFit:
    """The likelihood of a channel from clusters of ``shortest`` readings on; squares (4,): of the terms, nearly."""
    block, stretches = differences.block_means(shortest.bit_length() - 1)
    haar = differences.haar()
    fine = (haar.sizes >= shortest) & (haar.sizes < block) & (haar.variance[:, channel] > 0.0)
    tau_s = period_s * haar.sizes[fine].astype(float)
    rows = [allan_variance(tau_s)]
    squared, weights = [haar.variance[fine, channel]], [haar_freedom(tau_s, haar.counts[fine], squares)]
    for means in stretches:
        transformed = cosine_transform(means[:, channel])[1:]
        rows.append(block_spectrum(len(means)) * (period_s * block) ** POWERS)
        squared.append(transformed**2)
        weights.append(np.ones(len(transformed)))
    return LikelihoodFit(np.concatenate(rows), np.concatenate(squared), np.concatenate(weights))


def _deviation_interval(deviation: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """95 % interval of deviations whose variances have so large a relative sigma: chi-squared of 2 / spread^2 degrees
    of freedom, in the cube root of which it is nearly normal (Wilson and Hilferty)."""
    ninth = spread**2 / 9.0
    ends = [np.maximum(1.0 - ninth + sign * SIGMAS_95 * np.sqrt(ninth), 1e-2) ** 1.5 for sign in (1.0, -1.0)]
    return deviation / ends[0], deviation / ends[1]


ACCELEROMETERS, GYROSCOPES, THERMOMETER = ("1", "2", "3"), ("x", "y", "z"), ("temperature",)
"""Names of channels, as far as their units do not tell them apart."""


@dataclass
class _Rests:
    """When it rested: begin and end of each rest, s since the first reading, which came at ``first_ns``."""

    first_ns: int = 0
    begins_s: list[float] = field(default_factory=list[float])
    ends_s: list[float] = field(default_factory=list[float])

    def split(self, time_ns: Times) -> Iterator[tuple[slice, int]]:
        """The parts of stamps in ascending order that are in a rest, and the number of that."""
        begins_ns = np.round(np.array(self.begins_s) * SECOND_NS).astype(np.int64) + self.first_ns
        ends_ns = np.round(np.array(self.ends_s) * SECOND_NS).astype(np.int64) + self.first_ns
        first, last = np.searchsorted(ends_ns, time_ns[[0, -1]])
        for number in range(int(first), min(int(last) + 1, len(begins_ns))):
            begin = int(np.searchsorted(time_ns, begins_ns[number]))
            end = int(np.searchsorted(time_ns, ends_ns[number], side="right"))
            if begin < end:
                yield slice(begin, end), number


def noise_at_rest(
    source: Source, stillness: Stillness | None = None, *, gyroscopes: Source | None = None,
    with_temperature: bool = False, on_progress: Callable[[float], None] = lambda _: None,
) -> RestNoise:  # fmt: skip
    """The noise of a source's accelerometers at rest, and of what was recorded beside them.

    stillness: the margins that are left out about motions. gyroscopes: the same recording with angular rates, rad/s, in
    place of the readings. with_temperature: whether the thermometer is a channel, too, over the whole recording.
    Raises InputError where nothing rests, or the source has means only.
    """
    if isinstance(source, Table):
        source.refuse("their noise")
    accel, thermometer = ChannelGroup(ACCELEROMETERS, "m/s^2"), ChannelGroup(THERMOMETER, "K")
    counts, rests = SampleCounts(), _Rests()
    segmenter = RestSegmenter(source.bench, stillness or Stillness(), counts)
    latest = 0
    for block in _blocks(source, segmenter, thermometer if with_temperature else None):
        on_progress(source.fraction)
        if not len(block.elapsed_s):
            continue
        if block.dwell != latest:
            accel.end_rest()
            rests.begins_s.append(float(block.elapsed_s[0]))
            rests.ends_s.append(0.0)
            latest = block.dwell
        rests.ends_s[-1] = float(block.elapsed_s[-1])
        accel.push(block.elapsed_s, block.accel_mps2)
    accel.end_rest()
    thermometer.end_rest()
    if not accel.differences.count:
        raise InputError("it never stands still for a second: noise is told from readings at rest.")
    groups = [accel]
    if gyroscopes is not None:
        rests.first_ns = segmenter.first_ns or 0
        groups.append(_rates(gyroscopes, rests))
    if with_temperature:
        groups.append(thermometer)
    channels = tuple(channel for group in groups for channel in group.noise())
    return RestNoise(
        channels, 1.0 / accel.period_s, accel.differences.count, len(accel.differences.lengths), accel.gaps,
        accel.total_s, accel.longest_s, counts.moving, counts.settling,
        counts.not_finite + counts.too_large + counts.repeated + counts.backward + counts.leaping,
        tuple(source.warnings),
    )  # fmt: skip


def _blocks(source: Source, segmenter: RestSegmenter, thermometer: ChannelGroup | None) -> Iterator[Block]:
    """The blocks of all rests; temperatures go to the thermometer as they pass by."""
    first_ns, last_ns = None, -LAST_NS
    for batch in source:
        stream = batch.temperature
        if thermometer is not None and len(stream):
            first_ns = int(stream.time_ns[0]) if first_ns is None else first_ns
            later = np.diff(stream.time_ns, prepend=last_ns) > 0
            last_ns = max(last_ns, int(stream.time_ns.max()))
            kept = stream[later & np.isfinite(stream.values[:, 0])]
            thermometer.push((kept.time_ns - first_ns) / SECOND_NS, kept.values)
        yield from segmenter.push(batch)
    yield from segmenter.finish()


def _rates(source: Source, rests: _Rests) -> ChannelGroup:
    """The gyroscopes of a recording in the same rests."""
    group, latest = ChannelGroup(GYROSCOPES, "rad/s"), -1
    for batch in source:
        stream = batch.accel[np.asarray(np.isfinite(batch.accel.values).all(axis=1))]
        if not len(stream) or not rests.begins_s:
            continue
        for part, number in rests.split(stream.time_ns):
            if number != latest:
                group.end_rest()
                latest = number
            group.push((stream.time_ns[part] - rests.first_ns) / SECOND_NS, stream.values[part])
    group.end_rest()
    return group
