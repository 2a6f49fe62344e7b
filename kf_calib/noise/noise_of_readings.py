"""The noise of readings within dwells: autoregressive models of it, and dwells in which it is not the same.

Autoregressive models are estimated from the autocovariance of readings about a parabola. The spectral density of such a
model at frequency zero, divided by that of white noise of the same variance, is the inflation kappa, by which
correlation increases the variance of a mean (Percival and Walden, 1993, ch. 9).

Dwells have unequal noise where hands tremble, tables are bumped, or machines run next door. The variance of the
readings of dwell d is sigma_w^2 v_d. With nu_d degrees of freedom it is estimated as s_d^2, and the v_d have an
inverse-gamma distribution: nu_0 s_0^2 / (sigma_w^2 v_d) is chi-squared with nu_0 degrees of freedom. Then s_d^2 / s_0^2
is F distributed with nu_d and nu_0 degrees of freedom, from which nu_0 and s_0 are estimated by maximum likelihood, and
each dwell has the posterior mean (G. Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004)

  sigma_w^2 v_d = (nu_0 s_0^2 + nu_d s_d^2) / (nu_0 + nu_d),

so that a dwell of few readings keeps to the others, and one of many to itself. A dwell may tremble more than the
others, but not be much quieter: the noise of the sensors is in all of them, and a dwell that seems to have little may
have its readings on one step of a coarse converter. So no variance counts as less than a tenth of the median. Unless
the noise is clearly unequal (M. Bartlett, 1937), all dwells have one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from kf_calib.bench.arrays import LAST_DIGITS, Floats
from kf_calib.dwells.limits import FEWEST_COMPARED
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.dwells.table import DwellTable, FoldedDwells, computed_once
from kf_calib.noise.cross_spectrum import correlations
from kf_calib.support.searches import MOST_STEPS
from kf_calib.support.tail_probabilities import CLEAR, chi_squared_tail

_STILL = 1e-3  # relative change of kappa
_LONG = 500  # in blocks of more readings than this, a parabola removes almost nothing of white noise


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
            if np.abs(before).max() < LAST_DIGITS * curve[0]:
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
    if size <= _LONG:  # what a parabola leaves of white noise in a short block is correlated
        model = Autoregression()
    elif not len(model.coefficients):  # white noise, of which it removes almost nothing
        return model, float(raw[0])
    for _ in range(MOST_STEPS):
        if abs(model.inflation - kappa) < _STILL * model.inflation:
            break
        kappa, whole = model.inflation, model.autocovariances(gamma, size)
        gamma = raw + whole[: lags + 1] - expected_products(whole, lags) / (size - np.arange(lags + 1))
        model = Autoregression.of(gamma, count)
    return model, float(gamma[0])


def are_alike(total: Autocovariance) -> bool:
    """Whether the readings of all channels may have one autocorrelation, by those from reading to reading.

    atanh r of n readings is normal with the variance 1/n about one value, whatever that is (R. A. Fisher, 1921); the
    correlation of slow noise leaves fewer readings that count.
    """
    varying = total.products[0] > 0.0
    if varying.sum() < 2 or len(total.products) < 2:
        return True
    r = total.products[1, varying] / total.products[0, varying] * total.pairs[0] / max(total.pairs[1], 1.0)
    places, freedom = np.arctanh(np.clip(r, -0.999, 0.999)), total.count / _lost_to_correlation(total)[varying]
    common = np.average(places, weights=freedom)
    return chi_squared_tail(len(r) - 1, float(freedom @ (places - common) ** 2)) >= CLEAR


_LEAST_FREEDOM = 2.0  # of a dwell whose own noise counts: with less, chi-squared is infinitely dense at zero
_SHAPES = np.geomspace(1.0, 1e4, 61)  # nu_0
_QUIETEST = 0.1  # variance of a dwell, in the median of all


def with_own_noise(dwells: DwellTable, along: Floats | None = None) -> DwellTable:
    """The dwells, each with the weights that its own noise gives the readings of its channels, 1 where all have one,
    and the correlations of its means by noise that channels share.

    along (D, 3): the weights of the channels in the size of the force, where nothing else is known in a dwell.
    """
    folded, free = dwells.folded, np.ones(3)
    if folded.averaged or not any(each.blocks for each in folded.autocovariances):  # as of a table: no reading is known
        return dwells
    weights = _of_channels(*_variances(folded, along, free))
    if not np.all(weights == 1.0):  # unequal if each reading told what no other says
        weights = _of_channels(
            *_variances(
                folded, along, _lost_to_correlation(pooled_autocovariance(folded, shares_in_correlation(folded)))
            )
        )
    if along is None:
        weights = np.minimum(weights, _weights_by_course(folded))
    own = folded.correlations if along is not None else _correlations(folded)
    if np.array_equal(weights, folded.weights) and np.array_equal(own, folded.correlations):
        return dwells
    return dwells.weighted(weights, own)


@computed_once
def _correlations(folded: FoldedDwells) -> Floats:
    return correlations(folded.autocovariances, pooled_autocovariance(folded, shares_in_correlation(folded)))


def pooled_autocovariance(folded: FoldedDwells, shares: Floats) -> Autocovariance:
    """The sums of lagged products of all dwells, each by its share (D, 3)."""
    pairs = zip(folded.autocovariances, shares, strict=True)
    return sum((each.times(share) for each, share in pairs if each.blocks), Autocovariance())


def shares_in_correlation(folded: FoldedDwells) -> Floats:
    """What the lagged products of each dwell count by, (D, 3), where the correlation is estimated.

    A dwell whose readings vary more about its parabola than those of the others, as after a knock or in a slip, has a
    correlation of its own, which says nothing of the others: its products count by the square of the weight that this
    variance gives it. Where all vary alike about their parabolas, dwells count by the weights of their readings.
    """
    weights = np.ones((len(folded.weights), 3)) if folded.averaged else _weights_by_course(folded)
    return np.where((weights == 1.0).all(axis=0), folded.weights, weights**2)


@computed_once
def _weights_by_course(folded: FoldedDwells) -> Floats:
    """Return the weights (D, 3) that dwells have by how much their readings vary about their parabolas."""
    several = np.array([each.blocks > 0 for each in folded.autocovariances])
    weights, known = np.ones((len(several), 3)), [each for each in folded.autocovariances if each.blocks]
    if known:
        counts, variances = (
            np.array([[each.count] for each in known]),
            [each.products[0] / each.pairs[0] for each in known],
        )
        alike = [each.times(1.0 / np.where(own > 0.0, own, 1.0)) for each, own in zip(known, variances, strict=True)]
        lost = _lost_to_correlation(sum(alike, Autocovariance()))
        parabolas = 3.0 * np.array([[each.blocks] for each in known])
        weights[several] = _of_channels(np.array(variances), np.maximum(counts / lost - parabolas, 0.0))
    return weights


def _of_channels(variances: Floats, freedom: Floats) -> Floats:
    """Return the weights (D, 3) of the channels, each by itself, from their variances (D, 3) and degrees of freedom."""
    return np.stack([weights_of(variances[:, i], freedom[:, i]) for i in range(3)], axis=1)


def weights_of(variances: Floats, freedom: Floats) -> Floats:
    """The weights 1 / v_d (D,) of readings of dwells with variances s_d^2 (D,) of nu_d (D,) degrees of freedom, of mean
    1; all 1 where the variances are equal but for chance."""
    known, weights = freedom >= _LEAST_FREEDOM, np.ones(len(variances))
    if known.sum() < FEWEST_COMPARED or np.median(variances[known]) <= 0.0:
        return weights
    variances = np.maximum(variances, _QUIETEST * np.median(variances[known]))
    if _equal_p(variances[known], freedom[known]) > CLEAR:
        return weights
    shape, level = _prior(variances[known], freedom[known])
    own = np.where(known, freedom, 0.0)
    posterior = (shape * level + own * variances) / (shape + own)
    return np.asarray(np.sum(freedom) / np.sum(freedom / posterior) / posterior, float)


def _equal_p(variances: Floats, freedom: Floats) -> float:
    """Return the p-value of Bartlett's test that all variances are equal."""
    total, pooled = freedom.sum(), float(freedom @ variances) / freedom.sum()
    statistic = total * np.log(pooled) - float(freedom @ np.log(variances))
    correction = 1.0 + (np.sum(1.0 / freedom) - 1.0 / total) / (3.0 * (len(variances) - 1))
    return chi_squared_tail(len(variances) - 1, float(statistic / correction))


