"""What the readings themselves show, apart from any model: their step, flat tops, and where outliers lie.

Three defects that no column of a model stands for are found from the values of each accelerometer:

- *quantisation*: all values lie on one grid. Its step is the greatest common divisor of the differences of values,
  to rounding. A step q well below the noise s is harmless; the mean of a dwell is off by up to
  q/2 exp(-2 pi^2 s^2 / q^2), which averaging does not lessen: it matters where that is seen beside the mean's sigma.
- *saturation*: readings pile up at the channel's largest or smallest value. Noise of sigma s that leaves a share b of a
  dwell's n readings below a top step of width q would put n (1 - Phi(Phi^-1(b) + q/s)) readings above it; at the end of
  the range there are none.
- *outliers*: readings the gate rejected. Spread at random over the run, their number in any stretch of dwells is
  binomial.

``ReadingsMonitor`` looks at each block as it passes and keeps a few numbers a dwell; ``judged`` says what they mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.rows import Rows
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.noise_model import Noise

_SAMPLE = 256  # readings of a dwell whose values are compared; a step below a twentieth of the noise goes unnoticed
_VALUES = 32  # distinct values of a dwell that are kept
_ROUNDING = (2.0**-22, 2.0**-49)  # of the largest value: of float32 stored, of float64 computed
_CROWDED = 20.0  # readings missing above a flat top: noise leaves them out with probability e^-20
_CLUSTERED = 1e-3  # run-level p of outliers spread at random
_COUNTABLE = 512  # dwells at most whose stretches are all looked at; beyond, neighbours are taken together


@dataclass(frozen=True)
class Quantisation:
    """The step of a channel (1, 2, 3), its rms step/sqrt(12) beside the noise, and by how much it can move a mean."""

    channel: int
    step_mps2: float
    sigma_mps2: float
    mean_error_mps2: float
    matters: bool

    @property
    def rms_mps2(self) -> float:
        return self.step_mps2 / math.sqrt(12.0)

    def __str__(self) -> str:
        told = f"readings of accelerometer {self.channel} are whole multiples of {self.step_mps2:.3g} m/s^2"
        if not self.matters:
            return f"{told} (rms {self.rms_mps2:.2g}, within a noise of {self.sigma_mps2:.2g}): harmless."
        return (
            f"{told}, too coarse for their noise of {self.sigma_mps2:.2g}: the mean of a dwell can be off by "
            f"{self.mean_error_mps2:.2g} m/s^2, and averaging does not help; record with a finer step."
        )


@dataclass(frozen=True)
class Saturation:
    """A channel (1, 2, 3) cut off at a level: share of its readings stuck there, and the numbers of the dwells."""

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
    """Readings rejected by the gate; by_channel counts one twice where it lies out in two channels.

    clustered_p: run-level probability of so many in any stretch of dwells (whose numbers are ``dwells``) were they
    spread at random; None where there are none, or one dwell only, or where coarse steps or flat tops make some.
    """

    count: int = 0
    share: float = 0.0
    by_channel: tuple[int, ...] = (0, 0, 0)
    clustered_p: float | None = None
    dwells: tuple[int, ...] = ()

    @property
    def clustered(self) -> bool:
        return self.clustered_p is not None and self.clustered_p < _CLUSTERED

    def __str__(self) -> str:
        told = f"{self.count} outlying readings were rejected ({self.share:.2%}; accelerometers {self.by_channel})"
        if not self.clustered:
            return f"{told}, spread over the run as chance would."
        return (
            f"{told}, crowded in {_dwells(self.dwells)} (p = {self.clustered_p:.2g}): something disturbed the run "
            "there; look at these readings, or visit these orientations again."
        )


@dataclass(frozen=True)
class Readings:
    """What was found of a run."""

    quantisation: tuple[Quantisation, ...] = ()
    saturation: tuple[Saturation, ...] = ()
    outliers: Outliers = field(default_factory=Outliers)

    @property
    def biasing(self) -> list[str]:
        """What spoils the estimate, a sentence each."""
        return [*map(str, self.saturation), *(str(each) for each in self.quantisation if each.matters)]

    @property
    def warnings(self) -> list[str]:
        """What a user must know, a sentence each."""
        return self.biasing + [str(self.outliers)] * self.outliers.clustered

    @property
    def findings(self) -> list[str]:
        """All that was found, harmless or not, in a few words each."""
        out = self.outliers
        crowded = f", crowded in {_dwells(out.dwells)}" if out.clustered else ""
        return [
            *(
                f"saturation of accelerometer {each.channel} at {each.level_mps2:.4g} m/s^2 in {_dwells(each.dwells)}"
                for each in self.saturation
            ),
            *(
                f"quantisation of accelerometer {each.channel} in steps of {each.step_mps2:.3g} m/s^2 (rms "
                f"{each.rms_mps2:.2g}, noise {each.sigma_mps2:.2g}: {'too coarse' if each.matters else 'harmless'})"
                for each in self.quantisation
            ),
            *([f"outliers, {out.count} ({out.share:.2%}){crowded}"] if out.count else []),
        ]


@dataclass
class _Seen:
    """Of the dwell of that number.

    ends (6,): the largest of the three channels, and of their negatives; stuck (6,): readings there.
    distinct (3,): how many values ``sampled`` readings had; values: some of them, by channel. rejected: readings; out
    (3,): in which channel.
    """

    number: int
    ends: Floats
    stuck: Floats
    count: int
    distinct: Floats
    sampled: int
    values: list[Floats]
    rejected: int = 0
    out: Floats = field(default_factory=lambda: np.zeros(3))


class ReadingsMonitor:
    """Accumulates what the readings show, block by block; slews are passed over."""

    def __init__(self) -> None:
        self._dwells: dict[int, _Seen] = {}

    def add(self, rows: Rows) -> None:
        if rows.moving:
            return
        seen = self._dwells.get(rows.dwell)
        if seen is None:
            seen = self._dwells[rows.dwell] = _first_seen(rows.dwell, rows.readings)
        _reach(seen, rows)
        seen.count += len(rows.readings)
        if rows.gated is not None:
            seen.rejected += rows.gated.shape[1]
            seen.out = seen.out + rows.gated.sum(axis=1)

    def judged(self, dwells: Sequence[DwellFactor], noise: Noise) -> Readings:
        """What it means for a run of these dwells and this noise."""
        seen = [self._dwells[dwell.number] for dwell in dwells]
        steps = [_step(seen, channel) for channel in range(3)]
        grids = [_quantisation(i, q, noise, seen) for i, q in enumerate(steps) if q is not None]
        grids = [each for each in grids if each.matters or each.step_mps2 > 8.0 * _storage(seen, each.channel - 1)]
        flat = tuple(_saturations(seen, steps, np.array([_spread(dwell) for dwell in dwells]), noise))
        outliers = _outliers(seen)
        if flat or any(each.matters for each in grids):  # the gate takes what is off a flat top, or off by a step
            outliers = replace(outliers, clustered_p=None, dwells=())
        return Readings(tuple(grids), flat, outliers)


def _first_seen(number: int, readings: Floats) -> _Seen:
    """A dwell with what the values of its first block say of steps."""
    sample = np.sort(readings[:: -(-len(readings) // _SAMPLE)].T)
    new = sample[:, 1:] != sample[:, :-1]
    distinct, size = 1.0 + new.sum(axis=1), sample.shape[1]
    values = [
        np.append(own[:1], own[1:][up])[:_VALUES] if few else own[:0]
        for own, up, few in zip(sample, new, distinct <= size / 2, strict=True)
    ]
    return _Seen(number, np.full(6, -np.inf), np.zeros(6), 0, distinct, size, values)


def _reach(seen: _Seen, rows: Rows) -> None:
    """Takes in the ends of a block; readings there are counted only where the dwell has none farther out."""
    channels = rows.innovation if rows.static else np.ascontiguousarray(rows.readings.T)
    places = channels.argmax(axis=1).tolist() + channels.argmin(axis=1).tolist()
    for side, place in enumerate(places):
        i = side % 3
        end = rows.readings[place, i] if side < 3 else -rows.readings[place, i]
        if end >= seen.ends[side]:
            stuck = np.count_nonzero(channels[i] == channels[i, place])
            seen.stuck[side] = stuck + (seen.stuck[side] if end == seen.ends[side] else 0.0)
            seen.ends[side] = end


def _spread(dwell: DwellFactor) -> Floats:
    """Standard deviation of the readings within a dwell (3,)."""
    spare = dwell.count - dwell.width * len(dwell.pieces)
    return np.sqrt(dwell.squares.sum(axis=0) / max(spare, 1))


def _storage(seen: Sequence[_Seen], channel: int) -> float:
    """The step of float32 at the channel's largest reading."""
    largest = max(float(np.abs(each.ends[channel::3]).max()) for each in seen)
    return float(np.spacing(np.float32(largest)))


