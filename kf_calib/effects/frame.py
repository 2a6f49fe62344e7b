"""What bends the reference: tilt of the base, encoders, gimbal axes, drift of the platform, wrong gravity; what shows
only while the platform turns: the time a reading was taken, and where each accelerometer sits.
"""

from __future__ import annotations

import copy
import re
from abc import abstractmethod
from collections.abc import Collection
from typing import Self

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.effects.effect import PAIRS, Bearer, Coefficient, Effect, Regressor, Typical, interleaved, of_each
from kf_calib.effects.stimulus import Stimulus
from kf_calib.errors import InputError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2


class RotationEffect(Effect):
    """The platform stands otherwise than its angles say; ``rotations`` (m, q, 3), rad per unit, in the platform frame.

    A rotation vector rho changes the specific force f to exp([rho]) f. About a force that is turned by ``turned_rad``
    already, a little more of each coefficient turns it by J(rho) alpha x f, J the left Jacobian of rotations, and
    reading i changes by s_i times that. Where no angles are used, nothing is said of how the platform stands, and it
    has no columns.
    gimbal: number from 0 of the one whose angle is wrong; None of any other error, which may turn about any axis.
    at_zero: symbols of coefficients that it does not have, as other effects of the model do the same (``without``).
    """

    borne_by = Bearer.BENCH
    gimbal: int | None = None
    at_zero: frozenset[str] = frozenset()

    def without(self, symbols: Collection[str]) -> Self:
        """The same effect without those of its coefficients that have one of these symbols, and with all others; one
        that a user gave coefficients of its own has all."""
        if type(self).coefficients is not RotationEffect.coefficients:
            return self
        other = copy.copy(self)
        other.at_zero = frozenset(symbols).intersection(self.symbols)
        other.bearers = () if other.at_zero else self.bearers
        return other

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(each for each in super().coefficients if each.symbol not in self.at_zero)

    def _rotations(self, s: Stimulus) -> Floats:
        """Return the rotations (m, q, 3) of the coefficients that it has."""
        if not self.at_zero:
            return self.rotations(s)
        return self.rotations(s)[:, [k for k, symbol in enumerate(self.symbols) if symbol not in self.at_zero]]

    def shows_in(self, s: Stimulus) -> bool:
        return s.bench.angles and super().shows_in(s)

    @abstractmethod
    def rotations(self, s: Stimulus) -> Floats: ...

    def about(self, s: Stimulus) -> Floats:
        """The axis (m, 3), of unit length, about which an error of its gimbal's angle turns the specific force."""
        assert self.gimbal is not None
        return -s.gimbal_axes[:, self.gimbal]

    def turned_rad(self, s: Stimulus, coefficients: Floats) -> Floats:
        """The rotation vector (m, 3) with these ``coefficients`` (q,), rad."""
        return np.einsum("mqx,q->mx", self._rotations(s), coefficients)

    def added(self, s: Stimulus, coefficients: Floats) -> Floats:
        rho = self.turned_rad(s, coefficients)
        change = _left_jacobian(rho, np.cross(rho, s.force_mps2)[:, None])[:, 0]  # J(rho) rho x f = exp([rho]) f - f
        return change @ s.sensitivity.T if self.shows_in(s) else np.zeros((len(s), 3))

    def columns(self, s: Stimulus) -> Floats:
        rotations = _turned_along(s.attitude_rad, _left_jacobian(s.turned_rad, self._rotations(s)))
        turned = np.cross(rotations, s.force_mps2[:, None, :])
        return np.einsum("mqx,ix->miq", turned, s.sensitivity)


def _turned_along(alpha: Floats, vectors: Floats) -> Floats:
    """Vectors v (m, q, 3) turned by small rotation vectors alpha (m, 3) or (1, 3), to their square."""
    if not alpha.any():
        return vectors
    once = np.cross(alpha[:, None, :], vectors)
    return vectors + once + 0.5 * np.cross(alpha[:, None, :], once)


