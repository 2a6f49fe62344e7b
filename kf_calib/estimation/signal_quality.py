"""Defects of the readings that show independently of any model: quantisation, saturation and outliers.

Three defects that no column of a model describes are found from the values of each accelerometer.

  - *Quantisation*: all values lie on one grid, whose step is the greatest common divisor of the differences of values,
    up to rounding. A step q well below the noise s is harmless. The mean of a dwell is off by up to
    q/2 exp(-2 pi^2 s^2 / q^2), which averaging does not reduce; it matters if it is visible beside the mean's sigma.
  - *Saturation*: readings accumulate at the channel's largest or smallest value. If noise of sigma s leaves a share b
    of a dwell's n readings below a top step of width q, it should put n (1 - Phi(Phi^-1(b) + q/s)) readings above it;
    at the end of the range there are none.
  - *Outliers*: readings that the gate rejected. If they are spread at random over the run, their number in any sequence
    of dwells is binomial.

``ReadingsMonitor`` looks at each block as it passes and keeps a few numbers for each dwell; ``judged`` interprets them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats, Ints, Mask
from kf_calib.dwells.rows import Rows
from kf_calib.dwells.table import DwellTable, FoldedDwells
from kf_calib.noise.noise_model import Noise
from kf_calib.support.tail_probabilities import LEVEL, REST
from kf_calib.support.text import SHOWN
from kf_calib.support.units import shown

_SAMPLE = 256  # readings of a dwell whose values are compared; a step below a twentieth of the noise is not noticed
_VALUES = 32  # largest number of distinct values of a dwell that are kept
_ROUNDING = 2.0 * float(np.finfo(np.float32).eps), 8.0 * float(np.finfo(float).eps)  # of stored and computed values
_CROWDED = -math.log(ROUNDING)  # readings missing above a flat top, which noise alone practically never omits
_LOUD, _FEW = 10.0, 0.25  # times the noise of the run, and share of the dwells: of what disturbed single dwells
_COUNTABLE = 512  # if there are more dwells, neighbours are pooled


@dataclass(frozen=True)
class Quantisation:
    """The quantisation of a channel (1, 2, 3): its step, the noise, the largest error of a mean that it causes, and
    whether this matters."""

    channel: int
    step_mps2: float
    sigma_mps2: float
    mean_error_mps2: float
    matters: bool

    @property
    def rms_mps2(self) -> float:
        """Rms rounding error of a reading, step / sqrt(12)."""
        return self.step_mps2 / math.sqrt(12.0)

    def __str__(self) -> str:
        unit = shown("m/s^2")
        told = f"readings of accelerometer {self.channel} are whole multiples of {unit.text(self.step_mps2)}"
        rms, noise, error = (unit.text(x, 2) for x in (self.rms_mps2, self.sigma_mps2, self.mean_error_mps2))
        if not self.matters:
            return f"{told} (rms {rms}, within a noise of {noise}): harmless."
        return (
            f"{told}, too coarse for their noise of {noise}: the mean of a dwell can be off by {error}, and averaging "
            "does not help; it counts as scatter from dwell to dwell; record with a finer step."
        )


@dataclass(frozen=True)
class Saturation:
    """The saturation of a channel (1, 2, 3): the level, the share of its readings at it, and the numbers of the
    dwells."""

    channel: int
    level_mps2: float
    share: float
    dwells: tuple[int, ...]

    def __str__(self) -> str:
        return (
            f"readings of accelerometer {self.channel} are cut off at {self.level_mps2:.4g} m/s^2 in "
            f"{_dwells(self.dwells)}, {self.share:.2%} of its readings: its scale factor and bias are wrong by it; "
            "widen its range, or avoid these orientations."
        )


@dataclass(frozen=True)
class Outliers:
    """The readings rejected by the gate.

    - count, share: their number, and as a share of all readings.
    - by_channel: number by channel; a reading that is an outlier in two channels counts in both.
    - clustered_p: probability over the run that outliers spread at random are as dense in any sequence of dwells; None
      if there are none, if there is one dwell only, or if coarse steps or saturation cause some.
    - dwells: numbers of the dwells in the densest sequence.
    """

    count: int = 0
    share: float = 0.0
    by_channel: tuple[int, ...] = (0, 0, 0)
    clustered_p: float | None = None
    dwells: tuple[int, ...] = ()

    @property
    def clustered(self) -> bool:
        """Whether the outliers are significantly clustered."""
        return self.clustered_p is not None and self.clustered_p < LEVEL * REST

    def __str__(self) -> str:
        told = f"{self.count} outlying readings were rejected ({self.share:.2%}; accelerometers {self.by_channel})"
        if not self.clustered:
            return f"{told}, spread over the run as chance would."
        return (
            f"{told}, crowded in {_dwells(self.dwells)} (p = {self.clustered_p:.2g}): something disturbed the run "
            "there; look at these readings, or visit these orientations again."
        )


@dataclass(frozen=True)
class LoudDwells:
    """Dwells in which something disturbed the readings: ``numbers``, and by how many ``times`` the noise of the run, at
    most. They are few, and count by their own noise."""

    numbers: tuple[int, ...]
    times: float

    @classmethod
    def of(cls, numbers: Ints, weights: Floats) -> LoudDwells | None:
        """Those among dwells of these numbers (D,) and weights (D, 3); None where there are none, or many."""
        times = weights.min(axis=1) ** -0.5
        loud = times > _LOUD
        if not 0 < loud.sum() <= _FEW * len(loud):
            return None
        return cls(tuple(numbers[loud].tolist()), float(times.max()))

    def __str__(self) -> str:
        left_out, told = " ".join(f"--leave-out {number}" for number in self.numbers[:SHOWN]), _dwells(self.numbers)
        if len(self.numbers) == 1:
            return (
                f"in {told} the readings vary by {self.times:.2g} times the noise of the run: something disturbed it; "
                f"it counts by its own noise, or leave it out ({left_out})."
            )
        return (
            f"in {told} the readings vary by up to {self.times:.2g} times the noise of the run: something disturbed "
            f"them; they count by their own noise, or leave them out ({left_out})."
        )


@dataclass(frozen=True)
class Readings:
    """The defects that were found in a run."""

    quantisation: tuple[Quantisation, ...] = ()
    saturation: tuple[Saturation, ...] = ()
    outliers: Outliers = field(default_factory=Outliers)
    loud: LoudDwells | None = None

    @property
    def biasing(self) -> list[str]:
        """One sentence on each defect that biases the estimate."""
        return [*map(str, self.saturation), *(str(each) for each in self.quantisation if each.matters)]

    @property
    def scatter_mps2(self) -> float:
        """Sigma of the error of a dwell's mean by coarse steps, evenly distributed up to its largest; 0 for none."""
        return max((each.mean_error_mps2 for each in self.quantisation if each.matters), default=0.0) / math.sqrt(3.0)

    @property
    def warnings(self) -> list[str]:
        """One sentence on each defect that a user must know."""
        return self.biasing + self.disturbances

    @property
    def disturbances(self) -> list[str]:
        """One sentence on each kind of dwells that something disturbed."""
        return [str(self.outliers)] * self.outliers.clustered + ([str(self.loud)] if self.loud else [])

    @property
    def disturbed(self) -> set[int]:
        """The numbers of these dwells."""
        return ({*self.outliers.dwells} if self.outliers.clustered else set()) | (
            {*self.loud.numbers} if self.loud else set()
        )

    @property
    def findings(self) -> list[str]:
        """All findings, harmless or not, in a few words each."""
        outliers = self.outliers
        unit = shown("m/s^2")
        crowded = f", crowded in {_dwells(outliers.dwells)}" if outliers.clustered else ""
        return [
            *(
                f"saturation of accelerometer {each.channel} at {each.level_mps2:.4g} m/s^2 in {_dwells(each.dwells)}"
                for each in self.saturation
            ),
            *(
                f"quantisation of accelerometer {each.channel} in steps of {unit.text(each.step_mps2)} (rms "
                f"{unit.number(each.rms_mps2, 2)}, noise {unit.number(each.sigma_mps2, 2)}: "
                f"{'too coarse' if each.matters else 'harmless'})"
                for each in self.quantisation
            ),
            *([f"outliers, {outliers.count} ({outliers.share:.2%}){crowded}"] if outliers.count else []),
        ]


