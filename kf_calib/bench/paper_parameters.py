"""The paper's twelve parameters and the affine state, from which they follow in closed form.

The reading of accelerometer i is s_i . f + b_i with the sensitivity s_i = K_i E_i. For accelerometers 1 and 3, ``E =
(cos phi cos theta, sin theta, -sin phi cos theta)``; for accelerometer 2, ``E = (sin nu1, sqrt(1 - sin^2 nu1 - sin^2
nu2), -sin nu2)`` (M. D. Grebenkin, Vestnik MEPhI 8(3), 2019, eq. 1-6). The y component of E_2 is always positive, so
that an accelerometer 2 of opposite direction has a negative K2; parameters and state then determine each other
uniquely.

The order of the state is s1x s1y s1z b1, s2x s2y s2z b2, s3x s3y s3z b3. Angles are in rad, K has no unit, b is in
m/s^2.

The sigmas that a run is to reach are stated as targets, ``NAME=SIGMA``. NAME: a parameter (``theta1``, ``K2``), all of
a kind (``theta``, ``phi``, ``nu``, ``K``, ``b``) or ``angles``. SIGMA: a number with a unit (``2ppm``, ``20ug``,
``0.1 arcsec``), or in SI without one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.errors import BenchError, InputError, how_to_write
from kf_calib.support import units

SYMBOLS = ("theta1", "phi1", "K1", "b1", "nu1", "nu2", "K2", "b2", "theta3", "phi3", "K3", "b3")
STATE_COUNT = len(SYMBOLS)
STATES = tuple(f"{part}{i}" for i in (1, 2, 3) for part in ("sx", "sy", "sz", "b"))
"""Names of the affine state: reading i = sx_i f_x + sy_i f_y + sz_i f_z + b_i."""
BIASES = [3, 7, 11]
"""Indices of the three biases in the affine state (s1, b1, s2, b2, s3, b3)."""
UNITS = ("rad", "rad", "1", "m/s^2") * 3
NOMINAL: dict[str, float] = dict.fromkeys(SYMBOLS, 0.0) | {
    "theta1": math.radians(0.5), "theta3": math.radians(0.5), "phi3": -math.pi / 2, "K1": 1.0, "K2": 1.0, "K3": 1.0,
}  # fmt: skip
DEVIATIONS = np.tile([math.radians(30 / 3600), math.radians(30 / 3600), 5e-5, 5e-5], 3)
"""Deviations (12,) from nominal that the paper's experiment has to find, its Table 1: rad, rad, 1, m/s^2."""


def nominal(differing: Mapping[str, float] | None = None) -> Floats:
    """The nominal parameters (12,): the paper's, except for those given (rad, 1, m/s^2); raises BenchError for an
    unknown symbol."""
    unknown = sorted(set(differing or ()) - set(SYMBOLS))
    if unknown:
        raise BenchError(f"nominal names {unknown[0]!r}, which is no parameter: use {', '.join(SYMBOLS)}.")
    values = NOMINAL | dict(differing or {})
    return np.array([values[symbol] for symbol in SYMBOLS])


def state_of(parameters: Floats) -> Floats:
    """The affine state (12,) of the paper's parameters (12,)."""
    state = np.empty(12)
    for i, (p1, p2, scale, bias) in enumerate(np.reshape(parameters, (3, 4))):
        state[4 * i : 4 * i + 3] = scale * _axis(i, p1, p2)
        state[4 * i + 3] = bias
    return state


def _axis(i: int, p1: float, p2: float) -> Floats:
    """Return the unit vector E of accelerometer i (from 0) from its two angles."""
    if i == 1:
        return np.array([math.sin(p1), math.sqrt(1 - math.sin(p1) ** 2 - math.sin(p2) ** 2), -math.sin(p2)])
    return np.array([math.cos(p2) * math.cos(p1), math.sin(p1), -math.sin(p2) * math.cos(p1)])


