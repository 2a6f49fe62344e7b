"""Faults of a bench and its sensors that are in no catalogue, on a bench of three gimbals written with scipy.

Each is a function of the state of the bench, of random constants: an error of a gimbal's angle, a turn of the base or
of the block, a change of the scale factors or of the biases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from helpers.independent_bench import DWELL_S, HZ, SLEW_S, Error, IndependentBench, State
from scipy.signal import lfilter

from kf_calib.bench.arrays import Floats

_MEAN_MPS2 = IndependentBench(0).white_mps2 / np.sqrt(DWELL_S * HZ)
Course = Callable[[State, np.random.Generator], Floats]
"""One value at each instant (n,), or three (n, 3)."""


def _angle(gimbal: int, waves: Callable[[Floats], Floats]) -> Course:
    return lambda at, rng: waves(at.angles_rad[:, gimbal] + rng.uniform(0.0, 2.0 * np.pi))


def _since(at: State, rng: np.random.Generator) -> Floats:
    """What has decayed since the arrival, 0 on the way."""
    return np.where(at.since_s > 0.0, np.exp(-at.since_s / rng.uniform(1.5, 15.0)), 0.0)


def _gone(at: State) -> Floats:
    return at.time_s / at.time_s[-1]


def _decay(at: State, rng: np.random.Generator) -> Floats:
    return np.exp(-_gone(at) / rng.uniform(0.1, 0.4))


def _from(at: State, rng: np.random.Generator) -> Floats:
    """1 from a moment on."""
    return (_gone(at) > rng.uniform(0.25, 0.75)).astype(float)


def _telegraph(at: State, rng: np.random.Generator) -> Floats:
    return (np.searchsorted(rng.exponential(40.0, 40).cumsum(), at.time_s) % 2).astype(float)


def _wandering(at: State, rng: np.random.Generator) -> Floats:
    return rng.standard_normal(len(at.time_s)).cumsum()


def _returning(at: State, rng: np.random.Generator) -> Floats:
    """What wanders and comes back, within a small part of the run."""
    kept = float(np.exp(-at.time_s[1] / (at.time_s[-1] * rng.uniform(0.05, 0.2))))
    return lfilter([1.0], [1.0, -kept], rng.standard_normal(len(at.time_s)))


def _leaning(at: State, rng: np.random.Generator) -> Floats:
    first = rng.integers(3, 15)
    return ((at.dwell >= first) & (at.dwell < first + 4)).astype(float)


def _switched_on_again(at: State, rng: np.random.Generator) -> Floats:
    since = _gone(at) - rng.uniform(0.3, 0.6)
    return np.where(since > 0.0, np.exp(-since / 0.2), 0.0)


def _turning_point(at: State, rng: np.random.Generator) -> Floats:
    return np.abs(_gone(at) - rng.uniform(0.35, 0.65))


def _thermostat(cycles: float) -> Course:
    """A triangle wave, of so many cycles in the run."""
    return lambda at, rng: np.abs((cycles * _gone(at) + rng.uniform()) % 1.0 - 0.5)


def _bend(at: State, rng: np.random.Generator) -> Floats:
    """What changes its rate in the middle of the run."""
    return np.maximum(_gone(at) - rng.uniform(0.3, 0.7), 0.0) + rng.uniform(-0.5, 0.5) * _gone(at)


def _before(gimbal: int) -> Course:
    """With the angle of a gimbal in the orientation before."""

    def course(at: State, rng: np.random.Generator) -> Floats:
        before = at.angles_rad[:, gimbal] - at.moves_rad[:, gimbal]
        return np.cos(before + rng.uniform(0.0, 2.0 * np.pi))

    return course


def _way(at: State) -> Floats:
    """The way (n, 3) that each gimbal has turned."""
    return np.abs(np.diff(at.angles_rad, axis=0, prepend=at.angles_rad[:1])).cumsum(axis=0)


def _motors(at: State, rng: np.random.Generator) -> Floats:
    """The warmth of the motors: each turn adds to it, and a share of it goes with each step of time."""
    way = _way(at) @ rng.uniform(0.2, 1.0, 3)
    kept = float(np.exp(-at.time_s[1] / (at.time_s[-1] * rng.uniform(0.05, 0.3))))
    return lfilter([1.0], [1.0, -kept], np.diff(way, prepend=way[:1]))


FAULTS: dict[str, tuple[str, Course]] = {
    "a gimbal creeps by its move": ("gimbals", lambda at, rng: _since(at, rng) * at.moves_rad[:, 2]),
    "a gimbal creeps one way": ("gimbals", lambda at, rng: _since(at, rng) * (at.dwell > 0)),
    "a gimbal errs with the angle of another": ("gimbals", _angle(1, np.sin)),
    "a saw-tooth error of an encoder": ("gimbals", lambda at, rng: (at.angles_rad[:, 2] / np.radians(72.0)) % 1.0),
    "an encoder slips": ("gimbals", _from),
    "an encoder is off for a while": ("gimbals", _leaning),
    "a play that goes with the angle": (
        "gimbals",
        lambda at, rng: np.sign(at.moves_rad[:, 2]) * np.abs(np.sin(at.angles_rad[:, 2])),
    ),
    "the zero of an encoder wanders": ("gimbals", _wandering),
    "the zero of an encoder wanders and comes back": ("gimbals", _returning),
    "somebody leans on the table": ("base", _leaning),
    "the table relaxes": ("base", _decay),
    "the table wanders": ("base", _wandering),
    "the table wanders and comes back": ("base", _returning),
    "the table tilts with the outer gimbal": ("base", _angle(0, np.cos)),
    "the table is loaded, and relaxes": ("base", _switched_on_again),
    "the table tilts twice a turn": ("base", lambda at, rng: np.cos(2.0 * at.angles_rad[:, 0])),
    "the block slips": ("mount", _from),
    "the block relaxes": ("mount", _decay),
    "the block wanders": ("mount", _wandering),
    "the block wanders and comes back": ("mount", _returning),
    "the block sags with the middle gimbal": ("mount", _angle(1, np.sin)),
    "the block wobbles twice a turn": ("mount", lambda at, rng: np.sin(2.0 * at.angles_rad[:, 2] + rng.uniform(0, 6))),
    "a gain switches": ("scale", _from),
    "a gain of two levels": ("scale", _telegraph),
    "scale factors change their rate": ("scale", _bend),
    "scale factors follow a thermostat": ("scale", _thermostat(4.4)),
    "scale factors, switched on again": ("scale", _switched_on_again),
    "a scale factor wanders": ("scale", _wandering),
    "scale factors go with the outer gimbal": ("scale", _angle(0, np.cos)),
    "scale factors turn back": ("scale", _turning_point),
    "a cable winds up": ("bias", lambda at, rng: at.angles_rad[:, 2]),
    "a cable drags": ("bias", lambda at, rng: np.sign(at.moves_rad[:, 2])),
    "a bias goes with a gimbal three times a turn": ("bias", _angle(2, lambda angle: np.sin(3.0 * angle))),
    "a bias goes with the angle before": ("bias", _before(2)),
    "a bias of two levels": ("bias", _telegraph),
    "a bias jumps": ("bias", _from),
    "a bias turns back": ("bias", _turning_point),
    "switched on again": ("bias", _switched_on_again),
    "motors warm the biases": ("bias", _motors),
    "motors warm the scale factors": ("scale", _motors),
    "a bearing wears": ("base", lambda at, rng: _way(at)[:, 1]),
    "a cable wears": ("bias", lambda at, rng: _way(at)[:, 2]),
}


def faulty_run(name: str, sigmas: float, seed: int, dwells: int = 24) -> IndependentBench:
    """A run with a fault in one direction, or one accelerometer, in half of the runs, else in all, of this size.

    The size is the norm of what the means of the dwells are moved by, less what bias and sensitivities of each
    accelerometer take of it, over the noise of a mean.
    """
    place, course = FAULTS[name]
    run, rng = IndependentBench(seed, dwells), np.random.default_rng([seed, 4])
    along = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else rng.standard_normal(3)
    # about the axis of a gimbal a turn of the block is an error of its encoder, and about the vertical nothing shows
    turns = {"gimbals": np.eye(3)[2], "base": np.eye(3)[0], "mount": along * (0.0, 1.0, 1.0) + (0.0, 0.1, 0.0)}
    along, state = turns.get(place, along), run.state
    values = course(state, rng)[:, None] * along
    unit = 1e-5 / float(np.abs(values).max())
    moved = _means(run, _fault(place, unit * values)) - _means(run)
    forces = np.column_stack([_means(run), np.ones(dwells)])
    basis = np.linalg.qr(forces)[0]
    size = float(np.linalg.norm(moved - basis @ (basis.T @ moved))) / _MEAN_MPS2
    return replace(run, **_fault(place, values * unit * sigmas / size))


def _fault(place: str, values: Floats) -> dict[str, Error]:
    return {place: lambda state: values}


def _means(run: IndependentBench, fault: dict[str, Error] | None = None) -> Floats:
    """Means (D, 3) of the readings of the dwells, without noise."""
    (batch,) = replace(run, white_mps2=0.0, **(fault or {}))
    state = run.state
    inside = (state.time_s % (DWELL_S + SLEW_S) < DWELL_S) & (state.since_s >= 0.0)
    return np.array([batch.accel.values[inside & (state.dwell == k)].mean(axis=0) for k in range(run.dwells)])