def _repeating(seen: Sequence[_Seen], channel: int) -> Mask:
    """Dwells (D,) whose values repeat: no more distinct ones than half the readings."""
    return np.array([each.distinct[channel] <= each.sampled / 2 for each in seen])


def _step(seen: Sequence[_Seen], channel: int) -> float | None:
    """The step of the grid on which all readings of a channel lie; None where there is none."""
    if _repeating(seen, channel).mean() < 0.95:
        return None
    values = np.unique(np.concatenate([each.values[channel] for each in seen]))
    tolerances = np.abs(values).max() * np.array(_ROUNDING)
    return next(filter(None, (common_step(values, tolerance) for tolerance in tolerances.tolist())), None)


def common_step(values: Floats, tolerance: float) -> float | None:
    """The step q of a grid v0 + k q that holds ``values`` (n,), each to within ``tolerance``; None: there is no such.

    Euclid's algorithm on the differences of neighbours, three of them or more; q is at least eight tolerances.
    Differences of so many steps that rounding hides their number say nothing.
    """
    steps = np.diff(np.sort(values))
    steps = steps[steps > 2.0 * tolerance]
    if len(steps) < 3:
        return None
    step, error, known = float(steps.min()), 4.0 * tolerance, 0
    while step >= 8.0 * tolerance:
        certain = steps[steps <= max(1.5 * step, 0.1 * step**2 / error)]  # those whose number of steps is known
        multiples = np.rint(certain / step)
        over, allowed = np.abs(certain - step * multiples), 2.0 * tolerance + error * multiples
        if (over > allowed).any():
            first = int(np.where(over > allowed, over, np.inf).argmin())
            step, error, known = float(over[first]), float(allowed[first]), 0
        elif len(certain) > known:  # the better the step is known, the larger differences count
            known, error = len(certain), 2.0 * tolerance * math.sqrt(len(certain)) / float(multiples.sum())
            step = float(certain.sum() / multiples.sum())
        else:
            return step if known >= 3 else None
    return None