def _left_jacobian(rho: Floats, vectors: Floats) -> Floats:
    """J(rho) v of vectors v (m, q, 3) and rotation vectors rho (m, 3) or (1, 3) of length r, by series to r^4.

      J = 1 + (1 - cos r) / r^2 [rho] + (r - sin r) / r^3 [rho]^2, the mean of exp(t [rho]) over 0 < t < 1

    exp([rho + d]) = exp([J(rho) d]) exp([rho]) for small d (J. Sola et al., 2018).
    """
    if not rho.any():
        return vectors
    squares = np.sum(rho**2, axis=1)[:, None, None]
    once = np.cross(rho[:, None, :], vectors)
    twice = np.cross(rho[:, None, :], once)
    first, second = 1 / 2 - squares / 24 + squares**2 / 720, 1 / 6 - squares / 120 + squares**2 / 5040
    return vectors + first * once + second * twice


class BaseTilt(RotationEffect):
    """A base turned by (delta_N, delta_E): the specific force turns the other way in it."""

    family = "base and platform"
    name, title, source = "base-tilt", "tilt of the base", "geometry of the bench"
    confused_with = "about the outer axis it is the outer encoder's zero"
    typical = Typical((5e-6, 500e-6))
    symbols, unit, scale = ("deltaN", "deltaE"), "rad", 1e-3
    bearers = interleaved(2)

    def rotations(self, s: Stimulus) -> Floats:
        return -s.level_in_platform

    def degeneracy(self, bench: Bench) -> str:
        return "about the outer gimbal axis, a tilt of the base is exactly the zero of the outer encoder"


class BaseTiltDrift(BaseTilt):
    """The same, growing with t."""

    name, title = "base-tilt-drift", "tilt of the base that grows with time"
    confused_with = "scale-drift"
    typical = Typical((1e-6 / 86400, 50e-6 / 86400))
    symbols, unit, scale = ("deltaRateN", "deltaRateE"), "rad/s", 1e-8

    def rotations(self, s: Stimulus) -> Floats:
        return super().rotations(s) * s.elapsed_s[:, None, None]

    def degeneracy(self, bench: Bench) -> str:
        return ""


class PlatformDrift(RotationEffect):
    """The platform turned by omega_d t, three rates in its own frame."""

    family = "base and platform"
    name, title, source = "platform-drift", "drift of the platform", "geometry of the bench"
    borne_by = Bearer.EITHER  # a block that creeps on its mount drifts in the same way
    typical = Typical((np.radians(0.01) / 3600, np.radians(1.0) / 3600))
    symbols, unit, scale = ("omegaX", "omegaY", "omegaZ"), "rad/s", 1e-6
    shown = "deg/h", float(np.degrees(3600.0))
    bearers = interleaved(3)

    def rotations(self, s: Stimulus) -> Floats:
        return -s.elapsed_s[:, None, None] * np.eye(3)


class EarthRotation(RotationEffect):
    """Gravity turning with the Earth in a platform that is held inertially while its angles are taken as base-fixed.

    The coefficient is the share of the Earth's rate, 1 where the platform is truly inertial.
    """

    family = "base and platform"
    name, title, source = "earth-rotation", "rotation of the Earth", "WGS 84, rate of the Earth"
    confused_with = "platform-drift"
    typical = Typical((1.0, 1.0), (1.0, 1.0))
    expected = (1.0, 0.1)  # the direction of north and the latitude are not known better than that on every bench
    symbols, unit, scale, shown = ("earth",), "1", 1.0, ("of Earth's rate", 1.0)

    def rotations(self, s: Stimulus) -> Floats:
        return (s.elapsed_s[:, None] * s.to_platform(s.bench.earth_rate_radps))[:, None, :]


class Flexure(RotationEffect):
    """The platform turns by f x d under the torque of gravity, d the compliance times the offset of its mass."""

    family = "base and platform"
    name, title, source = "flexure", "bending under the torque of gravity", "linear elasticity"
    confused_with = "encoder-harmonic-1, cross-coupling, uneven-flexure; the bias of a sensor that reports the attitude"
    typical = Typical((5e-6 / STANDARD_GRAVITY_MPS2, 100e-6 / STANDARD_GRAVITY_MPS2))
    symbols, unit, scale = ("dX", "dY", "dZ"), "rad s^2/m", 1e-4
    bearers = interleaved(3)

    def rotations(self, s: Stimulus) -> Floats:
        return -np.cross(s.force_mps2[:, None, :], np.eye(3))


