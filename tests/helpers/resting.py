"""Readings at rest with known noise, and sources of them."""

from collections.abc import Iterator

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream, bench_without_angles

G = 9.80665
PERIOD_S = 0.01


def noisy(
    rng: np.random.Generator, count: int, white: float = 0.0, walk: float = 0.0, quantisation: float = 0.0
) -> Floats:
    """Noise (count,) at 100 Hz: white, a random walk, and the error of increments of the integral that are rounded."""
    return (
        rng.normal(0.0, 1.0, count) * white / np.sqrt(PERIOD_S)
        + np.cumsum(rng.normal(0.0, 1.0, count)) * walk * np.sqrt(PERIOD_S)
        + np.diff(rng.normal(0.0, 1.0, count + 1)) * quantisation / PERIOD_S
    )


def flicker(rng: np.random.Generator, count: int, size: float) -> Floats:
    """1/f noise (count,) of the two-sided density B^2 / (2 pi f), by fractional integration (N. J. Kasdin, 1995)."""
    whole, padded = 2 * count, 4 * count
    response = np.concatenate([[1.0], np.cumprod((np.arange(1, whole) - 0.5) / np.arange(1, whole))])
    driven = np.fft.rfft(response, padded) * np.fft.rfft(rng.normal(0.0, size, whole), padded)
    return np.fft.irfft(driven, padded)[whole - count : whole]


class Resting:
    """A source of readings (n, 3) at these times, a batch after the other; temperatures at each reading."""

    def __init__(
        self, readings_mps2: Floats, time_s: Floats | None = None, temperature_c: Floats | None = None
    ) -> None:
        self.readings_mps2, self.temperature_c = readings_mps2, temperature_c
        times_s = PERIOD_S * np.arange(len(readings_mps2)) if time_s is None else time_s
        self.time_ns = 1_750_000_000_000_000_000 + np.round(times_s * 1e9).astype(np.int64)
        self.bench: Bench = bench_without_angles("rest", {})[0]
        self.warnings, self.fraction = list[str](), 0.0

    def __iter__(self) -> Iterator[Batch]:
        for begin in range(0, len(self.readings_mps2), 5000):
            part = slice(begin, begin + 5000)
            warm = Stream.empty(1)
            if self.temperature_c is not None:
                warm = Stream(self.time_ns[part], self.temperature_c[part, None])
            yield Batch(Stream(self.time_ns[part], self.readings_mps2[part]), Stream.empty(4), warm)


def level(noise: Floats) -> Floats:
    """Readings (n, 3) with this noise (n, 3), third axis up."""
    return noise + np.array([0.0, 0.0, G])