@dataclass
class _Seen:
    """The record that is kept of a dwell.

    - ends (6,): the largest value of each channel and of its negative; stuck (6,): number of readings at these values.
    - count: number of readings.
    - distinct (3,): number of distinct values in ``sampled`` readings; values: some of them, by channel.
    - rejected: number of rejected readings; gated (3,): number by channel.
    """

    number: int
    ends: Floats
    stuck: Floats
    count: int
    distinct: Floats
    sampled: int
    values: list[Floats]
    rejected: int = 0
    gated: Floats = field(default_factory=lambda: np.zeros(3))


class ReadingsMonitor:
    """Accumulates what the readings show, block by block; slews are ignored."""

    def __init__(self) -> None:
        self._dwells: dict[int, _Seen] = {}

    def add(self, rows: Rows) -> None:
        """Take in one block of rows."""
        if rows.moving:
            return
        seen = self._dwells.get(rows.dwell)
        if seen is None:
            seen = self._dwells[rows.dwell] = _first_seen(rows.dwell, rows.readings)
        _reach(seen, rows)
        seen.count += len(rows.readings)
        if rows.gated is not None:
            seen.rejected += rows.gated.shape[1]
            seen.gated = seen.gated + rows.gated.sum(axis=1)

    def judged(self, dwells: DwellTable, noise: Noise) -> Readings:
        """The defects of a run with these dwells and this noise; none where no readings were seen, as of a table."""
        if not self._dwells:
            return Readings()
        seen = [self._dwells[number] for number in dwells.folded.numbers.tolist()]
        steps = [_step(seen, channel) for channel in range(3)]
        # Of all readings alike: by weights, dwells that stay on one step would seem to be those without noise.
        levels = np.median(1.0 / dwells.folded.weights, axis=0) * noise.sigma_mps2**2
        grids = [_quantisation(i, q, levels[i], noise, seen) for i, q in enumerate(steps) if q is not None]
        grids = [each for each in grids if each.matters or each.step_mps2 > 8.0 * _storage(seen, each.channel - 1)]
        flat = tuple(_saturations(seen, steps, _spreads(dwells.folded), noise))
        outliers = _outliers(seen)
        if flat or any(each.matters for each in grids):  # the gate also rejects readings next to a flat top or a step
            outliers = replace(outliers, clustered_p=None, dwells=())
        return Readings(tuple(grids), flat, outliers, LoudDwells.of(dwells.folded.numbers, dwells.folded.weights))


