"""Nonlinearities of the accelerometer itself (IEEE Std 1293: K0', K1', K2, K3, Koq, Kip, Kio, Kpo, Kpp)."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects.effect import MICRO_G, MICRO_PER_G, MILLI_PER_G, Bearer, Regressor, SensorEffect, Typical, Unknown
from kf_calib.effects.stimulus import Stimulus
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

IEEE = "IEEE Std 1293, model equation"
_EDGES = 500


class _Nonlinearity(SensorEffect):
    family, source = "nonlinearity", IEEE
    drawn_against = Regressor("a", "force along the input axis", "m/s^2")


class BiasAsymmetry(_Nonlinearity):
    """1/2 K0' sgn a_i."""

    name, title = "bias-asymmetry", "bias that changes sign with the input"
    on_data_sheet = "bias asymmetry"
    formulas = ("0.5*sign(a)",)
    confused_with = "odd-quadratic; invisible in six faces"
    symbol, unit, scale = "K0'", "m/s^2", 1e-3
    typical = Typical((1 * MICRO_G, 10 * MICRO_G))


class ScaleAsymmetry(_Nonlinearity):
    """1/2 K1' |a_i|."""

    name, title = "scale-asymmetry", "scale factor that differs with the sign of the input"
    on_data_sheet = "scale asymmetry"
    formulas = ("0.5*abs(a)",)
    confused_with = "second-order"
    symbol, unit, scale = "K1'", "1", 1e-3
    typical = Typical((1e-6, 30e-6), (0.1e-3, 1e-3))


class SecondOrder(_Nonlinearity):
    """K2 a_i^2."""

    name, title = "second-order", "second-order nonlinearity"
    on_data_sheet, in_polynomial = "second order", True
    formulas = ("a**2",)
    confused_with = "scale-asymmetry"
    symbol, unit, scale = "K2_", "s^2/m", 1e-4
    typical = Typical((1 * MICRO_PER_G, 20 * MICRO_PER_G), (0.1 * MILLI_PER_G, 3 * MILLI_PER_G))


class ThirdOrder(_Nonlinearity):
    """K3 a_i^3."""

    name, title = "third-order", "third-order nonlinearity"
    on_data_sheet, in_polynomial = "third order", True
    formulas = ("a**3",)
    confused_with = "odd-quadratic; invisible in six faces"
    symbol, unit, scale = "K3_", "s^4/m^2", 1e-5
    typical = Typical(
        (0.1 * MICRO_PER_G / STANDARD_GRAVITY_MPS2, 10 * MICRO_PER_G / STANDARD_GRAVITY_MPS2),
        (0.0, 5 * MILLI_PER_G / STANDARD_GRAVITY_MPS2),
    )

    def added(self, s: Stimulus, coefficients: Floats) -> Floats:
        return coefficients * s.along * s.along * s.along  # ten times as fast as the power


class OddQuadratic(_Nonlinearity):
    """Koq a_i |a_i|."""

    name, title = "odd-quadratic", "odd quadratic nonlinearity"
    on_data_sheet = "odd quadratic"
    formulas = ("a*abs(a)",)
    confused_with = "third-order; invisible in six faces"
    symbol, unit, scale = "Koq", "s^2/m", 1e-4
    typical = Typical((1 * MICRO_PER_G, 10 * MICRO_PER_G), (0.0, MILLI_PER_G))


class _CrossCoupling(SensorEffect):
    family = "cross-axis"
    source, confused_with = IEEE, "seen in poses between the faces only"
    unit, scale = "s^2/m", 1e-4
    typical = Typical((1 * MICRO_PER_G, 30 * MICRO_PER_G), (0.0, MILLI_PER_G))


class CrossCouplingIP(_CrossCoupling):
    """Kip a_i a_p."""

    name, title, symbol = "cross-coupling-ip", "input-pendulous cross-coupling", "Kip"
    on_data_sheet, in_polynomial = "coupling i × p", True
    drawn_against = Regressor("a*p", "force along the input axis times that along the pendulous axis", "m^2/s^4")
    formulas = ("a*p",)


class CrossCouplingIO(_CrossCoupling):
    """Kio a_i a_o."""

    name, title, symbol = "cross-coupling-io", "input-output cross-coupling", "Kio"
    on_data_sheet, in_polynomial = "coupling i × o", True
    drawn_against = Regressor("a*o", "force along the input axis times that along the output axis", "m^2/s^4")
    formulas = ("a*o",)


class CrossCouplingPO(_CrossCoupling):
    """Kpo a_p a_o."""

    name, title, symbol = "cross-coupling-po", "pendulous-output cross-coupling", "Kpo"
    on_data_sheet, in_polynomial = "coupling p × o", True
    drawn_against = Regressor("p*o", "force along the pendulous axis times that along the output axis", "m^2/s^4")
    formulas = ("p*o",)


class CrossAxisSquare(_CrossCoupling):
    """Kpp a_p^2."""

    name, title, symbol = "cross-axis-square", "square of the pendulous acceleration", "Kpp"
    on_data_sheet = "pendulous square"
    drawn_against = Regressor("p", "force along the pendulous axis", "m/s^2")
    formulas = ("p**2",)
    confused_with = "second-order, output-square, bias"
    typical = Typical((1 * MICRO_PER_G, 20 * MICRO_PER_G), (0.0, MILLI_PER_G))


class OutputSquare(_CrossCoupling):
    """Koo a_o^2; beside K2, Kpp and a bias it is redundant, because the squares sum to g^2, alone it is not."""

    name, title, symbol = "output-square", "square of the acceleration along the output axis", "Koo"
    on_data_sheet = "output square"
    drawn_against = Regressor("o", "force along the output axis", "m/s^2")
    formulas = ("o**2",)
    confused_with = "second-order and cross-axis-square together"
    typical = Typical((1 * MICRO_PER_G, 10 * MICRO_PER_G), (0.0, MILLI_PER_G))


class VibrationRectification(SensorEffect):
    """K2v <v^2>, <v^2> the variance of the readings about here."""

    family = "surroundings"
    name, title, source = "vibration-rectification", "shift of the bias under vibration", IEEE
    on_data_sheet = "vibration bias"
    drawn_against = Regressor("", "variance of the readings", "m^2/s^4")
    borne_by = Bearer.EITHER  # the sensor rectifies what the bench shakes
    confused_with = "needs vibration that varies"
    averages = True
    symbol, unit, scale = "K2v", "s^2/m", 1e-4
    typical = Typical((10 * MICRO_PER_G, 50 * MICRO_PER_G))

    def terms(self, s: Stimulus) -> Floats:
        return np.broadcast_to(s.variance_mps2_2, (len(s), 3))


class DeadZone(_Nonlinearity):
    """-a_i where |a_i| < d: a share of 1 is a reading that stays where it is over the whole zone."""

    name, title = "dead-zone", "no response to small inputs"
    formulas = ("-a*(abs(a) < constant)",)
    confused_with = "needs poses that sweep through zero"
    symbol, unit, scale, shown = "Dz", "1", 1.0, ("of the input", 1.0)
    unknown = Unknown("dZone", "m/s^2", 1e-6, 1e-2)
    smooth = False
    value = 1e-4

    def edges(self, s: Stimulus) -> Floats:
        """At every input, or every so many: a pose that moves a little has one at each node."""
        assert self.unknown is not None
        low, high = self.unknown.low, self.unknown.high
        inputs = np.unique(np.abs(s.along))
        inputs = inputs[(inputs > low) & (inputs < high)]
        return np.array([low, *inputs[:: len(inputs) // _EDGES + 1], high])
