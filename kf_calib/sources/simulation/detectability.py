"""The size of a hidden effect in sigma: how far it stands out of what the twelve parameters can absorb.

    n = || P V^(-1/2) Delta ||

Delta: what the effect alone adds to the readings of all dwells, by two noise-free runs of the simulator, with it and
without. V: covariance of the readings under the noise of the run. P: takes out what twelve affine parameters absorb,
for each accelerometer three sensitivities to the specific force at the recorded angles, and a bias. An effect of size n
raises the chi-squared of the misfit by n^2 (noncentrality; Kay, Fundamentals of Statistical Signal Processing II, 7.7).

Every reading counts that an evaluation uses: not the first second after an arrival (at most a third of the dwell), nor
the last quarter before a departure (at most a tenth). V = kappa sigma^2 1 + (1 1^T) x D within a dwell of N readings:
white noise, for AR(1) times kappa = (1 + phi) / (1 - phi), and offsets of the whole dwell,

    D = (scatter^2 + flicker^2 ln(dwells) / (2 ln 2)) 1 + setting^2 S (g^2 1 - f f^T) S^T,

S the rows of sensitivities, f the specific force. So the mean of a dwell, of covariance D + kappa sigma^2 / N, and what
departs from it, of covariance kappa sigma^2, are independent: sums over each dwell suffice, and memory stays flat.
Random walk, outliers and errors of the encoders are not in V, nor is vibration: it is at its own frequency, far above
what an effect is sought by. Of the rectification K2 v^2 of a sinusoid what counts is its mean over a cycle: the rest is
at twice its frequency, where no reading tells it from a vibration that is not quite a sinusoid.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from kf_calib.bench.arrays import EXACT, Floats, Times
from kf_calib.errors import InputError
from kf_calib.sources.simulation.injected.kinds import Hidden, NoSizeError
from kf_calib.sources.simulation.sensors import Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation, without_angles
from kf_calib.support.output_files import write_whole

_SETTLE_NS, _LEAD_NS = 1_000_000_000, 250_000_000
_SEEN = 1e-6  # of the effect before projection; below it is what absorbing leaves by rounding
_TOLERANCE = 2e-3
_ROUNDS = 12
_RANK = 1e-12


def sized(simulation: Simulation, effect: Hidden, sigmas: float) -> Hidden:
    """The effect with all its coefficients times the number that makes it ``sigmas`` large in this run.

    Raises NoSizeError where no number does. By the secant method on the logarithms: most effects are proportional to
    their coefficients, and take one step.
    """
    if not simulation.noise.white_mps2:
        raise InputError("a size in sigma needs white noise of the readings: give some, or a size with a unit.")
    logarithm, slope, before = 0.0, 1.0, (0.0, 0.0)
    for round_ in range(_ROUNDS):
        scaled = effect.scaled(math.exp(logarithm))
        size_sigma = sizes_in_sigma(simulation, [scaled])[0]
        if size_sigma is None:
            break
        missing = math.log(sigmas / size_sigma)
        if abs(missing) < _TOLERANCE:
            return scaled
        if round_ and logarithm != before[0]:
            slope = float(np.clip((before[1] - missing) / (logarithm - before[0]), 0.3, 3.0))
        before = logarithm, missing
        logarithm += missing / slope
    else:
        raise NoSizeError(f"{effect.name} comes to {sigmas:g} sigma at no size: give a size with a unit.")
    raise NoSizeError(f"{_why_unseen(effect)}, so no size in sigma exists for it: give a size with a unit.")


def sizes_in_sigma(simulation: Simulation, effects: Sequence[Hidden]) -> list[float | None]:
    """n of each effect alone, in a run on this bench with this noise; None where it cannot be seen, or has no n."""
    if not simulation.noise.white_mps2:
        return [None] * len(effects)
    measured = [effect for effect in effects if effect.kind.stage != "record"]
    found = iter(_sizes_in_sigma(simulation, measured) if measured else ())
    return [next(found) if effect.kind.stage != "record" else None for effect in effects]


def _why_unseen(effect: Hidden) -> str:
    if effect.kind.stage == "record":
        return f"{effect.name} acts on readings together with their noise"
    temperature = " and temperatures" if effect.kind.name.startswith("thermal") else ""
    return f"{effect.name} cannot be seen with these orientations{temperature}"


def _sizes_in_sigma(simulation: Simulation, effects: Sequence[Hidden]) -> list[float | None]:
    """n of each effect, None where nothing but rounding is left of it.

    All rows of all dwells, whitened: unknowns (r, 12) in blocks (sensitivities times g, bias), effects (r, k).
    """
    noise, gravity_mps2 = simulation.noise, simulation.bench.gravity_mps2
    sigma = noise.white_mps2 * math.sqrt((1.0 + noise.ar1_phi) / (1.0 - noise.ar1_phi))
    dwells = _moments(simulation, effects)
    if not dwells:
        return [None] * len(effects)
    rows = [part for dwell in dwells for part in (_departures(dwell, sigma), _mean(dwell, sigma, simulation))]
    unknowns, added = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    unknowns[:, [0, 1, 2, 4, 5, 6, 8, 9, 10]] /= gravity_mps2
    left = added - unknowns @ np.linalg.lstsq(unknowns, added, rcond=_RANK)[0]
    least = EXACT * gravity_mps2 * math.sqrt(3.0 * sum(dwell.count for dwell in dwells)) / sigma
    sizes = zip(np.linalg.norm(left, axis=0).tolist(), np.linalg.norm(added, axis=0).tolist(), strict=True)
    return [size if size > max(least, _SEEN * before) else None for size, before in sizes]


@dataclass
class _Moments:
    """Of the rows x of one dwell: count, mean (m,), and a triangle R (m, m), R^T R = sum (x - mean)(x - mean)^T.

    x: the readings without any effect (3), then what each effect adds to them (3 each), m/s^2. The former are affine
    in the specific force, by a regular matrix: they stand for it among the unknowns.
    """

    count: int
    mean: Floats
    triangle: Floats

    def add(self, rows: Floats) -> None:
        count, mean = len(rows), rows.mean(axis=0)
        total = self.count + count
        shift = math.sqrt(self.count * count / total) * (mean - self.mean)
        self.triangle = np.asarray(np.linalg.qr(np.vstack([self.triangle, shift, rows - mean]), mode="r"))
        self.mean = self.mean + count / total * (mean - self.mean)
        self.count = total


def _moments(simulation: Simulation, effects: Sequence[Hidden]) -> list[_Moments]:
    """Of each dwell that has readings which count."""
    width = 3 + 3 * len(effects)
    dwells = [_Moments(0, np.zeros(width), np.zeros((width, width))) for _ in simulation.plan]
    arrive_ns, leave_ns = simulation.motion.arrive_ns, simulation.motion.leave_ns
    length_ns = leave_ns - arrive_ns
    from_ns = arrive_ns + np.minimum(_SETTLE_NS, length_ns // 3)
    until_ns = leave_ns - np.minimum(_LEAD_NS, length_ns // 10)
    for time_ns, rows in _rows(simulation, effects):
        starts, ends = np.searchsorted(time_ns, from_ns), np.searchsorted(time_ns, until_ns)
        for dwell in np.flatnonzero(ends > starts).tolist():
            dwells[dwell].add(rows[starts[dwell] : ends[dwell]])
    return [dwell for dwell in dwells if dwell.count]


def _rows(simulation: Simulation, effects: Sequence[Hidden]) -> Iterator[tuple[Times, Floats]]:
    """Batch by batch: times since the first sample (n,), and rows x (n, m) of ``_Moments``.

    The runs go side by side, at the full rate and through the slews: effects remember what was before.
    """
    hidden = [[], *([effect.counted] for effect in effects)]
    first_ns: int | None = None
    for batches in zip(*(simulation.hiding(one, TrueNoise()) for one in hidden), strict=True):
        time_ns, values = batches[0].accel.time_ns, [batch.accel.values for batch in batches]
        first_ns = int(time_ns[0]) if first_ns is None else first_ns
        yield time_ns - first_ns, np.hstack([values[0], *(own - values[0] for own in values[1:])])


def _departures(dwell: _Moments, sigma: float) -> tuple[Floats, Floats]:
    """Rows of what departs from the mean of a dwell, (3 m, 12) and (3 m, k)."""
    triangle = dwell.triangle / sigma
    sensitivities = np.column_stack([triangle[:, :3], np.zeros(len(triangle))])
    added = [triangle[:, 3 + i :: 3] for i in range(3)]
    return np.asarray(np.kron(np.eye(3), sensitivities), float), np.concatenate(added)


def _mean(dwell: _Moments, sigma: float, simulation: Simulation) -> tuple[Floats, Floats]:
    """Rows of the mean of a dwell, (3, 12) and (3, k)."""
    noise, sensors = simulation.noise, simulation.sensors
    sigma_mps2 = math.hypot(noise.dwell_sigma_mps2(len(simulation.plan)), sigma / math.sqrt(dwell.count))
    columns = np.hstack([np.kron(np.eye(3), [*dwell.mean[:3], 1.0]), dwell.mean[3:].reshape(-1, 3).T])
    rows = np.asarray(columns / sigma_mps2, float)
    setting_rad = math.radians(noise.setting_sigma_deg)
    whitened = _beside_rotations(rows, sensors, dwell.mean[:3], setting_rad, sigma_mps2) if setting_rad else rows
    return whitened[:, :12], whitened[:, 12:]


def _beside_rotations(
    rows: Floats, sensors: Sensors, mean_mps2: Floats, setting_rad: float, sigma_mps2: float
) -> Floats:
    """Return the rows (3, m) of a mean reading with its setting error, a rotation of any size, eliminated by QR."""
    sensitivities = sensors.sensitivities
    force_mps2 = np.linalg.solve(sensitivities, mean_mps2 - sensors.biases_mps2)
    turning = sensitivities @ np.cross(np.eye(3), force_mps2).T / sigma_mps2
    nuisances = np.vstack([turning, np.eye(3) / setting_rad])
    complement = np.linalg.qr(nuisances, mode="complete")[0][:, 3:]
    return np.asarray(complement[:3].T @ rows, float)


def truth_file(recording: Path) -> Path:
    """The side file with the truth of ``NAME.mcap``: ``NAME.truth.json``."""
    return recording.parent / f"{recording.stem}.truth.json"


def truth_of(simulation: Simulation, angles: bool = True) -> dict[str, Any]:
    """Parameters by symbol (rad, 1, m/s^2), noise, seed, effects.

    ``size_sigma`` of an effect is worked out by further runs (``detectability``), for a recording with ``angles`` or
    without; None where it is not seen.
    """
    sizes = sizes_in_sigma(simulation if angles else without_angles(simulation), simulation.hidden)
    at_end = simulation.parameters_at_end()
    return {
        "grade": simulation.grade,
        "seed": simulation.seed,
        "parameters": dict(simulation.sensors.parameters),
        **({} if at_end is None else {"parameters_at_end": at_end}),
        "noise": asdict(simulation.noise),
        "ambient": asdict(simulation.ambient),
        "effects": [effect.truth | {"size_sigma": n} for effect, n in zip(simulation.hidden, sizes, strict=True)],
    }


def write_truth(simulation: Simulation, recording: str | PathLike[str], angles: bool = True) -> Path:
    """Writes ``NAME.truth.json`` beside the recording ``NAME.mcap``; returns its path. Raises InputError."""
    path = truth_file(Path(recording))
    write_whole(path, (json.dumps(truth_of(simulation, angles), indent=2) + "\n").encode())
    return path
