"""Calibration without angles: of each dwell only the size of the specific force is known, |f| = g.

Nothing is known of the attitude of a dwell, nor that it stays the same within the dwell, and of the three readings one
combination is left that no rotation changes (``rotations.along_force``); force and state are found in turn
(``attitude``, ``fit``). This module says what the poses of such a run determine, and which pose would tell more.

A common rotation of all axes shows in no |f|. The frame is therefore that of the sensors: accelerometer 1 is its x
axis, accelerometer 2 lies in its plane of x and y. Nine parameters are left: three scale factors, three biases, and
three angles between the axes. Where the poses do not tell the three angles (six faces do not), the axes are taken for
square, and the uncertainty of that enters the covariance (considered parameters, Schmidt).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.errors import UnobservableError
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.estimate import HOPELESS
from kf_calib.estimation.kalman_filterpy import Samples
from kf_calib.estimation.measurement_model import FRAME, SQUARE, Model
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise

DIRECTIONS: dict[str, Floats] = {
    " ".join(f"{'+' if sign > 0 else '-'}{axis}" for sign, axis in zip(signs, "xyz", strict=True) if sign): (
        np.array(signs, float) / np.linalg.norm(signs)
    )
    for signs in sorted(itertools.product((0, 1, -1), repeat=3), key=np.count_nonzero)
    if any(signs)
}
"""Faces, edges and corners of a cube by the axes that point up."""

_NINE = [k for k in range(STATE_COUNT) if k not in FRAME]


def weights_of_size(means: Means, state: Floats) -> Floats:
    """The weights (D, 3) n = S^-T f / g of the three readings in |f|."""
    sensitivity = state[:STATE_COUNT].reshape(3, 4)[:, :3]
    unit = means.force_mps2 / np.linalg.norm(means.force_mps2, axis=1, keepdims=True)
    return np.asarray(np.linalg.solve(sensitivity.T, unit.T).T, float)


def regressors_of(means: Means) -> Floats:
    """The columns (D, 3, 12) of all twelve states, those that are fixed as well."""
    regressors = np.zeros((len(means.counts), 3, STATE_COUNT))
    for i in range(3):
        regressors[:, i, 4 * i : 4 * i + 3], regressors[:, i, 4 * i + 3] = means.force_mps2, 1.0
    return regressors


def covariance_of(linearised: LinearisedDwells, noise: Noise, square_rad: float | Floats = 1.0) -> Floats:
    """Covariance (12, 12) that the dwells give of the nine parameters, with weak knowledge of each: 100 % of a scale
    factor, 10 m/s^2 of a bias, and ``square_rad`` of each angle between axes, of all or of each of ``SQUARE``."""
    means = linearised.means
    across = weights_of_size(means, linearised.state)
    design = np.einsum("di,dip->dp", across, regressors_of(means))
    spreads = noise.of_means(means.counts, means.correlations) + np.diag(noise.scatter_mps2**2)
    variance = np.einsum("di,dij,dj->d", across, spreads, across)
    nine = np.ix_(_NINE, _NINE)
    known = np.diag(weak_covariance(square_rad).diagonal()[_NINE] ** -0.5)
    rows = np.vstack([design[:, _NINE] / np.sqrt(variance)[:, None], known])  # their squares would lose what is weak
    root = np.linalg.inv(np.linalg.qr(rows, mode="r"))
    out = np.zeros((STATE_COUNT, STATE_COUNT))
    out[nine] = root @ root.T
    return out


def weak_covariance(square_rad: float | Floats = 1.0) -> Floats:
    """Covariance (12, 12) of the nine parameters before any dwell, see ``covariance_of``; zeros for the frame."""
    sizes = np.ones(STATE_COUNT)
    sizes[3::4], sizes[[*SQUARE.values()]], sizes[list(FRAME)] = 10.0, square_rad, 0.0
    return np.diag(sizes**2)


def row_of(up: str, state: Floats, gravity_mps2: float) -> tuple[Floats, Floats]:
    """The change (12,) of |f| per unit of each state if these axes point up, and the weights (3,) of the channels in
    it."""
    row, affine = np.zeros(STATE_COUNT), state[:STATE_COUNT].reshape(3, 4)
    across = np.linalg.solve(affine[:, :3].T, DIRECTIONS[up])
    row.reshape(3, 4)[:] = across[:, None] * np.append(gravity_mps2 * DIRECTIONS[up], 1.0)
    return row, np.asarray(across, float)


def untold_angles(linearised: LinearisedDwells, noise: Noise) -> tuple[str, ...]:
    """The angles between the axes, of ``SQUARE``, that the dwells tell no better than they are known to be square.

    The one that is told worst is taken for square first, which may tell others.
    """
    known_rad, sigma_rad = linearised.model.bench.square_rad, np.ones(len(SQUARE))
    scale = linearised.state[:STATE_COUNT].reshape(3, 4)[:, :3].diagonal()[[1, 2, 2]]
    for _ in SQUARE:
        variances = np.diag(covariance_of(linearised, noise, sigma_rad))[[*SQUARE.values()]] / scale**2
        worst = int(np.argmax(np.where(sigma_rad == 1.0, variances, 0.0)))
        if sigma_rad[worst] != 1.0 or variances[worst] < known_rad**2:
            break
        sigma_rad[worst] = known_rad
    return tuple(angle for angle, sigma in zip(SQUARE, sigma_rad, strict=True) if sigma != 1.0)


def square_sigmas(model: Model, state: Floats) -> Floats | None:
    """One sigma (3, 3) of the sensitivity of each channel to the force along each axis, by the angles that are taken
    for square; None where there are none."""
    sigmas, affine = np.zeros((3, 3)), state[:STATE_COUNT].reshape(3, 4)
    for channel, axis in (divmod(SQUARE[angle], 4) for angle in model.square):
        sigmas[channel, axis] = affine[channel, channel] * model.bench.square_rad
    return sigmas if model.square else None


def undetermined(covariance: Floats) -> list[str]:
    """The scale factors and biases that are not determined at all, by the covariance (12, 12)."""
    sigma = np.sqrt(covariance.diagonal()).reshape(3, 4)
    poor = [f"K{i + 1}" for i in range(3) if sigma[i, i] > HOPELESS["1"]]
    return poor + [f"b{i + 1}" for i in range(3) if sigma[i, 3] > HOPELESS["m/s^2"]]


def refuse_poses(linearised: LinearisedDwells, noise: Noise) -> None:
    """Raise UnobservableError if the poses do not determine every scale factor and bias, and say which is missing."""
    covariance = covariance_of(linearised, noise, linearised.model.bench.square_rad)
    if poor := undetermined(covariance):
        dwells = len(linearised.dwells)
        up = most_informative(covariance, linearised.state, linearised.model.bench.gravity_mps2)
        raise UnobservableError(
            f"{dwells} pose{'s do' if dwells != 1 else ' does'} not determine {', '.join(poor)}: turn it so that "
            f"{up_in_words(up)}, hold it still, and go on until each axis has pointed up and down."
        )


def next_in_words(linearised: LinearisedDwells, noise: Noise) -> str:
    """Which axes should point up next, in words."""
    covariance = covariance_of(linearised, noise, linearised.model.bench.square_rad)
    return up_in_words(most_informative(covariance, linearised.state, linearised.model.bench.gravity_mps2))


def up_in_words(up: str) -> str:
    """A direction of ``DIRECTIONS`` in words."""
    axes = [(str("xyz".index(axis) + 1), "up" if sign == "+" else "down") for sign, axis in up.split()]
    if len(axes) == 1:
        return f"the axis of accelerometer {axes[0][0]} points {axes[0][1]}"
    *most, last = [f"{number} ({way})" for number, way in axes]
    return f"the axes of accelerometers {', '.join(most)} and {last} are equally far from the vertical"


def most_informative(covariance: Floats, state: Floats, gravity_mps2: float) -> str:
    """The axes that should point up next: of the faces, edges and corners of a cube, the direction in which |f| is
    known worst; of equal ones the one with fewer axes."""
    best, worst = "", 0.0
    for name in DIRECTIONS:
        row, _ = row_of(name, state, gravity_mps2)
        spread = float(row @ covariance @ row)
        if spread > 1.1 * worst:
            best, worst = name, spread
    return best


def holding_frame(samples: Iterable[Samples], linearised: LinearisedDwells, noise: Noise) -> Iterator[Samples]:
    """Yield first a reading of each state that is fixed at zero, times g, then the samples."""
    fixed, samples = linearised.model.fixed, iter(samples)
    if fixed:
        first = next(samples)
        observation = np.zeros((len(fixed), 1, linearised.model.count))
        observation[np.arange(len(fixed)), 0, list(fixed)] = linearised.model.bench.gravity_mps2
        number, start_s = linearised.dwells[0].number, np.full(len(fixed), linearised.dwells[0].start_s)
        none, readings = np.zeros((len(fixed), 1, first.nuisances.shape[2])), np.zeros((len(fixed), 1))
        root_mps2 = noise.effective_sigma_mps2[:1, None]
        yield Samples(number, start_s, observation, none, readings, np.zeros((len(fixed), 3)), root_mps2)
        yield first
    yield from samples