def _quantisation(index: int, step: float, noise: Noise, seen: Sequence[_Seen]) -> Quantisation:
    variance = float(noise.sigma_mps2[index]) ** 2
    dither = max(variance - step**2 / 12.0, 0.0)  # what else there is to spread the readings over steps
    error = 0.5 * step * math.exp(-2.0 * math.pi**2 * dither / step**2)
    count = float(np.median([each.count for each in seen]))
    seen_from = 0.5 * math.sqrt(variance * float(noise.inflation[index]) / count)
    sigma = math.sqrt(variance) if variance > _ROUNDING[1] * step**2 else 0.0
    return Quantisation(index + 1, step, sigma, error, error > seen_from)


def _saturations(
    seen: Sequence[_Seen], steps: Sequence[float | None], spreads: Floats, noise: Noise
) -> Iterator[Saturation]:
    """The ends of a channel's range at which readings pile up; ``spreads`` (D, 3) within the dwells."""
    ends, stuck = (np.array([getattr(each, key) for each in seen]) for key in ("ends", "stuck"))
    counts = np.array([each.count for each in seen], float)
    reached = ends == ends.max(axis=0)
    for side in range(6):
        i = side % 3
        inside = ~(reached[:, i] | reached[:, i + 3])  # dwells that show the noise where nothing can be cut off
        step, sigma = steps[i], float(spreads[inside, i].min(initial=np.inf))
        if not (0.0 < sigma < np.inf) or (step is None and _repeating(seen, i)[inside].mean() > 0.5):
            continue
        width = max(step or 0.0, float(np.spacing(np.float32(ends[:, side].max()))))
        if width > 2.0 * sigma:
            continue  # a dwell may then have one value anywhere
        sigma, at = math.sqrt(sigma**2 - width**2 / 12.0), reached[:, side]
        if stuck[at, side].sum() <= _CROWDED * float(noise.inflation[i]):
            continue  # no more can be missing above a value than there are at it
        missing = missing_above(stuck[:, side], counts, width / sigma) / float(noise.inflation[i])
        usual = float(np.median(missing[inside]))  # noise that is not Gaussian has flat tops at every level
        if missing[at].sum() > _CROWDED and missing[at].mean() > 4.0 * usual:
            level = float(ends[at, side][0]) * (1.0 if side < 3 else -1.0)
            which = tuple(each.number for each, is_cut in zip(seen, at & (stuck[:, side] > 1), strict=True) if is_cut)
            yield Saturation(i + 1, level, float(stuck[at, side].sum() / counts.sum()), which)


