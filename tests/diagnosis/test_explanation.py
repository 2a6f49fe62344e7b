"""The picture of a missing effect has the effect's own axis: checked for every effect of the catalogue that shows."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.hidden_effects import BENCH, run, source
from helpers.long_runs import slow
from scipy.stats import binom

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import EffectShape, shapes_of
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.residual_drivers import is_function_of
from kf_calib.effects import effect_named, names
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.residual_table import residual_table

FAST = {"sinusoid"}
"""Faster than a dwell, so that the means of dwells hardly show it."""
UNSEEN_HERE = {"vibration-rectification"}
"""Needs readings that resolve vibration, see tests/effects."""
OF_NO_SIZE = {
    "dead-zone", "gravity-error", "cross-talk", "latency", "lever-arm", "encoder-offset:y", "encoder-offset:x",
    "encoder-scale:y", "encoder-harmonic-1:y", "encoder-harmonic-2:y", "backlash:y",
}  # fmt: skip
"""Those that this bench does not show at any size, so that none of them is 15 sigma."""
SEEN = [
    name for name in names(BENCH)
    if name not in FAST | UNSEEN_HERE | OF_NO_SIZE and not effect_named(name, BENCH).dynamic
]  # fmt: skip


@cache
def shape_of(name: str) -> EffectShape:
    """Its shape where it was hidden at 15 sigma, and is fitted."""
    before = run(f"{name}=15sigma")
    (shape,) = shapes_of(before, Refits().with_effects(before, (name,)))
    return shape


def correlation(one: Floats, other: Floats, sigma: Floats) -> float:
    """Of values (D, C), each column about its weighted mean."""
    weights = np.where(np.isfinite(one * other), 1.0 / sigma**2, 0.0)
    centred = []
    for values in (np.nan_to_num(one), np.nan_to_num(other)):
        centred.append(values - np.sum(weights * values, axis=0) / np.sum(weights, axis=0))
    a, b = centred
    return float(np.sum(weights * a * b) / np.sqrt(np.sum(weights * a * a) * np.sum(weights * b * b)))


def test_nearly_the_whole_catalogue_is_drawn() -> None:
    assert len(SEEN) >= 36 and set(names(BENCH)) >= FAST | UNSEEN_HERE | OF_NO_SIZE


@pytest.mark.parametrize("name", sorted(OF_NO_SIZE))
def test_what_is_not_drawn_is_not_seen(name: str) -> None:
    with pytest.raises(InputError):
        source(f"{name}=15sigma")


@pytest.mark.parametrize("name", [*SEEN[::6], *slow(*(name for k, name in enumerate(SEEN) if k % 6))])
def test_what_the_readings_show_of_an_effect_follows_its_axis(name: str) -> None:
    """The readings go with the curve, and the curve is one over the axis: a fit of it that knows the axis alone."""
    shape = shape_of(name)
    assert correlation(shape.readings, shape.component, np.nan_to_num(shape.sigma, nan=1.0)) > 0.9
    assert shape.is_curve
    if name == "bias-walk":  # any path over time
        return
    for column in range(len(shape.channels)):
        known = np.isfinite(shape.component[:, column])
        x, y = shape.values[known, column], shape.component[known, column]
        order = np.argsort(x)
        rough, spread = np.diff(y[order]), np.ptp(y)
        steps = np.diff(x[order]) < 0.02 * np.ptp(x)  # dwells that are alike on the axis are alike in the component
        if not any(word in name for word in ("hysteresis", "asymmetry", "backlash")):  # these jump at zero
            assert np.all(np.abs(rough[steps]) < 0.35 * spread), (name, column)


@pytest.mark.parametrize("rounding", [0.0, 9e-16, -9e-16])
def test_a_step_at_zero_is_a_function_though_a_zero_holds_rounding(rounding: float) -> None:
    """Where a dwell repeats the one before there was no step: its mean is zero but for rounding, of either sign."""
    x = np.append([rounding] * 4, np.outer([-1.0, 1.0], np.geomspace(0.1, 15.0, 8)))[:, None]
    side = np.append([0.0] * 4, np.sign(x[4:, 0]))[:, None]
    assert is_function_of(side, x, "m/s^2")
    assert not is_function_of(np.roll(side, 5, axis=0), x, "m/s^2")


@pytest.mark.parametrize(("name", "symbol", "unit"), [
    ("cross-coupling-ip", "a·p", "m^2/s^4"), ("encoder-harmonic-2:z", "q2", "rad"), ("bias-walk", "t", "s"),
    ("hysteresis", "da", "m/s^2"), ("thermal-bias", "T", "K"), ("scale-drift", "t·a", "m/s"),
    ("base-tilt", "", "rad"), ("second-order", "a", "m/s^2"), *slow(("thermal-lag", "", "K"), ("memory", "", "m/s^2")),
])  # fmt: skip
def test_axes_are_those_of_the_physics(name: str, symbol: str, unit: str) -> None:
    """Products of what the table of residuals has of each dwell; an error of the frame is the turn it makes."""
    shape = shape_of(name)
    assert (shape.symbol, shape.unit) == (symbol, unit)
    table = residual_table(run(f"{name}=15sigma"))
    column = {"a": "along_mps2", "p": "pendulous_mps2", "da": "step_mps2"}
    factors = [table[column[part]].reshape(-1, 3) for part in symbol.split("·") if part in column]
    if symbol and len(factors) == len(symbol.split("·")):
        assert shape.values == pytest.approx(np.prod(factors, axis=0), rel=1e-3, abs=1e-3)
    if symbol == "q2":
        angle = np.radians(table["gimbal2_deg"].reshape(-1, 3)[:, :1])
        assert np.cos(shape.values - angle) == pytest.approx(np.ones_like(angle), abs=1e-6)
    if unit == "rad" and not symbol:  # gravity turned by so much changes a reading by as much of g
        assert shape.component == pytest.approx(shape.values * BENCH.gravity_mps2, rel=1e-2, abs=1e-12)


def test_an_encoder_is_drawn_as_its_error_over_its_angle() -> None:
    """The three readings of a dwell show one turn: that which was hidden, as often as its sigma says."""
    shape = shape_of("encoder-harmonic-2:z")
    assert shape.quantity == "rad" and shape.channels == ("turn about gimbal 2",) and shape.values.shape[1] == 1
    (hidden,) = source("encoder-harmonic-2:z=15sigma").hidden
    s, c = hidden.sizes
    truth = s * np.sin(2.0 * shape.values) + c * np.cos(2.0 * shape.values)
    known = np.isfinite(shape.readings)
    off = np.abs(shape.readings - truth)[known] / shape.sigma[known]
    assert known.sum() >= 12
    assert binom.cdf(np.sum(off < 2.0), off.size, 0.954) > 1e-3 and np.median(off) < 1.2
    assert np.ptp(truth) > 5.0 * np.nanmedian(shape.sigma)


def test_formulas_have_the_axis_that_they_name() -> None:
    before = run("second-order=15sigma")
    for text, symbol, unit in (("mine = a*p*T", "a·p·T", "m^2 K/s^4"), ("mine = a**3 + g*a*abs(a)*2", "a", "m/s^2"),
                               ("mine:z = sin(3*q2)", "q2", "rad")):  # fmt: skip
        (shape,) = shapes_of(before, Refits().with_effects(before, (text,)))
        assert (shape.symbol, shape.unit) == (symbol, unit)
        assert len(shape.channels) == (1 if ":z" in text else 3)
    together = shapes_of(before, Refits().with_effects(before, ("one = a**2", "two = a**4")))
    assert [(each.symbol, each.effect) for each in together] == [("a", "a**2 + a**4")]
    apart = shapes_of(before, Refits().with_effects(before, ("one = a**2", "two = T")))
    assert [(each.symbol, each.words) for each in apart] == [("", "what the fit of it adds")]


def test_effects_of_one_model_have_a_shape_each() -> None:
    """What one must explain has the other taken off: both follow their axes though both are there."""
    before = calibrate(source("second-order=15sigma", "hysteresis=15sigma"))
    both = shapes_of(before, Refits().with_effects(before, ("second-order", "hysteresis")))
    assert [(each.effect, each.symbol) for each in both] == [("second-order", "a"), ("hysteresis", "da")]
    for shape in both:
        assert correlation(shape.readings, shape.component, shape.sigma) > 0.9
        assert np.allclose(shape.readings - shape.component, shape.left)


def test_the_clearest_channel_is_that_of_the_largest_effect() -> None:
    before = run("cross-coupling-ip=0.1ug/g^2,3ug/g^2,0.1ug/g^2")
    (shape,) = shapes_of(before, Refits().with_effects(before, ("cross-coupling-ip",)))
    assert shape.channels == ("accelerometer 1", "accelerometer 2", "accelerometer 3") and shape.clearest == 1
    at, middle, sigma = shape.curve(1)
    slope = np.polyfit(at, middle, 1)[0]
    assert slope == pytest.approx(3e-6 / 9.80665, rel=0.2) and np.all(sigma > 0.0)
