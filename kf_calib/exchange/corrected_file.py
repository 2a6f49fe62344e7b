"""A copy of a recording with the corrected readings beside the raw ones, as one more topic.

The message is sensor_msgs/msg/Imu: ``linear_acceleration`` is specific force in the frame of the block, and its
covariance (row by row) that of the calibration, largest over all directions of gravity, and of the noise of a reading.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Batch, Stream
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.norm_at_rest import NormAtRest
from kf_calib.sources.files import cdr
from kf_calib.sources.files.contents import CALIBRATED_TOPIC
from kf_calib.sources.files.mcap_append import TopicAppender, source_file
from kf_calib.sources.files.recording import Recording
from kf_calib.support.output_files import whole

FRAME = "block"


@dataclass(frozen=True)
class Applied:
    """What was corrected: number of readings, those that are not finite, and the extremes of the temperature, degC
    (None: not used)."""

    readings: int
    not_finite: int
    temperature_c: tuple[float, float] | None


def apply_to_file(
    correction: Correction,
    recording: Recording,
    copy: Path,
    on_progress: Callable[[float], None] | None = None,
    *,
    unchecked: bool = False,
) -> Applied:
    """Write the ``copy``, wholly or not at all; unchecked: though the norm at rest may not be gravity.

    Raises InputError where the recording cannot be read, is not whole, has no temperature where an effect needs one, or
    holds other readings than it is taken for.
    """
    norm = NormAtRest(correction)
    thermometer = _Thermometer(bool(correction.needs_temperature))
    count = bad = 0
    source = source_file(recording.path)
    with whole(copy) as part, part.open("wb") as file:
        copied, told = _half(on_progress, 0.0), _half(on_progress, 0.5)
        appender = TopicAppender(source, file, CALIBRATED_TOPIC, cdr.IMU, _template(correction), copied)
        for readings, temperature_c in _pairs(recording, thermometer, told):
            values = correction.of_readings(readings.values, temperature_c)
            norm.add(readings)
            appender.add(Stream(readings.time_ns, values))
            count, bad = count + len(values), bad + int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        if not unchecked and (said := norm.misfit(recording.bench.input, final=True)):
            raise InputError(f"{recording.path}: {said}.")
        if bad == count > 0:
            raise InputError(f"{recording.path}: none of the {count} readings is what the calibration's device can "
                             f"send ({correction.input}): state what they are, by --accel-unit, --accel-scale and "
                             "--channels.")  # fmt: skip
        appender.finish()
    return Applied(count, bad, thermometer.extremes)


def _pairs(
    recording: Recording, thermometer: _Thermometer, told: Callable[[float], None] | None
) -> Iterator[tuple[Stream, Floats | None]]:
    """Yield all readings of a recording with their temperatures."""
    for batch in recording:
        yield from thermometer.pairs(batch)
        if told is not None:
            told(recording.fraction)
    yield from thermometer.rest()


def _half(told: Callable[[float], None] | None, start: float) -> Callable[[float], None] | None:
    """Return what tells the progress of one of two halves of the work."""
    return None if told is None else lambda share: told(start + 0.5 * share)


def _template(correction: Correction) -> bytes:
    """Return a message with the covariance of corrected readings filled in."""
    covariances = correction.covariance_of(correction.gravities, REFERENCE_TEMPERATURE_C, noise=True)
    worst = covariances[np.argmax(np.einsum("nii->n", covariances))]
    message = bytearray(cdr.imu_message(FRAME))
    message[-72:] = struct.pack("<9d", *worst.ravel())  # the last field of the message
    return bytes(message)


class _Thermometer:
    """Pairs readings with temperatures, interpolated between measurements and constant beyond them.

    Readings wait until a temperature as late as they are has come; memory is that of the readings between two
    temperatures.
    """

    def __init__(self, needed: bool) -> None:
        self._needed = needed
        self._times, self._values = np.zeros(0, np.int64), np.zeros(0)
        self._waiting = Stream.empty(3)
        self.extremes: tuple[float, float] | None = None

    def pairs(self, batch: Batch) -> list[tuple[Stream, Floats | None]]:
        """Readings that can be corrected now, and their temperatures (None: not needed)."""
        if not self._needed:
            return [(batch.accel, None)] if len(batch.accel) else []
        self._take(batch.temperature)
        self._waiting += batch.accel
        if not len(self._times):
            return []
        ready = self._waiting.time_ns <= self._times[-1]
        count = len(ready) if ready.all() else int(np.argmin(ready))  # in order of their coming
        found, self._waiting = self._waiting[:count], self._waiting[count:]
        return [self._paired(found)] if count else []

    def rest(self) -> list[tuple[Stream, Floats | None]]:
        """Readings after the last temperature. Raises InputError where there was none at all."""
        if not len(self._waiting):
            return []
        if not len(self._times):
            raise InputError(
                "the recording has no temperature, which the calibration needs: record it on /temperature, or name "
                "its topic by --temperature-topic."
            )
        return [self._paired(self._waiting)]

    def _take(self, stream: Stream) -> None:
        """Keep new temperatures that are finite and later than the last, and no more of the old ones than needed."""
        values = stream.values[:, 0] if len(stream) else np.zeros(0)
        later = np.maximum.accumulate(np.append(self._times[-1:], stream.time_ns))
        fresh = stream.time_ns > later[:-1] if len(later) > len(stream) else np.ones(len(stream), bool)
        fresh &= np.isfinite(values)
        if not fresh.any():
            return
        first = self._waiting.time_ns[0] if len(self._waiting) else stream.time_ns[0]
        kept = max(int(np.searchsorted(self._times, first)) - 1, 0)
        self._times = np.append(self._times[kept:], stream.time_ns[fresh])
        self._values = np.append(self._values[kept:], values[fresh])
        low, high = float(values[fresh].min()), float(values[fresh].max())
        old = self.extremes or (low, high)
        self.extremes = min(low, old[0]), max(high, old[1])

    def _paired(self, readings: Stream) -> tuple[Stream, Floats]:
        return readings, np.interp(readings.time_ns, self._times, self._values)