class UnevenFlexure(Flexure):
    """The platform turns by c_i (f x d)_i about its axis i, c the compliances about the three axes.

    The coefficients are the products c_i d_j; equal compliances make a flexure.
    """

    name, title = "uneven-flexure", "bending with another stiffness about each axis"
    confused_with = "flexure, cross-coupling, cross-axis-square"
    prior = 0.25  # it contains the flexure, from which readings alone tell it apart only by the price of coefficients
    symbols = tuple(f"c{i}d{j}" for j in "XYZ" for i in "XYZ" if i != j)
    bearers = PAIRS

    def rotations(self, s: Stimulus) -> Floats:
        parts = super().rotations(s)[..., None] * np.eye(3)  # (m, j, i, 3): by d_j, about axis i alone
        return parts[:, *np.nonzero(~np.eye(3, dtype=bool))]  # d_j turns nothing about axis j


class CrossTalk(Effect):
    """X_ij A_j: a share of another accelerometer's reading; at rest a misalignment, and so always invisible."""

    family = "cross-axis"
    name, title, source = "cross-talk", "a share of another channel's reading", "IEEE Std 1293"
    borne_by = Bearer.SENSORS
    formulas = ("before", "after")
    confused_with = "misalignment, always at rest"
    typical = Typical((1e-6, 100e-6))
    symbols, unit, scale = ("X12", "X13", "X21", "X23", "X31", "X32"), "1", 1e-3

    def columns(self, s: Stimulus) -> Floats:
        return of_each((s.force_mps2 @ s.sensitivity.T)[:, [[1, 2], [0, 2], [0, 1]]])

    def degeneracy(self, bench: Bench) -> str:
        return "at rest, cross-talk is exactly a misalignment: no orientation tells the two apart"


class _GimbalEffect(RotationEffect):
    """An effect of one gimbal, named by its letter or number after the colon, which its symbols end in, too."""

    family, source = "gimbal and encoder", "geometry of the bench"

    def __init__(self, gimbal: int, variant: str) -> None:
        self.gimbal, self.variant = gimbal, variant
        self.symbols = tuple(f"{stem}_{variant}" for stem in self.symbols)

    def _angle(self, s: Stimulus) -> Floats:
        assert self.gimbal is not None
        return s.pose[:, self.gimbal]


class EncoderOffset(_GimbalEffect):
    """q_k + epsilon_k."""

    name, title = "encoder-offset", "zero of an encoder"
    confused_with = "innermost: a misalignment; outermost: base-tilt"
    symbols, unit, scale = ("eps",), "rad", 1e-2

    def rotations(self, s: Stimulus) -> Floats:
        return self.about(s)[:, None, :]

    def degeneracy(self, bench: Bench) -> str:
        if self.gimbal == len(bench.axes) - 1:
            return "the zero of the innermost encoder is exactly a misalignment: no orientation tells the two apart"
        return "the zero of the outer encoder is exactly a tilt of the base about its axis" if self.gimbal == 0 else ""


class _OfItsAngle(_GimbalEffect):
    """An error of a gimbal's angle that depends on this angle."""

    def __init__(self, gimbal: int, variant: str) -> None:
        super().__init__(gimbal, variant)
        self.drawn_against = Regressor(f"q{gimbal + 1}")


class EncoderScale(_OfItsAngle):
    """q_k (1 + epsilon_k)."""

    name, title = "encoder-scale", "scale of an encoder"
    symbols, unit, scale = ("epsS",), "1", 1e-3

    def rotations(self, s: Stimulus) -> Floats:
        return (self._angle(s)[:, None] * self.about(s))[:, None, :]


class EncoderHarmonic1(_OfItsAngle):
    """s sin q_k + c cos q_k on the angle."""

    name, title = "encoder-harmonic-1", "eccentricity of an encoder"
    order = 1
    typical = Typical((1e-6, 100e-6))
    symbols, unit, scale = ("s1", "c1"), "rad", 1e-3

    def rotations(self, s: Stimulus) -> Floats:
        angle = self.order * self._angle(s)
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)[:, :, None] * self.about(s)[:, None, :]


class EncoderHarmonic2(EncoderHarmonic1):
    """s sin 2 q_k + c cos 2 q_k on the angle."""

    name, title = "encoder-harmonic-2", "second harmonic of an encoder"
    confused_with = "second-order"
    symbols, order = ("s2", "c2"), 2


