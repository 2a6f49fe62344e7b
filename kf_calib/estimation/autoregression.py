"""An autoregression of the noise of readings, from their autocovariance about a parabola.

Its spectral density at zero frequency, over that of white noise of the same variance, is kappa: by so much longer the
mean of readings takes to become certain (Percival and Walden, 1993, ch. 9).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import Floats

_ITERATIONS = 60
_STILL = 1e-3  # of kappa
_LONG = 500  # readings of a block
_GONE = 1e-9  # of the variance


@dataclass(frozen=True)
class Autoregression:
    """x_t = sum a_k x_(t-k) + e_t: coefficients a (p,), variance of e, and of x."""

    coefficients: Floats = field(default_factory=lambda: np.zeros(0))
    innovation: float = 1.0
    variance: float = 1.0

    @classmethod
    def of(cls, gamma: Floats, count: int) -> Autoregression:
        """Of autocovariances (L + 1,) from ``count`` readings: Levinson and Durbin over orders, that of least BIC."""
        a, innovation, level = np.zeros(0), float(gamma[0]), float(gamma[0])
        best, best_score = cls(a, innovation, level), count * np.log(innovation)
        for order in range(1, len(gamma)):
            reflection = (gamma[order] - a @ gamma[order - 1 : 0 : -1]) / innovation
            if not abs(reflection) < 1:
                break
            a = np.append(a - reflection * a[::-1], reflection)
            innovation *= 1 - reflection**2
            score = count * np.log(innovation) + order * np.log(count)
            if score < best_score and a.sum() != 1:
                best, best_score = cls(a, innovation, level), score
        return best

    @property
    def inflation(self) -> float:
        """kappa = var(e) / (var(x) (1 - sum a)^2)."""
        return float(self.innovation / self.variance / (1.0 - self.coefficients.sum()) ** 2)

    def autocovariances(self, known: Floats, size: int) -> Floats:
        """At lags 0 ... size - 1: the ``known`` ones up to its order, then as it goes on."""
        order = len(self.coefficients)
        out = np.zeros(size)
        out[: order + 1] = known[: order + 1]
        for lag in range(order + 1, size if order else 0):
            before = out[lag - order : lag]
            if np.abs(before).max() < _GONE * out[0]:
                break
            out[lag] = self.coefficients @ before[::-1]
        return out


def expected_products(gamma: Floats, lags: int) -> Floats:
    """What lagged products (lags + 1,) of n readings of autocovariances ``gamma`` (n,) about their parabola sum to.

    The sums along the diagonals of P G P, G the Toeplitz matrix of gamma and P = 1 - Q Q^T: P G P = G - Q W^T - W Q^T,
    W = (1 - Q Q^T / 2) G Q.
    """
    count = len(gamma)
    curve = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), 3))[0]
    size = 1 << (3 * count).bit_length()
    both = np.fft.rfft(np.concatenate([gamma[:0:-1], gamma]), size)[:, None]
    turned = np.fft.irfft(both * np.fft.rfft(curve, size, axis=0), size, axis=0)[count - 1 : 2 * count - 1]
    turned = turned - 0.5 * curve @ (curve.T @ turned)
    cross = np.fft.rfft(curve, size, axis=0).conj() * np.fft.rfft(turned, size, axis=0)
    lost = np.fft.irfft(cross.sum(axis=1) + cross.conj().sum(axis=1), size)[: lags + 1]
    return (count - np.arange(lags + 1)) * gamma[: lags + 1] - lost


def unbiased(raw: Floats, count: int, size: int) -> tuple[Autoregression, float]:
    """The autoregression, and the variance, of readings whose autocovariances about the parabolas of blocks of ``size``
    are ``raw`` (L + 1,).

    A parabola takes what is slow out of a block: of noise correlated over a twentieth of it half. What it takes of the
    autoregression is put back, until that stands still.
    """
    return _unbiased(raw.tobytes(), count, size)


@lru_cache(maxsize=64)  # the same for every model of a run
def _unbiased(raw_bytes: bytes, count: int, size: int) -> tuple[Autoregression, float]:
    raw = np.frombuffer(raw_bytes)
    gamma, kappa, lags, model = raw, 0.0, len(raw) - 1, Autoregression.of(raw, count)
    if not len(model.coefficients) and size > _LONG:  # white, and a parabola takes next to nothing of it
        return model, float(raw[0])
    for _ in range(_ITERATIONS):
        if abs(model.inflation - kappa) < _STILL * model.inflation:
            break
        kappa, whole = model.inflation, model.autocovariances(gamma, size)
        gamma = raw + whole[: lags + 1] - expected_products(whole, lags) / (size - np.arange(lags + 1))
        model = Autoregression.of(gamma, count)
    return model, float(gamma[0])
