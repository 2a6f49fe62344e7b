"""Whether readings can be what a calibration is of: at rest, the norm of corrected readings is gravity.

The readings are cut into windows of half a second. In a window at rest they scatter by less than two hundredths of
their norm. If the norm of most windows is not that of gravity, the unit or the size of a count is another one. If it
changes from direction to direction by more than the noise and the calibration allow, and far less with another order
or other signs of the channels, these are others.
"""

from __future__ import annotations

import itertools

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import CHANNELS, RESTATING, RawInput, wrong_unit
from kf_calib.bench.streams import Stream
from kf_calib.estimation.correction import Correction

_WINDOW_NS = 500_000_000
_FEWEST = 8  # readings of a window
_STILL = 0.02  # scatter over norm
_SOON = 3  # windows at rest that tell a wrong unit while more readings are to come
_LEVEL = (0.75, 1.33)  # of gravity; a sensor that is calibrated is within
_MOST = 2000  # windows that are kept
_APART = 0.97  # cosine of directions that count as two
_DIRECTIONS = 6  # from which on an order of the channels can be told from another
_SIGMAS, _BETTER = 6.0, 6.0
_ORDERS = [
    (sx * a, sy * b, sz * c)
    for a, b, c in itertools.permutations(CHANNELS)
    for sx, sy, sz in itertools.product((1, -1), repeat=3)
]


class NormAtRest:
    """Collects the readings of windows at rest."""

    def __init__(self, correction: Correction) -> None:
        self._correction = correction
        self._left = Stream.empty(3)
        self._means, self._sigmas = list[Floats](), list[float]()

    def add(self, readings: Stream) -> None:
        """Take readings (n, 3), m/s^2, of accelerometers 1, 2, 3."""
        if len(self._means) >= _MOST:
            return
        stream = self._left + readings
        number = (stream.time_ns - stream.time_ns[:1]) // _WINDOW_NS
        cuts = np.flatnonzero(np.diff(number)) + 1
        for start, end in itertools.pairwise([0, *cuts.tolist()]):
            self._take(stream.values[start:end])
        self._left = stream[int(cuts[-1]) if len(cuts) else 0 :]

    def _take(self, values: Floats) -> None:
        """Keep the mean of a window if the sensor rests in it."""
        if len(values) < _FEWEST or not np.isfinite(values).all():
            return
        mean, scatter = values.mean(axis=0), float(np.sqrt(values.var(axis=0, ddof=1).sum()))
        if scatter <= _STILL * float(np.linalg.norm(mean)):
            self._means.append(mean)
            self._sigmas.append(scatter / np.sqrt(len(values)))

    def add_means(self, means: Floats, sigma_mps2: float) -> None:
        """Take means (n, 3) at rest, with what each is uncertain by."""
        self._means += list(means)
        self._sigmas += [sigma_mps2] * len(means)

    def misfit(self, taken: RawInput, final: bool) -> str:
        """What shows that the readings are not what they are taken for, and the likely cause; nothing if nothing does.

        final: whether no more are to come.
        """
        if final:
            self._take(self._left.values)
        if len(self._means) < (1 if final else _SOON):
            return ""
        means, gravity = np.array(self._means), self._correction.bench.gravity_mps2
        level = float(np.median(self._norms(means))) / gravity
        if not _LEVEL[0] < level < _LEVEL[1]:
            plain = float(np.median(np.linalg.norm(means, axis=1))) / gravity
            return f"{wrong_unit(plain, taken, gravity).sentence}; --unchecked corrects it as it is"
        return self._of_order(means, taken) if final else ""

    def _norms(self, readings: Floats) -> Floats:
        """The norm of readings without bias and alignment; effects are small."""
        return np.linalg.norm((readings - self._correction.bias_mps2) @ self._correction.matrix.T, axis=1)

    def _of_order(self, means: Floats, taken: RawInput) -> str:
        """What shows that the channels have another order or other signs."""
        kept = _distinct(means)
        if len(kept) < _DIRECTIONS:
            return ""
        means = means[kept]
        allowed = float(np.hypot(np.max(self._correction.worst_sigma_mps2), np.median(self._sigmas)))
        scatter = {order: float(np.std(self._norms(RawInput(order).ordered(means)))) for order in _ORDERS}
        here, best = scatter[CHANNELS], min(_ORDERS, key=lambda order: scatter[order])
        if here < max(_SIGMAS * allowed, _BETTER * scatter[best]):
            return ""
        channels = ",".join(str(int(np.sign(k)) * taken.channels[abs(k) - 1]) for k in best)
        is_stated = bool(taken.restating("channels")) or not self._correction.input.is_plain
        return (
            f"the norm at rest changes by {here:.2g} m/s^2 over {len(kept)} directions, and by {scatter[best]:.2g} "
            f"m/s^2 with --channels {channels}{RESTATING * is_stated}: add that if it is how this device is wired; "
            "--unchecked corrects it as it is"
        )


def _distinct(means: Floats) -> list[int]:
    """Places of means that point in different directions."""
    unit, kept = means / np.linalg.norm(means, axis=1, keepdims=True), list[int]()
    for k, own in enumerate(unit):
        if all(float(own @ unit[j]) < _APART for j in kept):
            kept.append(k)
    return kept