def _first_seen(number: int, readings: Floats) -> _Seen:
    """Make the record of a dwell from its first block, with the distinct values in it."""
    sample = np.sort(readings[:: -(-len(readings) // _SAMPLE)].T)
    new = sample[:, 1:] != sample[:, :-1]
    distinct, size = 1.0 + new.sum(axis=1), sample.shape[1]
    values = [
        np.append(own[:1], own[1:][up])[:_VALUES] if few else own[:0]
        for own, up, few in zip(sample, new, distinct <= size / 2, strict=True)
    ]
    return _Seen(number, np.full(6, -np.inf), np.zeros(6), 0, distinct, size, values)


def _reach(seen: _Seen, rows: Rows) -> None:
    """Update the largest and smallest values of a dwell, and the number of readings at them, with a block."""
    channels = rows.innovation if rows.static else np.ascontiguousarray(rows.readings.T)
    places = channels.argmax(axis=1).tolist() + channels.argmin(axis=1).tolist()
    for side, place in enumerate(places):
        i = side % 3
        end = rows.readings[place, i] if side < 3 else -rows.readings[place, i]
        if end >= seen.ends[side]:
            stuck = np.count_nonzero(channels[i] == channels[i, place])
            seen.stuck[side] = stuck + (seen.stuck[side] if end == seen.ends[side] else 0.0)
            seen.ends[side] = end


def _spreads(folded: FoldedDwells) -> Floats:
    """Return the standard deviations (D, 3) of the readings within dwells."""
    spare = np.maximum(folded.counts - folded.width * folded.piece_numbers, 1.0)
    return np.sqrt(np.add.reduceat(folded.squares, folded.ends[:-1]) / spare[:, None])


def _storage(seen: Sequence[_Seen], channel: int) -> float:
    """Return the spacing of float32 at the channel's largest reading."""
    largest = max(float(np.abs(each.ends[channel::3]).max()) for each in seen)
    return float(np.spacing(np.float32(largest)))


def _repeating(seen: Sequence[_Seen], channel: int) -> Mask:
    """Return a mask (D,) of the dwells whose sampled readings have at most half as many distinct values."""
    return np.array([each.distinct[channel] <= each.sampled / 2 for each in seen])


def _step(seen: Sequence[_Seen], channel: int) -> float | None:
    """Return the step of the grid on which all readings of a channel lie; None if there is none."""
    if _repeating(seen, channel).mean() < 0.95:
        return None
    values = np.unique(np.concatenate([each.values[channel] for each in seen]))
    tolerances = np.abs(values).max() * np.array(_ROUNDING)
    return next(filter(None, (common_step(values, tolerance) for tolerance in tolerances.tolist())), None)


def common_step(values: Floats, tolerance: float) -> float | None:
    """The step q of a grid v0 + k q on which ``values`` (n,) lie, each to within ``tolerance``; None if there is none.

    It is found by Euclid's algorithm on at least three differences of neighbouring values, and is at least eight
    tolerances. Differences of so many steps that rounding makes their number uncertain are not used.
    """
    steps = np.diff(np.sort(values))
    steps = steps[steps > 2.0 * tolerance]
    if len(steps) < 3:
        return None
    step, error, known = float(steps.min()), 4.0 * tolerance, 0
    while step >= 8.0 * tolerance:
        certain = steps[steps <= max(1.5 * step, 0.1 * step**2 / error)]  # those whose number of steps is certain
        multiples = np.rint(certain / step)
        over, allowed = np.abs(certain - step * multiples), 2.0 * tolerance + error * multiples
        if (over > allowed).any():
            first = int(np.where(over > allowed, over, np.inf).argmin())
            step, error, known = float(over[first]), float(allowed[first]), 0
        elif len(certain) > known:  # a more precise step makes larger differences usable
            known, error = len(certain), 2.0 * tolerance * math.sqrt(len(certain)) / float(multiples.sum())
            step = float(certain.sum() / multiples.sum())
        else:
            return step if known >= 3 else None
    return None


def _quantisation(index: int, step: float, variance: float, noise: Noise, seen: Sequence[_Seen]) -> Quantisation:
    """Judge the quantisation of one channel whose readings have this variance."""
    dither = max(variance - step**2 / 12.0, 0.0)  # noise that spreads the readings over several steps
    error = 0.5 * step * math.exp(-2.0 * math.pi**2 * dither / step**2)
    count = float(np.median([each.count for each in seen]))
    seen_from = 0.5 * math.sqrt(variance * float(noise.inflation[index]) / count)
    sigma = math.sqrt(variance) if variance > _ROUNDING[1] * step**2 else 0.0
    return Quantisation(index + 1, step, sigma, error, error > seen_from)


def _saturations(
    seen: Sequence[_Seen], steps: Sequence[float | None], spreads: Floats, noise: Noise
) -> Iterator[Saturation]:
    """Yield the ends of a channel's range at which readings accumulate; ``spreads`` (D, 3) are the standard deviations
    within dwells."""
    ends, stuck = (np.array([getattr(each, key) for each in seen]) for key in ("ends", "stuck"))
    counts = np.array([each.count for each in seen], float)
    reached = ends == ends.max(axis=0)
    for side in range(6):
        i = side % 3
        inside = ~(reached[:, i] | reached[:, i + 3])  # dwells away from the ends, which show the noise
        step, sigma = steps[i], float(spreads[inside, i].min(initial=np.inf))
        if not (0.0 < sigma < np.inf) or (step is None and _repeating(seen, i)[inside].mean() > 0.5):
            continue
        width = max(step or 0.0, float(np.spacing(np.float32(ends[:, side].max()))))
        if width > 2.0 * sigma:
            continue  # a dwell may then have a single value at any level
        sigma, at = math.sqrt(sigma**2 - width**2 / 12.0), reached[:, side]
        if stuck[at, side].sum() <= _CROWDED * float(noise.correlation_length[i]):
            continue  # no more can be missing above a value than are at it
        missing = missing_above(stuck[:, side], counts, width / sigma) / float(noise.correlation_length[i])
        usual = float(np.median(missing[inside]))  # non-Gaussian noise has flat tops at every level
        if missing[at].sum() > _CROWDED and missing[at].mean() > 4.0 * usual:
            level = float(ends[at, side][0]) * (1.0 if side < 3 else -1.0)
            which = tuple(each.number for each, is_cut in zip(seen, at & (stuck[:, side] > 1), strict=True) if is_cut)
            yield Saturation(i + 1, level, float(stuck[at, side].sum() / counts.sum()), which)


def missing_above(stuck: Floats, counts: Floats, step_sigmas: float) -> Floats:
    """Number of readings (D,) that Gaussian noise would put above the top value of each dwell, from the number at that
    value."""
    from scipy.special import ndtr, ndtri

    below = np.clip(1.0 - stuck / counts, 0.5 / counts, None)
    return counts * ndtr(-(ndtri(below) + step_sigmas))


def _outliers(seen: Sequence[_Seen]) -> Outliers:
    """Return the outliers and where they cluster."""
    gated = np.array([each.rejected for each in seen], float)
    counts = np.array([each.count + each.rejected for each in seen], float)
    total = int(gated.sum())
    if not total:
        return Outliers()
    by_channel = tuple(np.sum([each.gated for each in seen], axis=0).astype(int).tolist())
    p_value, stretch = clustering(gated, counts)
    return Outliers(
        total, total / float(counts.sum()), by_channel, p_value, tuple(each.number for each in seen[stretch])
    )


def clustering(hits: Floats, counts: Floats) -> tuple[float | None, slice]:
    """The p-value over the run of the densest sequence of dwells for ``hits`` (D,) among ``counts`` (D,) readings, and
    that sequence.

    Given their sum, the hits in a sequence are binomial. Sequences of 1, 2, 4 ... dwells are tried, and the least tail
    probability is multiplied by their number (Bonferroni), so that the p-value is an upper bound.
    """
    from scipy.special import betainc

    size = -(-len(hits) // _COUNTABLE)
    starts = np.arange(0, len(hits), size)
    sums = [np.concatenate([[0.0], np.cumsum(np.add.reduceat(each, starts))]) for each in (hits, counts)]
    best, tried, stretch = 1.0, 0, (0, 0)
    length = 1
    while 2 * length <= len(starts):
        inside, share = (each[length:] - each[:-length] for each in sums)
        least = np.maximum(inside, 1.0)  # a binomial tail is an incomplete beta function
        tails = np.where(inside > 0, betainc(least, sums[0][-1] - least + 1.0, share / sums[1][-1]), 1.0)
        first, tried = int(tails.argmin()), tried + len(tails)
        if tails[first] < best:
            best, stretch = float(tails[first]), (first * size, min((first + length) * size, len(hits)))
        length *= 2
    if not tried:
        return None, slice(0, 0)
    return min(1.0, best * tried), slice(*stretch)


def _dwells(numbers: Sequence[int]) -> str:
    """Write ``dwell 2`` or ``3 dwells (2, 5, 9)``, with at most six numbers."""
    if len(numbers) == 1:
        return f"dwell {numbers[0]}"
    return f"{len(numbers)} dwells ({', '.join(map(str, numbers[:SHOWN]))}{' ...' * (len(numbers) > SHOWN)})"
