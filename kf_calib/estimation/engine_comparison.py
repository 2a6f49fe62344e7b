"""The same recording evaluated in three ways: by the block engine, by filterpy sample by sample, and by batch least
squares.

With a diffuse prior and without process noise the three agree to rounding. They may differ if a prior is stated or if
the biases walk, because only the filters use these. The gate is common to all three.

Batch least squares, with the same columns, is the textbook alternative to the filter and the reference for it: all rows
of a recording in one dense system, generalised least squares with the covariance of the noise model by one QR
decomposition. Its memory grows with the length of the recording, while that of the filter does not.
"""

from __future__ import annotations

import itertools
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TypeVar

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.streams import Source, Table
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.calibration import calibrate, filterpy_estimate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.free_attitude import holding_frame
from kf_calib.estimation.kalman_filterpy import Samples, samples_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.square_root_information import scale_columns
from kf_calib.noise.allan import AllanDeviation, LongestDwells
from kf_calib.sources.opening import opened
from kf_calib.support import stage

Result = TypeVar("Result")


@dataclass(frozen=True)
class Way:
    """One way of estimating and its cost.

    - wall_s: elapsed time, s.
    - peak_mb: peak memory of numpy and Python, MB. It is measured in a separate run, because this slows down many small
      steps several times; filterpy's is measured over its first readings, since it keeps none.
    - max_difference_sigma: largest absolute difference of a parameter from the block engine, in sigma.
    - max_relative_variance: largest relative difference of a variance.
    """

    estimate: Estimate
    wall_s: float
    peak_mb: float
    max_difference_sigma: float = 0.0
    max_relative_variance: float = 0.0


@dataclass(frozen=True)
class Comparison:
    """The results of the three ways, and remarks on why they may differ.

    - running_sigma: for each of the other ways, the differences (D, p) of the twelve parameters and the coefficients
      from the block engine after each dwell, in the sigmas that these have then; NaN while not determined.
    - allan: Allan deviation of the longest dwells; None for a table, which has no readings.
    """

    result: Calibration
    ways: dict[str, Way]
    remarks: tuple[str, ...]
    running_sigma: Mapping[str, Floats] = field(default_factory=dict[str, Floats])
    allan: AllanDeviation | None = None

    @property
    def max_difference_sigma(self) -> float:
        """Largest difference of a parameter between any way and the block engine, in sigma."""
        return max(way.max_difference_sigma for way in self.ways.values())