def missing_above(stuck: Floats, counts: Floats, step_sigmas: float) -> Floats:
    """Readings that Gaussian noise would put above the top value of each dwell, (D,), from how many are at it."""
    from scipy.special import ndtr, ndtri

    below = np.clip(1.0 - stuck / counts, 0.5 / counts, None)
    return counts * ndtr(-(ndtri(below) + step_sigmas))


def _outliers(seen: Sequence[_Seen]) -> Outliers:
    gated = np.array([each.rejected for each in seen], float)
    counts = np.array([each.count + each.rejected for each in seen], float)
    total = int(gated.sum())
    if not total:
        return Outliers()
    by_channel = tuple(np.sum([each.out for each in seen], axis=0).astype(int).tolist())
    p_value, stretch = clustering(gated, counts)
    return Outliers(
        total, total / float(counts.sum()), by_channel, p_value, tuple(each.number for each in seen[stretch])
    )


def clustering(hits: Floats, counts: Floats) -> tuple[float | None, slice]:
    """Run-level p of ``hits`` (D,) among ``counts`` (D,) readings, and the stretch of the D dwells that has most.

    Given their sum, hits in a stretch are binomial; stretches of 1, 2, 4 ... dwells are looked at, and the least tail
    probability is multiplied by their number: at most the size it states, however few the hits.
    """
    from scipy.special import betainc

    size = -(-len(hits) // _COUNTABLE)
    starts = np.arange(0, len(hits), size)
    sums = [np.concatenate([[0.0], np.cumsum(np.add.reduceat(each, starts))]) for each in (hits, counts)]
    best, tried, stretch = 1.0, 0, (0, 0)
    length = 1
    while 2 * length <= len(starts):
        inside, share = (each[length:] - each[:-length] for each in sums)
        least = np.maximum(inside, 1.0)  # the chance of so many is an incomplete beta function
        tails = np.where(inside > 0, betainc(least, sums[0][-1] - least + 1.0, share / sums[1][-1]), 1.0)
        first, tried = int(tails.argmin()), tried + len(tails)
        if tails[first] < best:
            best, stretch = float(tails[first]), (first * size, min((first + length) * size, len(hits)))
        length *= 2
    if not tried:
        return None, slice(0, 0)
    return min(1.0, best * tried), slice(*stretch)


def _dwells(numbers: Sequence[int]) -> str:
    """``dwell 2``, ``3 dwells (2, 5, 9)``; no more than six of them."""
    if len(numbers) == 1:
        return f"dwell {numbers[0]}"
    return f"{len(numbers)} dwells ({', '.join(map(str, numbers[:6]))}{' ...' * (len(numbers) > 6)})"
