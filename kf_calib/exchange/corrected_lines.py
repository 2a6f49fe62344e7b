"""Lines of JSON or CSV with the readings in them corrected, as they come: byte for byte the same lines otherwise
(docs/format.md).

Whether readings can be what a calibration is of: at rest, the norm of corrected readings is gravity.

The readings are cut into windows of half a second. In a window at rest they scatter by less than two hundredths of
their norm. If the norm of most windows is not that of gravity, the unit or the size of a count is another one. If it
changes from direction to direction by more than the noise and the calibration allow, and far less with another order
or other signs of the channels, these are others.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.raw_input import CHANNELS, PLAIN, RESTATING, RawInput, wrong_unit
from kf_calib.bench.streams import Stream
from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.sources.text.encoding import Cutter
from kf_calib.sources.text.lines import are_telling, reader_for
from kf_calib.sources.text.reader import LineCounts, LineReader, first_line, named
from kf_calib.sources.text.units import Units

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


_Sample = tuple[int, int, list[float], float]
"""Number of a line, its stamp, its readings, and the temperature then."""


class CorrectedLines:
    """Corrects lines that come in blocks of bytes; memory is that of one block and one line.

    A heading, the description of a bench, angles and temperatures pass as they are. Lines that cannot be used are left
    out and counted, as are readings that come before the first temperature where one is needed. overrides: bench keys
    that state what the device sends, where that is not what the calibration says. columns: our name for each foreign
    column or key. name: what messages call the lines. unchecked: whether a norm at rest that is not gravity may be.
    readings: how many have been corrected. Raises InputError where the readings are not what they are taken for.
    """

    def __init__(
        self,
        correction: Correction,
        columns: Mapping[str, str] = MappingProxyType({}),
        overrides: BenchKeys = UNSTATED,
        *,
        name: str = "standard input",
        units: Units | None = None,
        unchecked: bool = False,
    ) -> None:
        self._correction, self._columns, self._overrides, self._name = correction, columns, overrides, name
        self._units = units or Units.of(overrides, input=correction.input)
        self._needs_temperature = bool(correction.needs_temperature)
        self._counts, self._temperature_c = LineCounts(), np.nan
        self._cutter = Cutter(self._counts.refuse, keeps_ends=True)
        self._waiting = list[str]()  # while it is not known what the lines are
        self._reader: LineReader | None = None
        self._input: RawInput | None = None
        self._norm = None if unchecked else NormAtRest(correction)
        self.readings = 0

    def push(self, block: bytes) -> bytes:
        """The lines that end in ``block``, corrected."""
        return self._corrected(self._cutter.push(block))

    def rest(self) -> bytes:
        """The line without an end, if there is one. Raises InputError where no readings have come at all."""
        last = self._corrected(self._cutter.rest(), is_end=True)
        if not self.readings:
            self._counts.unknown.clear()  # they pass
            advice = self._reader.advice if self._reader else "check that the logger wrote any"
            raise self._counts.refusal(f"{self._name}: no readings to correct", advice)
        if self._norm is not None:
            self._checked(final=True)
        return last

    @property
    def warnings(self) -> list[str]:
        """What was left out; unknown names are none of it: they pass."""
        self._counts.unknown.clear()
        return self._counts.sentences()

    @property
    def input(self) -> RawInput:
        """What the lines hold, as far as that is known."""
        return self._input or PLAIN

    def _corrected(self, lines: list[str], *, is_end: bool = False) -> bytes:
        """Return lines, corrected; the readings of all of them at once."""
        self._counts.lines += len(lines)
        self._waiting += lines
        heading = self._begun(is_end) if self._reader is None else []
        if self._reader is None:
            return b""
        lines, self._waiting = self._waiting, []
        first, passed, samples = self._counts.lines - len(lines) + 1, dict[int, str](), list[_Sample]()
        for number, row in self._reader.rows([line.rstrip("\r\n").lstrip("\ufeff") for line in lines], first):
            time_ns, readings, _, degrees = row or (0, None, None, None)
            self._temperature_c = degrees[0] if degrees else self._temperature_c
            if readings and self._needs_temperature and np.isnan(self._temperature_c):
                self._counts.refuse(number, "it came before the first temperature, which the calibration needs")
                continue
            passed[number] = lines[number - first]
            if readings:
                samples.append((number, time_ns, readings, self._temperature_c))
        if samples:
            self._put(passed, samples)
        return "".join([*heading, *passed.values()]).encode("utf-8", errors="surrogateescape")

    def _begun(self, is_end: bool) -> list[str]:
        """Choose the reader, once it is known what the lines are that wait, and return what of them is a heading."""
        texts = [line.rstrip("\r\n") for line in self._waiting]
        blank = first_line(texts)
        told = texts[blank:]
        if not told or not (is_end or are_telling(told)):
            return []
        with named(self._name):
            self._reader, count = reader_for(told, self._columns, self._counts, angles=False, units=self._units)
        heading, self._waiting = self._waiting[: blank + count], self._waiting[blank + count :]
        forces = [*texts[:blank], *self._reader.heading_of_forces(told[:count])]
        return [force + line[len(text) :] for force, text, line in zip(forces, texts, heading, strict=False)]

    def _put(self, passed: dict[int, str], samples: Sequence[_Sample]) -> None:
        """Correct the lines that hold readings."""
        assert self._reader is not None
        if self._input is None:
            stated = self._reader.stated(self._name, self._overrides, self._correction.input)
            self._input = RawInput.from_metadata(stated)
        numbers, stamps, values, temperatures = zip(*samples, strict=True)
        readings = self._input.readings(np.array(values))
        forces = self._correction.of_readings(readings, np.array(temperatures))
        if self._norm is not None:
            self._norm.add(Stream(np.array(stamps), readings))
            self._checked(final=False)
        for number, force in zip(numbers, forces, strict=True):
            if np.isfinite(force).all():
                text = passed[number].rstrip("\r\n")
                passed[number] = self._reader.with_readings(text, force.tolist()) + passed[number][len(text) :]
                self.readings += 1
            else:
                self._counts.refuse(number, "no specific force gives these readings")
                del passed[number]

    def _checked(self, final: bool) -> None:
        """Raise InputError where the norm at rest shows that the readings are not what they are taken for."""
        assert self._norm is not None
        if said := self._norm.misfit(self.input, final):
            raise InputError(f"{self._name}: {said}.")
