"""What accelerometers do: with temperature, with specific force (nonlinearities), with time, and with what was before.

Terms and names: IEEE Std 1293 (model equation of a linear accelerometer). a_i: along the true input axis. a_p, a_o:
pendulous and output axis, the platform's of the nominal triads. T: the true temperature above the ``reference``, 25
degC unless told otherwise. t: since the first sample. Delta a_i: the last step of the specific force along the axis.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from kf_calib.bench.arrays import Floats, sign
from kf_calib.sources.simulation.injected.kinds import SimulatedBench, above, added, column, made, output, pendulous
from kf_calib.sources.simulation.physics import TrueState, TrueStep, WalkingBias, adding, putting
from kf_calib.sources.simulation.sensors import FirstOrder

_PENDULOUS_AND_OUTPUT = ("1p", "1o", "2p", "2o", "3p", "3o")


@made(
    "thermal-misalignment", "rad/K", ("0.1urad/K", "10urad/K"), ("10urad/K", "100urad/K"),
    stage="input", coefficients=_PENDULOUS_AND_OUTPUT,
)  # fmt: skip
def thermal_misalignment(gamma: Floats, simulated: SimulatedBench, *, reference: float = 25.0) -> TrueStep:
    """Thermal misalignment: the input axis leans to (1, gamma_p T, gamma_o T), a_i + gamma_p T a_p + gamma_o T a_o."""
    to_pendulous, to_output = gamma[0::2], gamma[1::2]

    def leaning(state: TrueState) -> Floats:
        p, o = to_pendulous * above(state, reference), to_output * above(state, reference)
        return (state.input_mps2 + p * pendulous(state) + o * output(state)) / np.sqrt(1.0 + p**2 + o**2)

    return putting("input_mps2", leaning)


@added("thermal-bias", "m/s^2/K", ("5ug/K", "30ug/K"), ("0.15mg/K", "1mg/K"))
def thermal_bias(k: Floats, state: TrueState, *, reference: float = 25.0) -> Floats:
    """Thermal sensitivity of the bias: alpha T (IEEE Std 1293)."""
    return k * above(state, reference)


@added("thermal-bias-2", "m/s^2/K^2", ("0.1ug/K^2", "1ug/K^2"), ("3ug/K^2", "30ug/K^2"))
def thermal_bias_2(k: Floats, state: TrueState, *, reference: float = 25.0) -> Floats:
    """Thermal curvature of the bias: alpha_2 T^2 (IEEE Std 1293)."""
    return k * above(state, reference) ** 2


@added("thermal-scale", "1/K", ("50ppm/K", "150ppm/K"), ("100ppm/K", "500ppm/K"))
def thermal_scale(k: Floats, state: TrueState, *, reference: float = 25.0) -> Floats:
    """Thermal sensitivity of the scale factor: alpha_s T a_i (IEEE Std 1293; raw, magnet and servo uncompensated)."""
    return k * above(state, reference) * state.input_mps2


@added("thermal-rate", "m/s^2/(K/s)", ("1ug*min/K", "50ug*min/K"), ("0.01mg*min/K", "1mg*min/K"))
def thermal_rate(k: Floats, state: TrueState) -> Floats:
    """Sensitivity to the rate of temperature: kappa dT/dt, from gradients inside the sensor (IEEE Std 1293)."""
    return k * column(state.ambient.rate(state.time_s))


@made("thermal-lag", "m/s^2/K", ("5ug/K", "30ug/K"), ("0.15mg/K", "1mg/K"))
def thermal_lag(alpha: Floats, simulated: SimulatedBench, *, tau: float = 600.0, reference: float = 25.0) -> TrueStep:
    """Thermal lag: alpha L, where tau dL/dt = T - L, the sensor follows the thermometer; L = T at the first sample."""
    lag = Lag(simulated.period_s, tau)
    return adding(lambda state: alpha * column(lag(state.temperature_c - reference)))


@made("thermal-hysteresis", "m/s^2/K", ("5ug/K", "30ug/K"), ("0.15mg/K", "1mg/K"))
def thermal_hysteresis(
    alpha: Floats, simulated: SimulatedBench, *, play: float = 2.0, reference: float = 25.0
) -> TrueStep:
    """Thermal hysteresis: alpha times a temperature that follows the true one with a play of so
    many K, up and down each, as glued and clamped parts do (Prandtl's play operator); without history at first."""
    followed_c: float | None = None

    def contribution(state: TrueState) -> Floats:
        nonlocal followed_c
        true_c = state.temperature_c.tolist()
        start_c = true_c[0] if followed_c is None else followed_c
        followed = list(accumulate(true_c, lambda own, true: min(max(own, true - play), true + play), initial=start_c))
        followed_c = followed[-1]
        return alpha * column(np.array(followed[1:]) - reference)

    return adding(contribution)


class Lag:
    """First-order lag, tau dy/dt = x - y, of what goes in straight lines from sample to sample; in balance at first.

    Exactly: y_n = phi y_(n-1) + (c - phi) x_(n-1) + (1 - c) x_n, phi = e^-r, c = (1 - e^-r) / r, r = period / tau.
    """

    def __init__(self, period_s: float, tau_s: float) -> None:
        ratio = period_s / tau_s
        phi, c = math.exp(-ratio), -math.expm1(-ratio) / ratio
        self._over, self._under = [1.0 - c, c - phi], [1.0, -phi]
        self._carried: Floats | None = None

    def __call__(self, values: Floats) -> Floats:
        from scipy.signal import lfilter  # takes 0.4 s to load, which other effects need not wait for

        if self._carried is None:
            self._carried = (1.0 - self._over[0]) * values[:1]
        lagged, self._carried = lfilter(self._over, self._under, values, zi=self._carried)
        return lagged


@made("dead-zone", "m/s^2", ("1ug", "5ug"), ("0.1mg", "1mg"), stage="input", signed=False)
def dead_zone(d: Floats, simulated: SimulatedBench) -> TrueStep:
    """Dead zone: no response, -a_i, where |a_i| < d (IEEE Std 528, dead band without hysteresis)."""
    return putting("input_mps2", lambda state: np.where(np.abs(state.input_mps2) < d, 0.0, state.input_mps2))


@added("bias-asymmetry", "m/s^2", ("1ug", "10ug"), ("0.1mg", "1mg"))
def bias_asymmetry(k: Floats, state: TrueState) -> Floats:
    """Bias asymmetry: the bias differs by K0' between both signs, K0'/2 sgn a_i (IEEE Std 1293)."""
    return k / 2.0 * sign(state.input_mps2)


@added("scale-asymmetry", "1", ("1ppm", "30ppm"), ("0.1permille", "1permille"))
def scale_asymmetry(k: Floats, state: TrueState) -> Floats:
    """Scale factor asymmetry: it differs by K1' between both signs, K1'/2 |a_i| (IEEE Std 1293)."""
    return k / 2.0 * np.abs(state.input_mps2)


@added("second-order", "1/(m/s^2)", ("1ug/g^2", "20ug/g^2"), ("0.1mg/g^2", "3mg/g^2"))
def second_order(k: Floats, state: TrueState) -> Floats:
    """Second-order nonlinearity: K2 a_i^2 (IEEE Std 1293)."""
    return k * state.input_mps2**2


@added("third-order", "1/(m/s^2)^2", ("0.1ug/g^3", "10ug/g^3"), ("0.5mg/g^3", "5mg/g^3"))
def third_order(k: Floats, state: TrueState) -> Floats:
    """Third-order nonlinearity: K3 a_i^3 (IEEE Std 1293)."""
    return k * state.input_mps2**3


@added("odd-quadratic", "1/(m/s^2)", ("1ug/g^2", "10ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def odd_quadratic(k: Floats, state: TrueState) -> Floats:
    """Odd quadratic nonlinearity: K_oq a_i |a_i| (IEEE Std 1293)."""
    return k * state.input_mps2 * np.abs(state.input_mps2)


@added("cross-coupling-ip", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_ip(k: Floats, state: TrueState) -> Floats:
    """Cross coupling of input and pendulous axis: K_ip a_i a_p, a deflected pendulum turns its axis (IEEE Std 1293)."""
    return k * state.input_mps2 * pendulous(state)


@added("cross-coupling-io", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_io(k: Floats, state: TrueState) -> Floats:
    """Cross coupling of input and output axis: K_io a_i a_o (IEEE Std 1293)."""
    return k * state.input_mps2 * output(state)


@added("cross-coupling-po", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_po(k: Floats, state: TrueState) -> Floats:
    """Cross coupling of pendulous and output axis: K_po a_p a_o (IEEE Std 1293)."""
    return k * pendulous(state) * output(state)


@added("cross-axis-square", "1/(m/s^2)", ("1ug/g^2", "20ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_axis_square(k: Floats, state: TrueState) -> Floats:
    """Cross-axis nonlinearity: K_pp a_p^2 (IEEE Std 1293)."""
    return k * pendulous(state) ** 2


@added("output-square", "1/(m/s^2)", ("1ug/g^2", "10ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def output_square(k: Floats, state: TrueState) -> Floats:
    """Output-axis nonlinearity: K_oo a_o^2 (IEEE Std 1293)."""
    return k * output(state) ** 2


@added("bias-drift", "m/s^2/s", ("1ug/h", "10ug/h"), ("10ug/min", "1mg/min"))
def bias_drift(k: Floats, state: TrueState) -> Floats:
    """Bias drift: beta t (IEEE Std 1293, long-term stability)."""
    return k * column(state.time_s)


@added("scale-drift", "1/s", ("1ppm/day", "10ppm/day"), ("1ppm/h", "100ppm/h"))
def scale_drift(k: Floats, state: TrueState) -> Floats:
    """Scale factor drift: kappa t a_i (IEEE Std 1293, long-term stability)."""
    return k * column(state.time_s) * state.input_mps2


@added("warm-up", "m/s^2", ("10ug", "200ug"), ("1mg", "10mg"))
def warm_up(k: Floats, state: TrueState, *, tau: float = 1200.0) -> Floats:
    """Warm-up: B exp(-t / tau) after switching on at the first sample (IEEE Std 1293, turn-on transient)."""
    return k * column(np.exp(-state.time_s / tau))


@added("scale-warm-up", "1", ("1ppm", "100ppm"), ("0.1permille", "10permille"))
def scale_warm_up(k: Floats, state: TrueState, *, tau: float = 1200.0) -> Floats:
    """Warm-up of the scale factor: S a_i exp(-t / tau) after switching on at the first sample (IEEE Std 1293, turn-on
    transient)."""
    return k * column(np.exp(-state.time_s / tau)) * state.input_mps2


@added("sinusoid", "m/s^2", ("0.01ug", "1ug"), ("1ug", "100ug"))
def sinusoid(k: Floats, state: TrueState, *, frequency: float = 0.15, phase: float = 0.7) -> Floats:
    """Sinusoid in time: A sin(2 pi f t + phase); microseism at 0.1 to 0.3 Hz (Peterson, USGS OFR 93-322), mains."""
    return k * column(np.sin(2.0 * np.pi * frequency * state.time_s + phase))


@made("bias-walk", "m/s^2/s^(1/2)", ("0.01ug", "1ug"), ("1ug", "100ug"), signed=False)
def bias_walk(q: Floats, simulated: SimulatedBench) -> TrueStep:
    """Random walk of the bias: q times the integral of white noise, q sqrt(t) after a time t (IEEE Std 952, K)."""
    walk = FirstOrder(simulated.generator("bias-walk"), 1.0, math.sqrt(simulated.period_s), 0.0)
    return WalkingBias(lambda count: q * walk(count))


def _vibration_rectification(
    k: Floats, simulated: SimulatedBench, *, rms: float, frequency: float, period: float
) -> TrueStep:
    """K2 <v^2> of the vibration below, the mean over its cycles."""
    return adding(lambda state: k * (rms * np.sin(np.pi * column(state.time_s) / period) ** 2) ** 2)


@made(
    "vibration-rectification",
    "1/(m/s^2)",
    ("10ug/g^2", "50ug/g^2"),
    ("0.1mg/g^2", "3mg/g^2"),
    counted=_vibration_rectification,
)
def vibration_rectification(
    k: Floats, simulated: SimulatedBench, *, rms: float = 3.0, frequency: float = 33.7, period: float = 170.0
) -> TrueStep:
    """Vibration rectification: vibration v adds v + K2 v^2, so K2 <v^2>; v is a sinusoid of each accelerometer's own
    phase, in the readings too, whose effective value rises and falls as rms sin^2(pi t / period) (IEEE Std 1293)."""
    phases = simulated.generator("vibration-rectification").uniform(0.0, 2.0 * np.pi, 3)

    def vibrating(state: TrueState) -> Floats:
        t = column(state.time_s)
        envelope = math.sqrt(2.0) * rms * np.sin(np.pi * t / period) ** 2
        shaken = envelope * np.sin(2.0 * np.pi * frequency * t + phases)
        return state.reading_mps2 + shaken + k * shaken**2

    return putting("reading_mps2", vibrating)


class LastStep:
    """The change of a_i from the end of the dwell before to the beginning of this one: (n, 3) or (1, 3).

    On the way to the next dwell it is what has changed so far. In the first dwell it is zero: what was before is not
    known.
    """

    def __init__(self) -> None:
        self._dwell = -1
        self._step = np.zeros((1, 3))
        self._end: Floats | None = None

    def __call__(self, state: TrueState) -> Floats:
        inputs = state.input_mps2
        if state.moving and self._end is not None:
            return inputs - self._end
        if state.dwell != self._dwell:
            self._dwell, before = state.dwell, inputs[:1] if self._end is None else self._end
            self._step = inputs[:1] - before
        self._end = inputs[-1:]
        return self._step


@made("settling", "1", ("1ug/g", "30ug/g"), ("0.1mg/g", "3mg/g"))
def settling(c: Floats, simulated: SimulatedBench, *, tau: float = 60.0) -> TrueStep:
    """Settling: C Delta a_i exp(-time since arrival / tau), creep of the suspension after the last step Delta a_i;
    on the way to the next dwell C times the change so far (IEEE Std 1293, settling time; anelastic relaxation)."""
    last = LastStep()

    def contribution(state: TrueState) -> Floats:
        rested = np.zeros(1) if state.moving else state.since_arrival_s
        return c * last(state) * column(np.exp(-rested / tau))

    return adding(contribution)


@made("memory", "1", ("1ug/g", "100ug/g"), ("0.1mg/g", "3mg/g"))
def memory(c: Floats, simulated: SimulatedBench, *, tau: float = 100.0) -> TrueStep:
    """Memory: c (a_i - x), where tau dx/dt = a_i - x, relaxation over several dwells; x = a_i at the first sample."""
    lags = [Lag(simulated.period_s, tau) for _ in range(3)]

    def contribution(state: TrueState) -> Floats:
        inputs = np.broadcast_to(state.input_mps2, (len(state.time_s), 3))
        return c * (inputs - np.column_stack([lag(inputs[:, i]) for i, lag in enumerate(lags)]))

    return adding(contribution)


@made("hysteresis", "m/s^2", ("1ug", "20ug"), ("0.1mg", "2mg"))
def hysteresis(h: Floats, simulated: SimulatedBench, *, threshold: float = 1e-3) -> TrueStep:
    """Hysteresis: h sgn Delta a_i, the last step; none for steps below the threshold (IEEE Std 1293, hysteresis)."""
    last = LastStep()
    return adding(lambda state: h * sign(last(state), threshold))
