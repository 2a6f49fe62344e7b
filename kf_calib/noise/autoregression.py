"""Autoregressive models of the noise of readings, estimated from their autocovariance about a parabola.

The spectral density of such a model at frequency zero, divided by that of white noise of the same variance, is the
inflation kappa, by which correlation increases the variance of a mean (Percival and Walden, 1993, ch. 9).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import Floats

_ITERATIONS = 60
_STILL = 1e-3  # relative change of kappa
_LONG = 500  # in blocks of more readings than this, a parabola removes almost nothing of white noise
_GONE = 1e-9  # relative to the variance


@dataclass(frozen=True)
class Autoregression:
    """The model x_t = sum a_k x_(t-k) + e_t with coefficients a (p,), the variance ``innovation`` of e and ``variance``
    of x."""

    coefficients: Floats = field(default_factory=lambda: np.zeros(0))
    innovation: float = 1.0
    variance: float = 1.0

    @classmethod
    def of(cls, gamma: Floats, count: int) -> Autoregression:
        """The model fitted to autocovariances (L + 1,) of ``count`` readings by the Levinson-Durbin recursion, with the
        order of least BIC."""
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
        """The inflation kappa = var(e) / (var(x) (1 - sum a)^2)."""
        return float(self.innovation / self.variance / (1.0 - self.coefficients.sum()) ** 2)

    def autocovariances(self, known: Floats, size: int) -> Floats:
        """Autocovariances at lags 0 ... size - 1: the ``known`` ones up to the order of the model, then by its
        recursion."""
        order = len(self.coefficients)
        curve = np.zeros(size)
        curve[: order + 1] = known[: order + 1]
        for lag in range(order + 1, size if order else 0):
            before = curve[lag - order : lag]
            if np.abs(before).max() < _GONE * curve[0]:
                break
            curve[lag] = self.coefficients @ before[::-1]
        return curve


def expected_products(gamma: Floats, lags: int) -> Floats:
    """Expected sums of lagged products (lags + 1,) of n readings with autocovariances ``gamma`` (n,), about their
    parabola.

    These are the sums along the diagonals of P G P, where G is the Toeplitz matrix of gamma and P = 1 - Q Q^T projects
    off the parabola: P G P = G - Q W^T - W Q^T with W = (1 - Q Q^T / 2) G Q.
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
    """The model and the variance of readings whose autocovariances about the parabolas of blocks of ``size`` readings
    are ``raw`` (L + 1,).

    A parabola removes slow noise from a block, half of it if it is correlated over a twentieth of the block. The
    expected loss under the model is added to the autocovariances and the model is fitted again, until kappa no longer
    changes.
    """
    return _unbiased(raw.tobytes(), count, size)


@lru_cache(maxsize=64)  # the result is the same for every model of a run
def _unbiased(raw_bytes: bytes, count: int, size: int) -> tuple[Autoregression, float]:
    """Compute ``unbiased`` from the bytes of ``raw``, which can be cached."""
    raw = np.frombuffer(raw_bytes)
    gamma, kappa, lags, model = raw, 0.0, len(raw) - 1, Autoregression.of(raw, count)
    if not len(model.coefficients) and size > _LONG:  # white noise, of which a parabola removes almost nothing
        return model, float(raw[0])
    for _ in range(_ITERATIONS):
        if abs(model.inflation - kappa) < _STILL * model.inflation:
            break
        kappa, whole = model.inflation, model.autocovariances(gamma, size)
        gamma = raw + whole[: lags + 1] - expected_products(whole, lags) / (size - np.arange(lags + 1))
        model = Autoregression.of(gamma, count)
    return model, float(gamma[0])
