"""The reference engine: filterpy's Kalman filter, applied sample by sample as in a textbook.

The rows of a recording sample by sample come from a second pass; batch least squares takes the same.

The state is in units of m/s^2 (g s_i, b_i, effects) and is followed by the nuisance states of the current dwell, which
are reset to their prior at each new dwell. filterpy's square-root form is used, because its plain form loses digits of
the covariance after tens of thousands of static samples with a wide prior (``form="plain"`` shows this).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import BIASES
from kf_calib.dwells.rows import Rows, basis, on_basis
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.dwell_columns import LinearisedDwells, turning_mps2
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.rotations import along_force, sensitivities_of


@dataclass(frozen=True)
class Samples:
    """Rows of one piece, sample by sample.

    - dwell: number of the dwell; moving: True for the slew after it.
    - elapsed_s (n,): times of the samples.
    - observation (n, c, p): the design H of the c channels: three accelerometers, or the size of the force alone where
      attitudes are not known.
    - nuisances (n, c, q): the columns of the dwell's nuisance states, each of unit variance before the dwell.
    - readings (n, c): the readings.
    - residual_mps2 (n, 3): the readings of the accelerometers less their prediction by the state of the linearisation.
    - root_mps2 (c, c): lower root of the covariance of white readings with the same covariance of their mean.
    """

    dwell: int
    elapsed_s: Floats
    observation: Floats
    nuisances: Floats
    readings: Floats
    residual_mps2: Floats
    root_mps2: Floats
    moving: bool = False

    def along(self, weights: Floats) -> Samples:
        """The samples of one combination of the three channels, with weights (3,)."""
        return replace(
            self,
            observation=np.einsum("i,nip->np", weights, self.observation)[:, None],
            nuisances=np.einsum("i,niq->nq", weights, self.nuisances)[:, None],
            readings=(self.readings @ weights)[:, None],
            root_mps2=np.array([[np.linalg.norm(weights @ self.root_mps2)]]),
        )


def samples_of(rows: Iterable[Rows], linearised: LinearisedDwells, noise: Noise) -> Iterator[Samples]:
    """Yield samples from a second pass over the rows, with the columns of the first."""
    every, columns = linearised.dwells_at_state, [*linearised.columns, *linearised.slew_columns]
    if linearised.slews:
        every = every.beside(DwellTable.of(linearised.slews))
    keys = zip(every.folded.numbers.tolist(), every.folded.moving.tolist(), strict=True)
    known = {key: (every[k : k + 1], columns[k]) for k, key in enumerate(keys)}
    for block in rows:
        if (block.dwell, block.moving) not in known:
            continue
        dwell, columns_of_pieces = known[block.dwell, block.moving]
        changes = noise.columns("dwell", dwell, linearised.state)
        sensitivities = sensitivities_of(dwell, linearised.state)
        along = along_force(dwell, sensitivities)[0] if noise.attitude_unknown else None
        for part, at_nodes, by_errors in zip(block.pieces, columns_of_pieces, changes, strict=True):
            u = block.u[part]
            functions = basis(u, block.elapsed_s[part], linearised.carrier_hz)
            observation, nuisances = _at_samples(functions, at_nodes), _at_samples(functions, by_errors)
            regressors, readings = block.columns[part], block.readings[part]
            if not linearised.model.bench.angles:
                regressors = np.tile(dwell.means[:, :4], (len(u), 1))
            if dwell.attitudes is not None or dwell.turned_rad is not None:
                force = dwell.felt(regressors[:, 1:], len(u))
                readings = readings + turning_mps2(dwell, force, linearised.state, len(u))
            folded = dwell.folded
            root_mps2 = np.linalg.cholesky(noise.of(block.moving).of_means(folded.weights, folded.correlations)[0])
            residual_mps2 = readings - observation @ linearised.state
            samples = Samples(
                block.dwell, block.elapsed_s[part], observation, nuisances, readings, residual_mps2, root_mps2,
                block.moving,
            )  # fmt: skip
            yield samples.along(along) if along is not None else samples


def _at_samples(functions: Floats, at_nodes: Floats) -> Floats:
    """Return columns (n, 3, q) at samples with the basis functions (K, n) from those at the nodes (k, 3, q), k <= K."""
    count = len(at_nodes)
    values = functions[:count].T @ on_basis(at_nodes.reshape(count, at_nodes[0].size))
    return values.reshape(len(values), *at_nodes.shape[1:])


_DIFFUSE = 1e5
"""Sigma of a diffuse prior, in sigmas of one reading: wide enough not to bias, narrow enough for double precision."""


@dataclass(frozen=True)
class Posterior:
    """State (p,), covariance (p, p), the sum of the samples' normalised innovations squared, and the number of
    samples."""

    state: Floats
    covariance: Floats
    nis: float
    samples: int


def estimate(
    samples: Iterable[Samples],
    noise: Noise,
    nominal_state: Floats,
    prior_covariance: Floats | None,
    scale: Floats,
    form: Literal["square-root", "plain"] = "square-root",
    on_dwell: Callable[[Floats], None] | None = None,
) -> Posterior:
    """Run the filter over all samples and return the posterior.

    - nominal_state (p,): mean of the prior; prior_covariance (p, p): None for a diffuse prior.
    - scale (p,): approximate change of a reading per unit of each state, m/s^2.
    - form: which of filterpy's filters is used.
    - on_dwell: called with the state (p,) after each dwell and the slew that follows it.

    The biases walk with the intensity in ``noise`` from reading to reading (process noise Q).
    """
    count = len(nominal_state)
    if prior_covariance is None:
        setting_mps2 = 0.0 if noise.attitude_unknown else scale[0] * noise.setting_rad
        widest = max(noise.effective_sigma_mps2.max(), noise.scatter_mps2.max(), setting_mps2)
        root = _DIFFUSE * widest * np.eye(count)
    else:
        root = np.linalg.cholesky(prior_covariance * np.outer(scale, scale))
    samples = iter(samples)
    first = next(samples)
    kf = _Filter(form, nominal_state * scale, root, *first.nuisances.shape[:0:-1])
    place, nis, done, previous_s = (-1, False), 0.0, 0, math.nan
    for piece in itertools.chain([first], samples):
        if (piece.dwell, piece.moving) != place:
            if on_dwell is not None and done and not piece.moving:
                on_dwell(kf.state() / scale)
            kf.enter_dwell()
            place = (piece.dwell, piece.moving)
        kf.set_noise(piece.root_mps2)
        observations = np.concatenate([piece.observation / scale, piece.nuisances], axis=2)
        for observation, reading, now_s in zip(observations, piece.readings, piece.elapsed_s.tolist(), strict=True):
            if noise.walk.steps and now_s > previous_s:
                kf.walk(noise.walk_mps2_per_sqrt_s**2 * (now_s - previous_s))
            previous_s = now_s
            nis += kf.update(observation, reading)
        done += len(piece.readings)
    state, covariance = kf.posterior()
    if on_dwell is not None:
        on_dwell(state / scale)
    return Posterior(state / scale, covariance / np.outer(scale, scale), nis, done)


def repeated(
    observations: Floats, readings: Floats, sigma_mps2: float, start: Floats, start_root: Floats
) -> tuple[Floats, Floats]:
    """Final states (p, r) of r repetitions of one experiment, and the covariance (n, p, p) after every sample.

    The observations (n, m, p) and the prior, ``start`` (p,) with covariance L L^T, L = ``start_root`` (p, p), are the
    same in all repetitions; therefore the gains and covariances are, too, and filterpy's filter runs once with one
    column of its state for each repetition. ``readings`` is (n, m, r).
    """
    from filterpy.kalman import SquareRootKalmanFilter

    samples, channels, count = observations.shape
    kf: Any = SquareRootKalmanFilter(dim_x=count, dim_z=channels)
    kf.x = np.repeat(start[:, None], readings.shape[2], axis=1)
    kf._P1_2, kf._R1_2 = start_root, sigma_mps2 * np.eye(channels)  # setters would lose half the digits
    covariances = np.empty((samples, count, count))
    for k in range(samples):
        kf.H = observations[k]
        kf.update(readings[k])
        covariances[k] = kf.P
    return kf.x, covariances


class _Filter:
    """Either of filterpy's two filters behind a common interface."""

    def __init__(
        self, form: str, state: Floats, root: NDArray[np.floating[Any]], nuisances: int, channels: int
    ) -> None:
        from filterpy.kalman import KalmanFilter, SquareRootKalmanFilter

        self.plain = form == "plain"
        self.count = len(state)
        size = self.count + nuisances
        kf: Any = (KalmanFilter if self.plain else SquareRootKalmanFilter)(dim_x=size, dim_z=channels)
        kf.x = np.concatenate([state, np.zeros(nuisances)])  # 1-D: a column would broadcast to (n, 3)
        full = np.zeros((size, size))
        full[: self.count, : self.count] = root
        if self.plain:
            kf.P = full @ full.T
        else:
            kf._P1_2 = full  # its setter would square the root and lose half the digits
        self.kf = kf

    def set_noise(self, root_mps2: Floats) -> None:
        """Set the covariance of a reading by its lower root (c, c)."""
        if self.plain:
            self.kf.R = root_mps2 @ root_mps2.T
        else:
            self.kf._R1_2 = root_mps2  # its setter would square the root and lose half the digits

    def enter_dwell(self) -> None:
        """Reset the nuisance states to their prior, independent of everything before."""
        nuisances = slice(self.count, None)
        self.kf.x[nuisances] = 0.0
        matrix = self.kf.P if self.plain else self.kf._P1_2
        matrix[nuisances, :] = 0.0
        matrix[:, nuisances] = (
            0.0  # the root is lower triangular: its leading block is the root of the leading covariance
        )
        matrix[nuisances, nuisances] = np.eye(len(self.kf.x) - self.count)

    def walk(self, variances: Floats) -> None:
        """Do a time update with F = I in which the biases take steps of these variances (3,)."""
        steps = np.zeros(len(self.kf.x))
        steps[BIASES] = variances
        if self.plain:
            self.kf.Q = np.diag(steps)
        else:
            self.kf._Q1_2 = np.diag(np.sqrt(steps))  # the setter needs a positive definite Q
        self.kf.predict()

    def update(self, observation: Floats, reading: Floats) -> float:
        """Update with one sample and return its normalised innovation squared, y' S^-1 y."""
        self.kf.H = observation
        self.kf.update(reading)
        return float(self.kf.y @ self.kf.SI @ self.kf.y)

    def state(self) -> Floats:
        """State without the nuisance states."""
        return self.kf.x[: self.count].copy()

    def posterior(self) -> tuple[Floats, Floats]:
        """State and covariance without the nuisance states."""
        part = slice(0, self.count)
        return self.state(), self.kf.P[part, part].copy()
