"""Temperatures of readings that are corrected batch by batch."""

from __future__ import annotations

import numpy as np
import pytest

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.exchange.corrected_file import _Thermometer


def streams(rng: np.random.Generator) -> tuple[Stream, Stream]:
    """300 readings, and 40 temperatures of which some are no number and some come late or twice."""
    stamps = np.sort(rng.choice(100_000, 300, replace=False))
    of_temperature = np.sort(rng.choice(np.arange(5_000, 95_000), 40, replace=False))
    of_temperature[[9, 20]] = of_temperature[8], of_temperature[15]
    values = 20.0 + 3.0 * rng.normal(size=(40, 1))
    values[[5, 30], 0] = np.nan, np.inf
    return Stream(stamps, rng.normal(size=(300, 3))), Stream(of_temperature, values)


def used(temperature: Stream) -> tuple[Floats, Floats]:
    """Stamps and values of those that are numbers and later than all before."""
    before = np.append(-1, np.maximum.accumulate(temperature.time_ns)[:-1])
    chosen = (temperature.time_ns > before) & np.isfinite(temperature.values[:, 0])
    return temperature.time_ns[chosen].astype(float), temperature.values[chosen, 0]


@pytest.mark.parametrize("parts", [1, 7, 60])
def test_a_reading_has_the_temperature_between_those_beside_it_however_they_come(parts: int) -> None:
    """Those before the first temperature have the first, those after the last the last."""
    for seed in range(10):
        readings, temperature = streams(np.random.default_rng(seed))
        times, values = used(temperature)
        thermometer, pairs = _Thermometer(True), list[tuple[Stream, Floats | None]]()
        for k in range(parts):  # a share of each, whatever its stamps
            of_readings, of_temperature = (slice(k * n // parts, (k + 1) * n // parts) for n in (300, 40))
            pairs += thermometer.pairs(Batch(readings[of_readings], readings[:0], temperature[of_temperature]))
        pairs += thermometer.rest()
        np.testing.assert_array_equal(np.concatenate([stream.time_ns for stream, _ in pairs]), readings.time_ns)
        told = np.concatenate([own for _, own in pairs if own is not None])
        np.testing.assert_allclose(told, np.interp(readings.time_ns, times, values), rtol=1e-12)
        assert thermometer.extremes == (values.min(), values.max())


def test_readings_wait_for_a_temperature_as_late_as_they_are() -> None:
    readings, _ = streams(np.random.default_rng(1))
    none, late = Stream.empty(1), Stream(readings.time_ns[199:200], np.array([[21.0]]))
    thermometer = _Thermometer(True)
    assert thermometer.pairs(Batch(readings[:100], readings[:0], none)) == []
    with pytest.raises(InputError, match="has no temperature, which the calibration needs"):
        thermometer.rest()
    ((ready, values),) = thermometer.pairs(Batch(readings[100:], readings[:0], late))
    assert len(ready) == 200 and values is not None and set(values.tolist()) == {21.0}
    assert [len(stream) for stream, _ in thermometer.rest()] == [100]
    plain = _Thermometer(False)
    assert plain.pairs(Batch(readings, readings[:0], late)) == [(readings, None)] and plain.rest() == []
