"""What effects add to the readings of three accelerometers, by formulas of the trial's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kf_calib.bench.arrays import Floats
from real_trials.recordings import GRAVITY_MPS2, RealRecording

_SMALL = 0.05  # of a column that the nine parameters leave: less is not visible
_LARGEST_MPS2 = 0.5  # of what is added: more is no small error, and the nine parameters are not linear in it
_ALIKE = 0.99  # of the square of what is seen of one effect that another one explains


def _since_arrival(recording: RealRecording) -> tuple[Floats, Floats]:
    """Return for each reading the time (n,) since the pose began, and the step (n, 3) of the specific force to it."""
    begins = recording.arrivals_s
    pose = np.clip(np.searchsorted(begins, recording.time_s, side="right") - 1, 0, None)
    forces = recording.means(recording.force_mps2)
    steps = np.vstack([np.zeros(3), np.diff(forces, axis=0)])
    return np.maximum(recording.time_s - begins[pose], 0.0), steps[pose]


def _of_force(formula: Callable[[Floats, Floats, Floats], Floats]) -> Callable[[RealRecording], Floats]:
    """Of the specific force along the input, pendulous and output axes in units of g."""

    def added(recording: RealRecording) -> Floats:
        along = recording.force_mps2 / GRAVITY_MPS2
        return formula(along, np.roll(along, -1, axis=1), np.roll(along, -2, axis=1))

    return added


def _of_time(formula: Callable[[Floats, Floats], Floats]) -> Callable[[RealRecording], Floats]:
    """Of the share of the run that has gone, (n, 1), and the specific force in units of g."""

    def added(recording: RealRecording) -> Floats:
        gone = recording.time_s / recording.time_s[-1]
        return formula(gone[:, None], recording.force_mps2 / GRAVITY_MPS2) * np.ones((1, 3))

    return added


def _settling(recording: RealRecording) -> Floats:
    since_s, step = _since_arrival(recording)
    tau_s = 0.5 * float(np.median(np.ptp(recording.dwells_s, axis=1)))
    return step * np.exp(-since_s / tau_s)[:, None]


EFFECTS: dict[str, Callable[[RealRecording], Floats]] = {
    "second-order": _of_force(lambda a, p, o: a**2),
    "third-order": _of_force(lambda a, p, o: a**3),
    "odd-quadratic": _of_force(lambda a, p, o: a * np.abs(a)),
    "bias-asymmetry": _of_force(lambda a, p, o: np.sign(a)),
    "scale-asymmetry": _of_force(lambda a, p, o: np.abs(a)),
    "cross-coupling-ip": _of_force(lambda a, p, o: a * p),
    "cross-coupling-io": _of_force(lambda a, p, o: a * o),
    "cross-coupling-po": _of_force(lambda a, p, o: p * o),
    "cross-axis-square": _of_force(lambda a, p, o: p**2),
    "bias-drift": _of_time(lambda t, a: t),
    "scale-drift": _of_time(lambda t, a: t * a),
    "warm-up": _of_time(lambda t, a: np.exp(-t / 0.2)),
    "hysteresis": lambda recording: np.sign(_since_arrival(recording)[1]),
    "settling": _settling,
}


def injected(recording: RealRecording, name: str, sigmas: float, seed: int) -> Floats | None:
    """An effect of this size with coefficients of random sizes, added to the readings, (n, 3); None if it is not
    visible beside the nine parameters."""
    shape = EFFECTS[name](recording) * np.random.default_rng([seed, *name.encode()]).normal(size=3)
    shape *= recording.scatter_mps2 / np.abs(shape).max()  # so small that it is linear
    size = float(np.linalg.norm(recording.seen(shape)))
    whole = np.linalg.norm(np.sum(recording.means(shape) * _directions(recording), axis=1)) / recording.scatter_mps2
    shape *= sigmas / size
    return None if size < _SMALL * whole or np.abs(shape).max() > _LARGEST_MPS2 else shape


def alike(recording: RealRecording, added: Floats) -> set[str]:
    """The effects that explain what is seen of a change, to 99 % of its square: no one can tell them apart."""
    seen, equal = recording.seen(added), set[str]()
    for name, formula in EFFECTS.items():
        shape = formula(recording)
        shape *= recording.scatter_mps2 / np.abs(shape).max()
        columns = np.array([recording.seen(shape * channel) for channel in np.eye(3)]).T
        left, singular, _ = np.linalg.svd(columns, full_matrices=False)
        basis = left[:, singular > 1e-6 * singular[0]]
        if np.sum((basis.T @ seen) ** 2) > _ALIKE * np.sum(seen**2):
            equal.add(name)
    return equal


def _directions(recording: RealRecording) -> Floats:
    forces = recording.means(recording.force_mps2)
    return forces / np.linalg.norm(forces, axis=1, keepdims=True)
