"""Effects of no catalogue: products of two drivers, memories, and maps that follow no formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from unknown_trials.small_bench import G_MPS2, SmallRun, Visits, hidden_run

_PLAY = 0.5  # in g: half the width of the play


def _over(at: Visits, by_dwell: Floats) -> Floats:
    """A value a dwell (D, 3), or (D, n, 3), over all readings."""
    values = by_dwell[:, None] if by_dwell.ndim == 2 else by_dwell
    return np.broadcast_to(values, (*at.time_s.shape, 3)).astype(float)


def _warm(at: Visits) -> Floats:
    return (at.temperature_c - 25.0)[:, :, None]


def _gone(at: Visits) -> Floats:
    return (at.time_s / at.time_s.max())[:, :, None]


def _force(at: Visits, turned: int = 0) -> Floats:
    """Force (D, 1, 3) in g along the axis of each accelerometer, or the next ones."""
    return np.roll(at.force_mps2, -turned, axis=1)[:, None] / G_MPS2


def _play(way: Floats) -> Floats:
    """What a play lets through (D, 3) of a way (D, m, 3) in g: it follows only where it is pushed."""
    held, at_dwells = way[0, -1], list[Floats]()
    for places in way:
        for place in places:
            held = np.minimum(np.maximum(held, place - _PLAY), place + _PLAY)
        at_dwells.append(held)
    return np.array(at_dwells)


def _map(at: Visits) -> Floats:
    """A rough function of the direction of the force alone, by 40 bumps (D, 3)."""
    centres = np.random.default_rng(11).normal(size=(3, 40, 3))
    centres /= np.linalg.norm(centres, axis=2, keepdims=True)
    signs = np.random.default_rng(12).choice([-1.0, 1.0], (3, 40))
    cosines = np.einsum("dk,cbk->dcb", at.force_mps2 / G_MPS2, centres)
    return np.einsum("dcb,cb->dc", np.exp(12.0 * (cosines - 1.0)), signs)


HIDDEN: dict[str, Callable[[Visits], Floats]] = {
    "temperature x two forces": lambda at: _warm(at) * _force(at) * _force(at, 1),
    "temperature x square of the force": lambda at: _warm(at) * _force(at) ** 2,
    "temperature x force across": lambda at: _warm(at) ** 2 * _force(at, 2),
    "angle x force": lambda at: _over(at, np.sin(2.0 * at.angles_rad[:, 2:]) * _force(at)[:, 0]),
    "angle x force across": lambda at: _over(at, np.cos(at.angles_rad[:, 1:2]) * _force(at, 1)[:, 0]),
    "outer angle x force": lambda at: _over(at, np.cos(at.angles_rad[:, :1]) * _force(at, 2)[:, 0]),
    "time x square of the force": lambda at: _gone(at) * _force(at) ** 2,
    "time x two forces": lambda at: _gone(at) ** 2 * _force(at, 1) * _force(at, 2),
    "decay x force across": lambda at: np.exp(-_gone(at) / 0.3) * _force(at, 1),
    "last step x force": lambda at: _over(at, at.step_mps2 * _force(at)[:, 0]),
    "size of the last step x force": lambda at: _over(at, np.abs(at.step_mps2) * _force(at, 1)[:, 0]),
    "in proportion to the last step": lambda at: _over(at, at.step_mps2),
    "saturating hysteresis": lambda at: _over(at, np.tanh(at.step_mps2 / 6.0)),
    "play": lambda at: _over(at, _play(at.force_mps2[:, None] / G_MPS2)),
    "play on the way": lambda at: _over(at, _play(at.path_mps2 / G_MPS2)),
    "angle x temperature": lambda at: np.sin(at.angles_rad[:, None, 2:] + 0.3) * _warm(at) * np.ones(3),
    "third harmonic of an angle x temperature": lambda at: (
        np.sin(3.0 * at.angles_rad[:, None, 1:2]) * _warm(at) * np.ones(3)
    ),
    "angle x time": lambda at: np.cos(at.angles_rad[:, None, 2:]) * _gone(at) * np.ones(3),
    "last step x temperature": lambda at: at.step_mps2[:, None] * _warm(at),
    "last step x time": lambda at: at.step_mps2[:, None] * _gone(at),
    "temperature x time": lambda at: _warm(at) * _gone(at) * np.ones(3),
    "a rough map of the force": lambda at: _over(at, _map(at)),
    "a thirteenth harmonic of an angle": lambda at: _over(at, np.sin(13.0 * at.angles_rad[:, 2:]) * np.ones(3)),
}


def second_order(at: Visits) -> Floats:
    """The square of the force along each axis: an effect of the catalogue."""
    return _over(at, _force(at)[:, 0] ** 2)


def cross_coupling(at: Visits) -> Floats:
    """The product of the forces along each axis and the next: another one, cross-coupling-ip."""
    return _over(at, (_force(at) * _force(at, 1))[:, 0])


def beside(known: Callable[[Visits], Floats], name: str, sigmas: float, seed: int) -> SmallRun:
    """A run with an effect of the catalogue hidden, and one of none of half its size."""
    both = hidden_run(known, sigmas, seed), hidden_run(HIDDEN[name], 0.5 * sigmas, seed)
    return replace(both[0], hidden_mps2=both[0].hidden_mps2 + both[1].hidden_mps2)