def _prior(variances: Floats, freedom: Floats) -> tuple[float, float]:
    """Return the likeliest nu_0 and s_0^2: for each nu_0 the level by steps of an EM algorithm, all at once."""
    from scipy.special import betaln  # few runs need it

    shapes, levels = _SHAPES[:, None], np.full((len(_SHAPES), 1), np.median(variances))
    for _ in range(MOST_STEPS):
        precision = np.mean((shapes + freedom) / (shapes * levels + freedom * variances), axis=1, keepdims=True)
        levels = 1.0 / precision
    ratios = freedom * variances / (shapes * levels)
    logs = (
        0.5 * freedom * np.log(ratios)
        - 0.5 * (freedom + shapes) * np.log1p(ratios)
        - betaln(0.5 * freedom, 0.5 * shapes)
    )
    best = int(np.argmax(logs.sum(axis=1)))
    return float(_SHAPES[best]), float(levels[best, 0])


def _variances(folded: FoldedDwells, along: Floats | None, lost: Floats) -> tuple[Floats, Floats]:
    """Return the variances (D, 3) of the readings of each dwell about their course, relative to those of the run, and
    their degrees of freedom (D, 3), of which autocorrelation takes a part: ``lost`` (3,) as ``_lost_to_correlation``.
    Those along the force, where nothing else is known, are the same for all channels."""
    first = folded.ends[:-1]
    freedom = np.add.reduceat(np.maximum(folded.piece_counts - folded.width, 0.0), first)
    if along is not None:
        relative = folded.squares_along(along) / np.maximum(freedom, 1.0)
        return np.tile(relative[:, None], 3), np.tile(freedom[:, None] / lost.mean(), 3)
    squares = np.add.reduceat(folded.squares, first)
    levels = squares.sum(axis=0) / max(freedom.sum(), 1.0)
    relative = squares / np.maximum(freedom, 1.0)[:, None] / np.where(levels > 0.0, levels, 1.0)
    return relative, freedom[:, None] / lost


def _lost_to_correlation(total: Autocovariance) -> Floats:
    """Return by how much autocorrelation r_l enlarges the variance of a variance, 1 + 2 sum of r_l^2, (3,), over lags
    of up to half a block."""
    if not total.blocks:
        return np.ones(3)
    level = np.where(total.products[0] > 0.0, total.products[0] / total.pairs[0], 1.0)
    pairs = total.pairs[1:][total.pairs[1:] > 0.5 * total.pairs[0], None]
    correlation = total.products[1 : 1 + len(pairs)] / pairs / level
    return np.maximum(1.0 + 2.0 * np.sum(correlation**2 - 1.0 / pairs, axis=0), 1.0)