def compare(
    source: Source | str | PathLike[str],
    settings: Settings | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Evaluate a source (or the recording at a path) in all three ways and measure each.

    ``on_progress`` is called with the share that is done, which begins again for each way.
    """
    source = opened(source)
    settings = replace(settings or Settings(), engine="block")
    stage.say("block engine")
    result, block_s = _timed(lambda: calibrate(source, settings, on_progress))

    by_filterpy, around = list[Floats](), result.model.nominal_state()

    def batch() -> Estimate:
        return result.considering(*least_squares(held(samples()), around))

    def samples() -> Iterator[Samples]:
        return samples_of(Pass(source, settings).rows(), result.linearised, result.noise.weights)

    def held(some: Iterable[Samples]) -> Iterator[Samples]:
        return holding_frame(some, result.linearised, result.noise.weights)

    stage.say("filterpy, reading by reading")
    filterpy, filterpy_s = _timed(
        lambda: filterpy_estimate(source, result, on_progress=on_progress, on_dwell=by_filterpy.append)
    )
    stage.say("batch least squares")
    least, batch_s = _timed(batch)
    stage.say("memory of each")
    ways = {
        "block": Way(result.estimate, block_s, _peak_mb(lambda: calibrate(source, settings))),
        "filterpy": Way(
            filterpy, filterpy_s, _peak_mb(lambda: filterpy_estimate(source, result, at_most=FEWEST_READINGS))
        ),
        "batch": Way(least, batch_s, _peak_mb(batch)),
    }
    ways = {name: _against(way, result.estimate) for name, way in ways.items()}
    longest = LongestDwells(result.fit.dwells, result.noise)
    running = {"filterpy": by_filterpy, "batch": running_states(held(longest.passed_by(samples())), around)}
    differences = {name: _along(states, result) for name, states in running.items()}
    allan = None if isinstance(source, Table) else longest.allan_deviation()
    return Comparison(result, ways, tuple(_remarks(settings, result)), differences, allan)


def _along(states: Iterable[Floats], result: Calibration) -> Floats:
    """Return the differences (D, p) of the parameters and coefficients in ``states`` (D, p) from those of the block
    engine after each dwell, in their sigmas then."""
    differences = list[Floats]()
    for state, visit in zip(states, result.visits, strict=True):
        of_block = visit.estimate
        other = replace(of_block, state=state)
        difference = np.append(other.parameters - of_block.parameters, other.effects - of_block.effects)
        differences.append(difference / np.append(of_block.sigma, of_block.effect_sigma))
    return np.array(differences)


def _timed(run: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of a call and its duration, s."""
    begin = time.perf_counter()
    return run(), time.perf_counter() - begin


def _peak_mb(run: Callable[[], object]) -> float:
    """Return the peak memory of a call, MB."""
    tracemalloc.start()
    run()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def _against(way: Way, reference: Estimate) -> Way:
    """Return the way with its distances from the reference, over all parameters and coefficients that are
    determined."""
    ones = np.concatenate([way.estimate.parameters, way.estimate.effects])
    others = np.concatenate([reference.parameters, reference.effects])
    sigma = np.concatenate([reference.sigma, reference.effect_sigma])
    seen, known = np.isfinite(sigma), reference.determined
    variance = np.diag(way.estimate.covariance)[known] / np.diag(reference.covariance)[known]
    return replace(
        way,
        max_difference_sigma=float((np.abs(ones - others)[seen] / sigma[seen]).max(initial=0.0)),
        max_relative_variance=float(np.abs(variance - 1).max(initial=0.0)),
    )


def _remarks(settings: Settings, result: Calibration) -> list[str]:
    """Return sentences on why the ways may differ."""
    said = []
    if not settings.prior.diffuse:
        said.append("a prior was stated: the filters use it, batch least squares does not, so it may differ.")
    if result.noise.walk.steps:
        said.append(
            "the biases walk: the filters follow them (the block engine by what parabolas see of a path, some 0.001 "
            "sigma), batch least squares holds them still, so it may differ."
        )
    if result.counts.gated:
        said.append(f"the gate rejected {result.counts.gated} readings, the same ones for all three.")
    if not said:
        said.append("diffuse prior, no process noise, the same gate: the three may differ by rounding only.")
    return said


def least_squares(samples: Iterable[Samples], around: Floats) -> tuple[Floats, Floats]:
    """State (p,) and covariance (p, p) from all samples, with a diffuse prior and without process noise.

    Combinations of the state that the samples do not determine keep their value in ``around`` (p,), and their variance
    is not in the covariance.

    After division by the white sigma, the rows of a dwell have the covariance V = I + B B^T, where B holds the dwell's
    nuisance columns times their sigmas. They are whitened by V^(-1/2) = I - U (1 - (1 + s^2)^(-1/2)) U^T from the thin
    SVD of B.
    """
    by_dwell: dict[tuple[int, bool], list[Samples]] = {}
    for piece in samples:
        by_dwell.setdefault((piece.dwell, piece.moving), []).append(piece)
    whitened = (_whitened(pieces) for pieces in by_dwell.values())
    stacked = np.concatenate(list(whitened))
    scale = np.linalg.norm(stacked[:, :-1], axis=0)
    return _solution(stacked, np.where(scale > 0, scale, 1.0), around)


def running_states(samples: Iterable[Samples], around: Floats) -> Floats:
    """States (D, p) from the samples of the first dwell alone, the first two, ... all D; slews belong to the dwell
    before. Each is the least-squares solution as in ``least_squares``; the rows so far are kept as a triangle."""

    def solved(upper: Floats) -> Floats:
        """Return the state; a column of rounding size alone does not determine what other dwells may."""
        return _solution(upper, scale_columns(upper)[1], around)[0]

    upper, states = np.zeros((0, len(around) + 1)), list[Floats]()
    for (_, moving), pieces in itertools.groupby(samples, key=lambda piece: (piece.dwell, piece.moving)):
        if not moving and len(upper):
            states.append(solved(upper))
        rows = _whitened(list(pieces))
        upper = triangle(np.vstack([upper, rows]))
    return np.array([*states, solved(upper)])


def _solution(rows: Floats, scale: Floats, around: Floats) -> tuple[Floats, Floats]:
    """Return state (p,) and covariance (p, p) from whitened rows [H | z] (n, p + 1), columns divided by ``scale``."""
    design, readings = rows[:, :-1], rows[:, -1]
    left, upper = np.linalg.qr(design / scale)
    rotated, singular, right = np.linalg.svd(upper, full_matrices=False)  # fewer rows than columns at first
    seen = singular > ROUNDING * singular[0]
    inverse = (right[seen].T / singular[seen]) / scale[:, None]
    solution = around + inverse @ (rotated[:, seen].T @ (left.T @ (readings - design @ around)))
    return np.asarray(solution, float), np.asarray(inverse @ inverse.T, float)


def _whitened(pieces: list[Samples]) -> Floats:
    """Return the whitened rows [H | z] (3 n, p + 1) of one dwell's samples."""
    rows = np.concatenate([np.concatenate([p.observation, p.readings[:, :, None]], axis=2) for p in pieces])
    whiten = np.concatenate([np.repeat(np.linalg.inv(p.root_mps2)[None], len(p.readings), axis=0) for p in pieces])
    flat = (whiten @ rows).reshape(-1, rows.shape[2])
    if pieces[0].nuisances.shape[2]:
        shared = (whiten @ np.concatenate([p.nuisances for p in pieces])).reshape(len(flat), -1)
        left, singular, _ = np.linalg.svd(shared, full_matrices=False)
        flat = flat - left @ ((1 - 1 / np.sqrt(1 + singular**2))[:, None] * (left.T @ flat))
    return flat