class Backlash(_GimbalEffect):
    """q_k - 1/2 p sgn(Delta q_k), Delta q_k the last move of the gimbal: it trails behind its encoder by half the play
    p, towards where it came from, and stays there while other gimbals move."""

    name, title = "backlash", "play between a gimbal and its encoder"
    confused_with = "encoder-scale, hysteresis; needs the same pose from two sides"
    typical = Typical((5e-6, 100e-6), (0.1e-3, 10e-3))
    symbols, unit, scale = ("play",), "rad", 1e-3

    def __init__(self, gimbal: int, variant: str) -> None:
        super().__init__(gimbal, variant)
        number = gimbal + 1
        self.drawn_against = Regressor(f"q{number}_move", f"last move of gimbal {number}", "rad")

    def rotations(self, s: Stimulus) -> Floats:
        assert self.gimbal is not None
        return (-0.5 * s.side(self.gimbal)[:, None] * self.about(s))[:, None, :]


class AxisNonorthogonality(_GimbalEffect):
    """Gimbal axis k tilted in its parent by tau: the child turns by tau - R^T tau, R the gimbal's own rotation."""

    name, title = "axis-nonorthogonality", "tilt of a gimbal axis"
    typical = Typical((5e-6, 50e-6))
    symbols, unit, scale = ("tauA", "tauB"), "rad", 1e-3

    def rotations(self, s: Stimulus) -> Floats:
        from kf_calib.bench.bench import turn

        assert self.gimbal is not None
        axis = np.array(s.bench.axes[self.gimbal])
        tilts = np.linalg.svd(axis[None])[2][1:]  # two directions across the axis
        return np.stack([s.inner(tilt - turn(tilt, axis, -self._angle(s)), self.gimbal) for tilt in tilts], axis=1)


class GravityError(Effect):
    """epsilon f in all channels: always a common scale factor, and so always invisible."""

    family = "base and platform"
    name, title, source = "gravity-error", "wrong local gravity", "size of the reference"
    confused_with = "a common scale factor, always"
    borne_by = Bearer.BENCH
    typical = Typical((10e-6, 700e-6))
    symbols, unit, scale = ("epsG",), "1", 1e-3

    def columns(self, s: Stimulus) -> Floats:
        return (s.force_mps2 @ s.sensitivity.T)[:, :, None]

    def degeneracy(self, bench: Bench) -> str:
        return "a wrong gravity is exactly a scale factor common to all channels: no orientation tells the two apart"


def gimbal_number(variant: str, letters: str) -> int:
    """The gimbal a variant names: by the letter of its axis where that is one gimbal's only, else by number from 1."""
    if len(variant) == 1 and letters.count(variant) == 1:
        return letters.index(variant)
    if re.fullmatch("[0-9]{1,3}", variant) and 1 <= int(variant) <= len(letters):
        return int(variant) - 1
    known = ", ".join(letter if letters.count(letter) == 1 else str(k + 1) for k, letter in enumerate(letters))
    raise InputError(f"{variant!r} names no gimbal of this bench: use one of {known or 'none: it has no axes'}.")


class Latency(Effect):
    """-tau_d da_i/dt, for the block as a whole: a reading stamped t is what was true at t - tau_d."""

    family = "slews"
    name, title, source = "latency", "delay of the readings", "acquisition chain"
    borne_by = Bearer.BENCH  # the clock and the acquisition are the bench's
    confused_with = "seen in slews only"
    dynamic = True
    symbols, unit, scale, shown = ("tau_d",), "s", 1e-2, ("ms", 1e3)

    def columns(self, s: Stimulus) -> Floats:
        return -(s.force_rate_mps3 @ s.sensitivity.T)[:, :, None]


class LeverArm(Effect):
    """K_i E_i . (omega x (omega x r_i) + domega/dt x r_i), r_i the place of accelerometer i in the platform."""

    family = "slews"
    name, title, source = "lever-arm", "place of each accelerometer", "rigid-body kinematics"
    confused_with = "seen in slews only, about several axes"
    dynamic = True
    symbols = tuple(f"r{i}{axis}" for i in (1, 2, 3) for axis in "xyz")
    unit, scale, shown = "m", 0.1, ("mm", 1e3)

    def columns(self, s: Stimulus) -> Floats:
        turning = _cross(s.rate_radps)
        per_metre = turning @ turning + _cross(s.rate_change_radps2)  # what it does to r, (m, 3, 3)
        return of_each(s.sensitivity @ per_metre)


def _cross(vector: Floats) -> Floats:
    """Matrices (m, 3, 3) that turn r into vector x r, of vectors (m, 3)."""
    return np.cross(vector[:, None, :], np.eye(3)[None]).swapaxes(1, 2)
