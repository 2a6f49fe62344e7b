"""When readings that are corrected line by line are told not to be what they are taken for."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.thresholds import begins_at

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import RawInput
from kf_calib.bench.streams import Stream
from kf_calib.exchange.corrected_lines import NormAtRest, _distinct

G = 9.8
PLAIN = RawInput()
FACES = G * np.vstack([np.eye(3), -np.eye(3)])


def at_rest(means: Floats = FACES, bias_mps2: float = 0.0, worst_mps2: float = 1e-3, sigma: float = 1e-3) -> NormAtRest:
    """Means of windows at rest, of sensors with a bias of accelerometer 1 alone."""
    correction: Any = SimpleNamespace(
        bench=SimpleNamespace(gravity_mps2=G), bias_mps2=np.array([bias_mps2, 0.0, 0.0]), matrix=np.eye(3),
        worst_sigma_mps2=np.array([worst_mps2]), input=SimpleNamespace(is_plain=True),
    )  # fmt: skip
    rest = NormAtRest(correction)
    rest.add_means(means, sigma)
    return rest


def test_a_norm_a_third_above_gravity_or_a_quarter_below_it_is_of_another_unit() -> None:
    assert begins_at(lambda level: at_rest(level * FACES).misfit(PLAIN, False), 1.0, 3.0) == pytest.approx(1.33)
    assert begins_at(lambda part: at_rest(FACES / part).misfit(PLAIN, False), 1.0, 3.0) == pytest.approx(1.0 / 0.75)
    assert not at_rest(5.0 * FACES[:2]).misfit(PLAIN, False) and at_rest(5.0 * FACES[:3]).misfit(PLAIN, False)
    assert not at_rest(FACES[:0]).misfit(PLAIN, True) and at_rest(5.0 * FACES[:1]).misfit(PLAIN, True)


def test_windows_of_half_a_second_count_in_which_readings_scatter_by_a_fiftieth_of_their_norm_at_most() -> None:
    """Of 4.2 seconds at 20 Hz, in batches of 7: eight windows, and a rest of 4 readings that is too short."""
    sides = np.tile([1.0, -1.0], 42)[:, None] * np.sqrt(0.9 / 3.0)  # sum of variances 1, of ten readings
    stamps = 50_000_000 * np.arange(84, dtype=np.int64)

    def rested(scatter: float) -> NormAtRest:
        rest = at_rest(FACES[:0])
        for k in range(0, 84, 7):
            rest.add(Stream(stamps[k : k + 7], 4.0 * G * (np.array([0.0, 1.0, 0.0]) + scatter * sides[k : k + 7])))
        return rest

    assert begins_at(lambda scatter: not rested(scatter).misfit(PLAIN, True), 1e-3, 0.5) == pytest.approx(
        0.02, rel=1e-3
    )
    rest = rested(0.01)
    assert len(rest._means) == 8 and rest._sigmas == pytest.approx([0.04 * G / np.sqrt(10.0)] * 8)
    assert rest.misfit(PLAIN, True) and len(rest._means) == 8


def test_directions_are_different_from_fourteen_degrees_on() -> None:
    def apart(deg: float) -> bool:
        turned = np.radians([0.0, deg])
        return len(_distinct(np.column_stack([np.cos(turned), np.sin(turned), 0.0 * turned]))) == 2

    assert begins_at(apart, 1.0, 90.0) == pytest.approx(np.degrees(np.arccos(0.97)))


def test_an_order_of_channels_is_told_where_the_norm_changes_by_six_sigma() -> None:
    """Of the worst correction or of the means, over six directions; the bias is that of channel 2 here."""
    bias, wired = 0.1, FACES + np.array([0.0, 0.1, 0.0])
    here = float(np.std(np.linalg.norm(wired - [bias, 0.0, 0.0], axis=1)))
    said = at_rest(wired, bias).misfit(PLAIN, True)
    assert f"changes by {here:.2g} m/s^2 over 6 directions" in said and "--channels 2,1,3" in said
    for size in ("worst_mps2", "sigma"):
        silent = begins_at(lambda s, k=size: not at_rest(wired, bias, **{k: s}).misfit(PLAIN, True), 2e-3, 1.0)
        assert np.hypot(silent, 1e-3) == pytest.approx(here / 6.0, rel=1e-6)
    assert not at_rest(wired[:5], bias).misfit(PLAIN, True) and not at_rest(wired, bias).misfit(PLAIN, False)
    assert not at_rest(FACES + np.array([bias, 0.0, 0.0]), bias).misfit(PLAIN, True)


def test_another_order_of_channels_is_told_where_it_leaves_less_than_a_sixth_of_the_change() -> None:
    bias, uneven = 0.1, np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])

    def changes(size: float) -> tuple[Floats, float, float]:
        wired = FACES * (1.0 + size * uneven)[:, None] + np.array([0.0, bias, 0.0])
        norms = (np.linalg.norm(wired[:, order] - [bias, 0.0, 0.0], axis=1) for order in ([0, 1, 2], [1, 0, 2]))
        return wired, *(float(np.std(own)) for own in norms)

    silent = begins_at(lambda size: not at_rest(changes(size)[0], bias, 1e-6, 1e-6).misfit(PLAIN, True), 1e-5, 0.1)
    _, here, there = changes(silent)
    assert here == pytest.approx(6.0 * there, rel=1e-6)