def parameters_of(state: Floats) -> Floats:
    """The paper's parameters (..., 12) of affine states (..., 12).

    This inverts ``state_of`` for any direction of the axes: K1 and K3 are positive, and K2 has the sign of s2y.
    """
    parameters = np.empty_like(state)
    for i in range(3):
        s = state[..., 4 * i : 4 * i + 3]
        scale = np.linalg.norm(s, axis=-1)
        if i == 1:
            scale = np.copysign(scale, s[..., 1])
        x, y, z = np.moveaxis(s / scale[..., None], -1, 0)
        angles = (np.arcsin(x), -np.arcsin(z)) if i == 1 else (np.arcsin(y), np.arctan2(-z, x))
        parameters[..., 4 * i], parameters[..., 4 * i + 1] = angles
        parameters[..., 4 * i + 2], parameters[..., 4 * i + 3] = scale, state[..., 4 * i + 3]
    return parameters


def frame_turn(state: Floats, reference: Floats) -> Floats:
    """The small rotation (3,) in rad of the platform's frame that brings an affine state (12,) nearest to another.

    A frame turned by w has the sensitivities s_i + s_i × w, so that w solves Σ |s_i + s_i × w − r_i|² = min. Which
    frame the platform's angles refer to is a choice, and turns all three axes alike.
    """
    axes, wanted = (each.reshape(3, 4)[:, :3] for each in (state, reference))
    crossed = np.cross(axes[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)  # s × w is this matrix times w
    solved = np.linalg.lstsq(crossed.reshape(9, 3), (wanted - axes).ravel(), rcond=None)[0]
    return np.asarray(solved, np.float64)


def turned(state: Floats, turn_rad: Floats) -> Floats:
    """The affine state (12,) in a platform's frame that is turned by a small rotation (3,)."""
    result = state.copy().reshape(3, 4)
    result[:, :3] += np.cross(result[:, :3], turn_rad)
    return result.ravel()


def jacobian(state: Floats) -> Floats:
    """The Jacobian d parameters / d state (12, 12) at an affine state in closed form, by which covariances are
    transformed."""
    derivatives = np.zeros((12, 12))
    for i in range(3):
        rows = slice(4 * i, 4 * i + 4)
        s = state[4 * i : 4 * i + 3]
        scale = math.copysign(np.linalg.norm(s), s[1] if i == 1 else 1.0)
        axis = s / scale
        block = np.eye(4)
        if i == 1:
            block[0, :3] = _arcsine_gradient(axis, 0) / scale
            block[1, :3] = -_arcsine_gradient(axis, 2) / scale
        else:
            block[0, :3] = _arcsine_gradient(axis, 1) / scale
            block[1, :3] = np.array([axis[2], 0.0, -axis[0]]) / (scale * (axis[0] ** 2 + axis[2] ** 2))
        block[2, :3] = axis
        derivatives[rows, rows] = block
    return derivatives


def _arcsine_gradient(axis: Floats, k: int) -> Floats:
    """Return the gradient of asin(s_k / K) with respect to s, times K, where ``axis`` = s / K."""
    return (np.eye(3)[k] - axis[k] * axis) / math.sqrt(1 - axis[k] ** 2)


def sensitivity_jacobian(parameters: Floats) -> Floats:
    """The Jacobian d state / d parameters (12, 12) in closed form; its blocks are the transposes of the paper's H (see
    ``h_rows``)."""
    derivatives = np.zeros((12, 12))
    for i, (p1, p2, scale, _) in enumerate(np.reshape(parameters, (3, 4))):
        c1, s1, c2, s2 = math.cos(p1), math.sin(p1), math.cos(p2), math.sin(p2)
        axis = _axis(i, p1, p2)
        if i == 1:
            first, second = (c1, -c1 * s1 / axis[1], 0.0), (0.0, -c2 * s2 / axis[1], -c2)
        else:
            first, second = (-c2 * s1, c1, s2 * s1), (-s2 * c1, 0.0, -c2 * c1)
        block = np.eye(4)
        block[:3, :3] = np.column_stack([scale * np.array(first), scale * np.array(second), axis])
        derivatives[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = block
    return derivatives


def h_rows(parameters: Floats) -> Floats:
    """The paper's H (3, 3, 3), eq. 8-10: the rows d(KE)/dp1, d(KE)/dp2 and E of each accelerometer.

    The printed formulas differ in these points, each checked by finite differences in tests/test_paper_experiment.py:

    - (5) has g_j on the right-hand side again, although the left-hand side is the reading less g_j.
    - (8): d E_z / d theta and d E_z / d phi have the sign of the opposite Z axis; the row of K has the right one.
    - (9): the root sqrt(1 - sin nu1 - sin nu2) lacks the squares.
    - (10): both derivatives of E_z have a sqrt(1 - sin^2 psi3) where sqrt(1 - cos^2 psi3) = -sin psi3 is meant, as in
      its row of K: at psi3 = -90 deg d E_z / d theta is 0 instead of -sin theta3, d E_z / d phi is 0/0 instead of 0.
      The paper's figures were not computed in this way, since K3 of Table 2 would be off by 2.5 %.
    - psi is phi; Table 1 names nu2 a second nu1, and has 30 arcsec as the nominal value of both, where (3) has 0.
    """
    jacobian = sensitivity_jacobian(parameters)
    return np.stack([jacobian[4 * i : 4 * i + 3, 4 * i : 4 * i + 3].T for i in range(3)])


def design(force_mps2: Floats, parameters: Floats) -> Floats:
    """The paper's D (3, n, 4), eq. 6-7: the derivatives [H f, 1] of each accelerometer's readings by (p1, p2, K, b).

    ``force_mps2`` is the specific force at each reading of each accelerometer (3, n, 3), or the same for all three (n,
    3).
    """
    slopes = np.broadcast_to(force_mps2, (3, *np.shape(force_mps2)[-2:])) @ h_rows(parameters).transpose(0, 2, 1)
    return np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=2)


def optimal_directions(parameters: Floats) -> Floats:
    """The paper's optimal set: unit vectors (3, 4, 3) of the specific force in four orientations for each
    accelerometer.

    Along h2 x h3, h1 x h3 and h1 x h2, the reading depends on only one of the three parameters; the fourth direction is
    opposite to the third.
    """
    h1, h2, h3 = np.moveaxis(h_rows(parameters), 1, 0)
    along = np.stack([np.cross(h2, h3), np.cross(h1, h3), np.cross(h1, h2)], axis=1)
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    return np.concatenate([along, -along[:, 2:]], axis=1)


def targets_of(texts: Iterable[str]) -> dict[str, float]:
    """Sigma wanted by symbol, in SI; of several for one parameter the last counts. Raises InputError."""
    targets = dict[str, float]()
    for text in texts:
        name, equals, size = text.partition("=")
        parameters = [k for k, symbol in enumerate(SYMBOLS) if name.strip() in _names_of(symbol)]
        if not equals or not parameters:
            raise InputError(
                f"target {text!r} names no parameter: write NAME=SIGMA, for example K=2ppm, with NAME one of "
                f"{', '.join(SYMBOLS)}, or theta, phi, nu, K, b or angles for all of a kind."
            )
        sigma = _sigma(text, size, UNITS[parameters[0]])
        targets |= {SYMBOLS[k]: sigma for k in parameters}
    return targets


def _names_of(symbol: str) -> set[str]:
    """Return the names of a parameter: its symbol, its symbol without number, and ``angles`` for an angle."""
    kind = symbol.rstrip("123")
    return {symbol, kind, *([] if kind in ("K", "b") else ["angles"])}


def _sigma(text: str, size: str, unit: str) -> float:
    """Return the size in SI of a sigma."""
    try:
        value = units.quantity(size, unit)
    except InputError:
        value = 0.0
    if value <= 0.0:
        raise InputError(
            f"target {text!r} has no sigma above zero that fits: give a number in one of "
            f"{', '.join(units.choices(unit))}{how_to_write(size)}."
        )
    return value
