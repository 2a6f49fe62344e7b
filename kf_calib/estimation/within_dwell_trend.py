"""Trends within dwells: a test of whether the residuals change within dwells more than noise does.

An effect for which there is no column may show no more in the means of dwells than scatter would. If it jumps or turns
during a dwell, however, it leaves a slope and a bend there. The residuals of each dwell and channel are projected on
smooth shapes: Legendre polynomials of degree 1 to 3 times 1 - u^2, made orthogonal to a constant. The factor 1 - u^2
reduces the weight of both ends, where the platform still shakes.

Noise whose mean has the variance kappa sigma^2 / n gives each coefficient that same variance. A random walk of the
biases adds q^2 T times a constant, and 1/f noise of density h / f adds h times a constant, whatever the length T of
the dwell (from the covariances min(s, t) and -ln |s - t|).

And a test of whether an oscillation goes on alike in all dwells, as the model of one has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, Mask
from kf_calib.bench.paper_parameters import BIASES
from kf_calib.dwells.pieces import basis_coefficients, of_all_pieces
from kf_calib.dwells.qr import orthonormal
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import lines_of
from kf_calib.dwells.table import AlikeDwells, DwellTable
from kf_calib.estimation.candidate_scan import SEEN
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.square_root_information import scale_columns
from kf_calib.estimation.whitened_rows import misfit_rows
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.rotations import along_force, sensitivities_of
from kf_calib.noise.terms import RandomWalk, ThermometerError
from kf_calib.support.tail_probabilities import LEVEL, REST, chi_squared_tail, f_tail, sidak

_DEGREE = 3
_GRID = 600
_PLACES = 9  # of the intensity of a walk, over which a density is averaged


def shapes(u: Floats) -> Floats:
    """A constant and the shapes at places u from -1 to 1 in a dwell, (..., 1 + degrees), not yet orthogonal."""
    values: Floats = np.polynomial.legendre.legvander(u, _DEGREE).astype(float)
    values[..., 1:] *= (1.0 - u**2)[..., None]
    return values


def variances(values: Floats) -> tuple[Floats, Floats]:
    """Variances of the coefficients of a dwell under a random walk with q^2 T = 1, and under 1/f noise with h = 1.

    values (n, k): functions over a dwell, the first a constant. Each is made orthogonal to those before it and of mean
    square 1. Returns both variances, (k - 1,) each, of all but the constant.
    """
    count = len(values)
    frame = np.linalg.qr(values)[0][:, 1:] * np.sqrt(count)
    at = (np.arange(count) + 0.5) / count
    apart = np.abs(at[:, None] - at)
    np.fill_diagonal(apart, np.exp(-1.5) / count)  # the mean of -ln |s - t| over a cell
    walk = np.mean((np.cumsum(frame, axis=0) / count) ** 2, axis=0)
    return walk, np.einsum("sk,st,tk->k", frame, -np.log(apart), frame) / count**2


@cache
def _of_shapes() -> tuple[Floats, Floats]:
    """Return the variances of the shapes on a fine grid."""
    return variances(shapes((2.0 * np.arange(_GRID) + 1.0) / _GRID - 1.0))


@dataclass(frozen=True)
class Trend:
    """The test of all trends within dwells.

    ratio: mean square of all coefficients over what noise gives. p_value: its p-value. sums (D, c): sum of these ratios
    for each dwell and channel; of the reading along the force alone where attitudes are not known. numbers (D,): of the
    dwells. log_density: logarithm of the density of the coefficients in this noise, but for a constant that is that of
    the dwells.
    """

    ratio: float
    p_value: float
    sums: Floats
    numbers: Ints
    log_density: float = 0.0

    @property
    def run_p(self) -> float:
        """The p-value that it gives a run by its share of the false alarms."""
        return min(self.p_value / REST, 1.0)

    @property
    def most(self) -> tuple[int, int | None]:
        """The number of the dwell with the largest sum and the channel, counted from 1; None for that along the
        force."""
        dwell, channel = np.unravel_index(int(self.sums.argmax()), self.sums.shape)
        return int(self.numbers[dwell]), int(channel) + 1 if self.sums.shape[1] > 1 else None

    @property
    def most_in_words(self) -> str:
        """Where it is largest, in words."""
        dwell, channel = self.most
        return f"most in dwell {dwell}" + (f", accelerometer {channel}" if channel else "")


def trend(fitted: Fit) -> Trend | None:
    """The test of trends within dwells in the residuals of a fit; None where it cannot be made."""
    return trend_beside(fitted.linearised, fitted.noise.for_goodness_of_fit, fitted.state)


def unless_lines_make_it(going: Trend | None, dwells: DwellTable) -> Trend | None:
    """A trend; None where it is significant and the spectrum has lines, which would make one as well."""
    shown = going is not None and going.p_value < LEVEL
    return None if shown and lines_of(dwells, LEVEL * REST) else going


def trend_beside(linearised: LinearisedDwells, noise: Noise, state: Floats) -> Trend | None:
    """The test of trends in the residuals of a model at ``state`` (p,).

    The ratio is F distributed: its denominator stands for the uncertainty of the noise itself. From n readings, kappa
    is known with a relative variance of (4 kappa - 2) / n, and the intensity of a walk with that of its own estimate.

    linearised: dwells and columns of the model, without those of its last states where these are zero. noise: by which
    it is judged. Returns None where the dwells are averages, where scatter was not stated, or where no dwell has enough
    readings.
    """
    dwells, folded = linearised.dwells, linearised.dwells.folded
    if folded.averaged or not noise.scatter.stated:
        return None
    lengths_s = folded.ends_s[:, 1] - folded.ends_s[:, 0]
    channels = _channels(linearised, noise, state)
    squares, determined = _squares(dwells, _combined(channels, _residuals(linearised, state), dwells))
    spreads = noise.of_means(folded.weights * folded.counts[:, None], folded.correlations)
    by_readings = np.einsum("dci,dij,dcj->dc", channels, spreads, channels)[:, :, None]
    walk_shapes, flicker_shapes = _of_shapes()
    by_walk = noise.walk_mps2_per_sqrt_s[:, None] ** 2 * lengths_s[:, None, None] * walk_shapes
    by_paths = by_walk + noise.scatter.flicker_mps2(len(dwells))[:, None] ** 2 * flicker_shapes
    expected = by_readings + channels**2 @ by_paths + _by_thermometer(linearised, noise, channels)
    ratios = np.where(determined[:, None, :], squares / expected, 0.0)
    count = channels.shape[1] * int(determined.sum())
    if not count:
        return None
    unsure = float(np.mean((4.0 * noise.correlation_length - 2.0) / folded.counts.sum())) / 3.0
    by_walk = channels**2 @ np.broadcast_to(by_walk, by_paths.shape)
    unsure += (2.0 * noise.walk.spread * float(np.mean(by_walk / expected))) ** 2
    ratio = float(ratios.sum() / count)
    shown = np.broadcast_to(determined[:, None, :], squares.shape)
    log_density = _log_density(
        squares[shown],
        (expected - by_walk)[shown],
        by_walk[shown],
        noise.walk.spread,
    )
    return Trend(ratio, f_tail(count, 2.0 / unsure, ratio), ratios.sum(axis=2), folded.numbers, log_density)


def _log_density(squares: Floats, by_noise: Floats, by_walk: Floats, spread: float) -> float:
    """Return the logarithm of the density of coefficients, but for their number, from their squares and their variances
    by noise and by a walk, (n,) each; averaged over the intensity of the walk, of which the logarithm is known to
    ``spread``."""
    places, weights = np.polynomial.hermite_e.hermegauss(_PLACES if spread else 1)
    variances = by_noise + by_walk * np.exp(2.0 * spread * places)[:, None]
    logs = np.log(weights / weights.sum()) - 0.5 * np.sum(squares / variances + np.log(variances), axis=1)
    return float(np.logaddexp.reduce(logs))


def _channels(linearised: LinearisedDwells, noise: Noise, state: Floats) -> Floats:
    """Return the combinations (D, c, 3) of the readings of each dwell that are tested: each reading, less what it
    shares with the others; that along the force alone where attitudes are not known, since a hand creeps and trembles,
    and no rotation changes it."""
    if not noise.attitude_unknown:
        sigmas = noise.effective_sigma_mps2 / np.sqrt(linearised.dwells.folded.weights)
        return sigmas[:, :, None] * _unshared(linearised.dwells.folded.correlations) / sigmas[:, None, :]
    dwells = linearised.dwells_at_state
    return along_force(dwells, sensitivities_of(dwells, state))[:, None]


def _unshared(correlations: Floats) -> Floats:
    """Return the symmetric inverse roots (D, 3, 3) of correlations: of all combinations that are not correlated, those
    nearest to the channels themselves."""
    values, vectors = np.linalg.eigh(correlations)
    return (vectors / np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2)


def _combined(channels: Floats, rows: Floats, dwells: DwellTable) -> Floats:
    """Return the combinations (D, c, 3) of rows of readings (pieces, K, 3, ...), (pieces, K, c, ...)."""
    return np.einsum("pci,pki...->pkc...", np.repeat(channels, dwells.folded.piece_numbers, axis=0), rows)


def _by_thermometer(linearised: LinearisedDwells, noise: Noise, channels: Floats) -> Floats | float:
    """Return the variances (D, c, degrees) of the coefficients that the error of the temperature gives."""
    thermometer, dwells = noise.term(ThermometerError), linearised.dwells
    if thermometer is None:
        return 0.0
    of_errors = basis_coefficients(thermometer.columns(linearised.dwells_at_state, linearised.state))
    of_errors = _combined(channels, of_errors.reshape(*of_errors.shape[:2], 3, -1), dwells)
    squares, _ = _squares(dwells, _on_triangles(dwells, of_errors.reshape(*of_errors.shape[:2], -1)))
    return squares.reshape(*channels.shape[:2], -1, _DEGREE).sum(axis=2)


def _residuals(linearised: LinearisedDwells, state: Floats) -> Floats:
    """Return the residuals (pieces, K, 3) of all dwells on the rows of their triangles."""
    dwells, columns = linearised.dwells_at_state, of_all_pieces(linearised.columns)
    width = dwells.folded.width
    of_model = _on_triangles(dwells, on_basis(columns @ state[: columns.shape[-1]]))
    return dwells.triangles[:, :width, width:] - of_model


def _on_triangles(dwells: DwellTable, coefficients: Floats) -> Floats:
    """Return the rows (pieces, K, c) of functions of time with these coefficients (pieces, K, c) on the basis
    functions."""
    width = dwells.folded.width
    return dwells.triangles[:, :width, :width] @ coefficients


def _squares(dwells: DwellTable, rows: Floats) -> tuple[Floats, Mask]:
    """Return the squared coefficients (D, c, degrees) of rows (pieces, K, c) on the shapes of a trend, scaled to mean
    square 1, and a mask (D, degrees) of the degrees that the readings of each dwell determine."""
    folded = dwells.folded
    squares, determined = np.zeros((len(dwells), rows.shape[2], _DEGREE)), np.zeros((len(dwells), _DEGREE), bool)
    for alike in folded.shapes:
        frame, shown = _trends_in(dwells, alike)
        along = np.swapaxes(rows[alike.pieces].reshape(len(frame), -1, rows.shape[2]), 1, 2) @ frame
        squares[alike.dwells, :, : frame.shape[2]] = along**2 / folded.counts[alike.dwells, None, None]
        determined[alike.dwells, : frame.shape[2]] = shown
    return squares, determined


def _trends_in(dwells: DwellTable, alike: AlikeDwells) -> tuple[Floats, Mask]:
    """Return orthonormal columns (d, r, k) on the triangle rows of dwells of one shape, one column for each degree
    from one up, and a mask (d, k) of the degrees that each dwell determines.
    """
    folded = dwells.folded
    ends, counts = folded.ends_s[alike.dwells], folded.counts[alike.dwells]
    lengths, at = ends[:, 1] - ends[:, 0], folded.elapsed_s.reshape(-1, 3)[alike.pieces]
    from_start = (at - ends[:, 0, None, None]) / np.where(lengths > 0.0, lengths, 1.0)[:, None, None]
    basis = dwells.triangles[alike.pieces, : folded.width, :3]
    rows = basis @ on_basis(shapes(2.0 * from_start - 1.0))
    frame, upper = np.linalg.qr(rows.reshape(len(rows), -1, rows.shape[3]))
    determined = np.abs(np.einsum("dkk->dk", upper[:, :, : upper.shape[1]])) > SEEN * np.sqrt(counts)[:, None]
    determined &= (lengths > 0.0)[:, None]
    return frame[:, :, 1:], determined[:, 1:]


def p_of_steady_oscillation(fitted: Fit) -> float:
    """The p-value of an oscillation that goes on alike in all dwells, against one of another amplitude or phase in any.

    The sine and cosine of the oscillation, and their derivative by its frequency, are added in one dwell alone, beside
    a constant of that dwell, so that only the course of its readings counts. The decrease of chi-squared is chi-squared
    distributed if the oscillation goes on alike in all dwells. What does not is creep, a chirp, or a disturbance.

    fitted: a fit whose model has an oscillation. Its random walk of the biases, if it has one, is left out here.
    """
    linearised, noise = fitted.linearised, fitted.noise.for_goodness_of_fit.without(RandomWalk)
    model, dwells = linearised.model, linearised.dwells_at_state
    effect = model.oscillation
    assert effect is not None
    places = [*BIASES, *np.arange(model.count)[model.parts[str(effect)]].tolist()]
    rows, width = misfit_rows(dwells, linearised.columns, noise, linearised.state, model.count, reduced=False)
    stacked = np.concatenate(rows)
    basis = orthonormal(scale_columns(stacked[:, : width + 1])[0][:, :width])[0]
    left = stacked[:, -1] - basis @ (basis.T @ stacked[:, -1])
    first, p_values = len(stacked) - sum(map(len, rows[-len(dwells) :])), list[float]()
    for of_dwell in rows[-len(dwells) :]:
        part = slice(first, first := first + len(of_dwell))
        p_values.append(_p_of_columns(of_dwell[:, places], basis[part], left[part]))
    return sidak(min(p_values), len(p_values))


def _p_of_columns(columns: Floats, basis: Floats, left: Floats) -> float:
    """Return the p-value of the decrease of chi-squared if the columns of one dwell (r, 3 + q), the first three of them
    constants, are added to a model; basis (r, p): the dwell's rows of an orthonormal basis of this model; left (r,):
    what the model leaves of the dwell's readings."""
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(sizes > 0.0, sizes, 1.0)
    inside, along = basis.T @ columns, columns.T @ left
    gram = columns.T @ columns - inside.T @ inside
    constants = gram[3:, :3] @ np.linalg.pinv(gram[:3, :3], rcond=SEEN, hermitian=True)
    values, vectors = np.linalg.eigh(gram[3:, 3:] - constants @ gram[:3, 3:])
    seen = values > SEEN
    delta_chi2 = np.sum((vectors[:, seen].T @ (along[3:] - constants @ along[:3])) ** 2 / values[seen])
    return chi_squared_tail(int(seen.sum()), float(delta_chi2)) if seen.any() else 1.0
