"""Whether a calibration still holds for a new recording of the same block.

The dwell means z of the new run are predicted by the old state x1 with its covariance P1. The normalised misfit

    min_x  |R^(-1/2) (z - H x)|^2 + |P1^(-1/2) (x - x1)|^2

is chi-squared distributed with one degree of freedom a mean reading if nothing has changed, however few the dwells;
R is the noise of the means, and leaves one degree of freedom a dwell, the size of f, where no angles are used. Where
the new run determines a parameter by itself, its difference from the old value is tested too, the smallest of all
p-values being corrected for their number. Effects that belong to the course of a run or to the platform may differ:
their coefficients are free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Source
from kf_calib.effects import Effect
from kf_calib.effects.inputs import beyond_force_and_temperature
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.attitude import linearised_at
from kf_calib.estimation.calibration import evaluate_fit
from kf_calib.estimation.correction import Correction
from kf_calib.estimation.dwell_pass import Pass, refuse_unusable
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import SQUARE, Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, mean_covariances
from kf_calib.noise.terms import Scatter
from kf_calib.sources.files.record_files import fingerprint
from kf_calib.support.tail_probabilities import chi_squared_tail, sidak

MOVED_LEVEL = 0.01
"""A calibration that still holds is said not to in one verification of a hundred: half of them by the misfit as a
whole, half by a parameter that seems to have moved."""

_DIRECTIONS = 4000
_ROUNDS = 6  # till columns and state agree; the error of each is about the square of the one before


@dataclass(frozen=True)
class MovedParameter:
    """The change of one parameter or coefficient from the old calibration to the new run, in SI.

    p_value: that it did not move, corrected for the number of those tested.
    """

    symbol: str
    unit: str
    old: float
    new: float
    difference: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Verification:
    """The result of a verification.

    holds: whether the new run agrees with the old calibration. p_value, statistic, dof: of the joint test. moves: of
    all parameters that both determine, the clearest first. new: the calibration by the new run alone (None: its
    orientations determine too little). residual_rms_mps2: of the new means less their prediction by the old
    calibration. worst_mps2, worst_sigma_mps2: largest error, over all directions of gravity, of readings corrected by
    the old calibration, and its sigma (None where the new run does not determine them). free: effects whose
    coefficients were not compared.
    warnings: sentences.
    """

    holds: bool
    p_value: float
    statistic: float
    dof: int
    moves: tuple[MovedParameter, ...]
    new: Calibration | None
    dwells: int
    residual_rms_mps2: float
    worst_mps2: float | None
    worst_sigma_mps2: float | None
    free: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def moved(self) -> tuple[MovedParameter, ...]:
        """The parameters that have moved significantly."""
        return tuple(move for move in self.moves if move.p_value < 0.5 * MOVED_LEVEL)


def verify(
    saved: SavedCalibration,
    model: Model,
    source: Source,
    settings: Settings | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Verification:
    """Compare a calibration with a new recording; model: that of the calibration (``saved.model()``).

    Raises InputError if one of the two was made without angles.
    """
    refuse_other_frame(saved, source.bench)
    settings = replace(settings or Settings(), effects=())
    passed = Pass(source, settings)
    dwells = passed.fold(on_progress)
    refuse_unusable(dwells, passed.counts, source.bench)
    with one_blas_thread():
        fitted = fit(dwells, Model(source.bench, model.effects))
        free = tuple(str(each) for each in model.effects if beyond_force_and_temperature(each, source.bench))
        statistic, rms = _misfit(saved, fitted, _noise(saved, fitted), free)
        free_count = sum(len(range(*model.parts[name].indices(model.count))) for name in free)
        dof = (1 if fitted.noise.attitude_unknown else 3) * len(dwells) - free_count
        p_value = chi_squared_tail(dof, statistic)
        new = evaluate_fit(fitted, settings)
        seen = None if new.estimate.unseen.any() else new
        moves = _moves(saved, new, free)
        worst = (None, None) if seen is None else _worst(saved, model, seen)
    clearest = min((move.p_value for move in moves), default=1.0)
    both = min(1.0, 2.0 * min(p_value, clearest))  # two tests, of which either may say so
    return Verification(
        both >= MOVED_LEVEL, both, statistic, dof, moves, seen, len(dwells), rms, *worst, free,
        (*source.warnings, *passed.counts.sentences(), *_warnings(saved, source, new)),
    )  # fmt: skip


def _noise(saved: SavedCalibration, fitted: Fit) -> Noise:
    """Return the noise of the new run; what is not stated from dwell to dwell is no less than it was in the old one."""
    noise, old = fitted.noise, saved.noise
    if not noise.scatter.stated:
        noise = noise.with_terms(Scatter(np.maximum(noise.scatter_mps2, old.dwell_sigma_mps2)))
    if not noise.setting.stated:
        size_rad = max(noise.setting_rad, float(np.radians(old.angle_sigma_deg)))
        noise = noise.with_terms(replace(noise.setting, size_rad=size_rad))
    return noise


def _misfit(saved: SavedCalibration, fitted: Fit, noise: Noise, free: Sequence[str]) -> tuple[float, float]:
    """Return the normalised misfit of the new means, and the rms of their residuals by the old state, m/s^2.

    Without angles the columns turn with the axes: they are those of the state that fits best within the old sigmas,
    found in turn.
    """
    old, model = np.array(saved.state.values), fitted.linearised.model
    if not noise.attitude_unknown:
        means, at = fitted.linearised.means, fitted.linearised.state
        misfit, _ = _least_misfit(saved, model, means, mean_covariances(noise, means, at), free)
        return misfit, _rms(means, old)
    means, state, misfit = linearised_at(fitted.dwells, model, old, noise).means, old, 0.0
    rms = _rms(means, old)
    for _ in range(_ROUNDS):
        means = linearised_at(fitted.dwells, model, state, noise).means
        misfit, state = _least_misfit(saved, model, means, mean_covariances(noise, means, state), free)
    return misfit, rms


def _rms(means: Means, state: Floats) -> float:
    """Return the rms of mean readings less those of a state."""
    return float(np.sqrt(np.mean((means.readings - means.design @ state) ** 2)))


def _least_misfit(
    saved: SavedCalibration, model: Model, means: Means, covariances: Floats, free: Sequence[str]
) -> tuple[float, Floats]:
    """Return the least normalised misfit of new means and old state together, and the state that has it."""
    old = np.array(saved.state.values)
    given_up = [k for name in free for k in range(*model.parts[name].indices(model.count))]
    kept = np.delete(np.arange(model.count), given_up)
    covariance = (np.array(saved.state.covariance) + _square(saved))[np.ix_(kept, kept)]
    lower = np.linalg.inv(np.linalg.cholesky(covariances))
    rows = (lower @ means.design).reshape(-1, model.count)
    right = np.einsum("dij,dj->di", lower, means.readings - means.design @ old).ravel()
    root = _root(covariance)  # x - x1 = root y with y of unit variance
    mixed = np.hstack([rows[:, kept] @ root, rows[:, given_up]])
    stacked = np.vstack([mixed, np.eye(len(kept), mixed.shape[1])])
    target = np.append(right, np.zeros(len(kept)))
    scale = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    solution = np.linalg.lstsq(stacked / scale, target, rcond=None)[0] / scale
    left, state = target - stacked @ solution, old.copy()
    state[kept] += root @ solution[: len(kept)]
    state[given_up] += solution[len(kept) :]
    return float(left @ left), state


def _square(saved: SavedCalibration) -> Floats:
    """Return the covariance (p, p) of how square the axes are where they were taken for square."""
    covariance, places = np.zeros((len(saved.state.values),) * 2), [SQUARE[angle] for angle in saved.square]
    covariance[places, places] = saved.bench.square_rad**2
    return covariance


def _root(covariance: Floats) -> Floats:
    """Return L with L L^T = covariance, of which parts may be known exactly; scaled, as units differ."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def _moves(saved: SavedCalibration, new: Calibration, free: Sequence[str]) -> tuple[MovedParameter, ...]:
    """Return the differences of all that both runs determine, the clearest first.

    A scale factor by axes that were taken for square is K cos(angle off square), wrong by about K angle^2 / 2.
    """
    off_square = saved.bench.square_rad**2 if {*saved.square} - {*new.model.square} else 0.0
    skipped = {symbol for each in new.model.effects if str(each) in free for symbol in _symbols(each)}
    before = {each.symbol: each for each in saved.parameters}
    differences = list[tuple[str, str, float, float, float]]()
    for symbol, now in new.parameters.items():
        was = before.get(symbol)
        if was is None or symbol in skipped or None in (was.value, was.sigma, now.value, now.sigma):
            continue
        assert was.value is not None and was.sigma is not None and now.value is not None and now.sigma is not None
        bent = now.value * off_square if symbol in ("K2", "K3") else 0.0  # the axis of accelerometer 1 is that of x
        differences.append((symbol, now.unit, was.value, now.value, math.hypot(was.sigma, now.sigma, bent)))
    moves = [
        MovedParameter(symbol, unit, old, value, value - old, sigma,
             sidak(math.erfc(abs(value - old) / max(sigma, 1e-300) / math.sqrt(2.0)), len(differences)))
        for symbol, unit, old, value, sigma in differences
    ]  # fmt: skip
    return tuple(sorted(moves, key=lambda move: move.p_value))


def _symbols(effect: Effect) -> set[str]:
    """Return the symbols of all parameters of an effect: coefficients, constant, intensity of a walk."""
    constant = set[str]() if effect.unknown is None else {effect.unknown.symbol}
    return constant | {each.symbol for each in (*effect.states, *effect.parameters)}


def _worst(saved: SavedCalibration, model: Model, new: Calibration) -> tuple[float, float] | tuple[None, None]:
    """Return the largest error of old corrections over the directions of gravity, and its sigma, m/s^2; None where the
    new run does not determine all that is corrected."""
    old = Correction(new.bench, model, np.array(saved.state.values), np.array(saved.state.covariance), np.zeros(3))
    try:
        now = new.correction
    except UnobservableError:
        return None, None
    force, temperature = new.bench.gravity_mps2 * _sphere(_DIRECTIONS), REFERENCE_TEMPERATURE_C
    errors = old.of_readings(now.predicted(force, temperature), temperature) - force
    worst = int(np.argmax(np.linalg.norm(errors, axis=1)))
    size = float(np.linalg.norm(errors[worst]))
    along = errors[worst] / max(size, 1e-300)
    both = sum(each.covariance_of(force[worst], temperature)[0] for each in (old, now))
    return size, float(np.sqrt(along @ both @ along))


def _sphere(count: int) -> Floats:
    """Return directions (n, 3) spread evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(turn), height, across * np.sin(turn)])


def _warnings(saved: SavedCalibration, source: Source, new: Calibration) -> list[str]:
    """Return what may make the two runs differ besides the sensors."""
    warnings, conditions = list[str](), saved.conditions
    path = getattr(source, "path", None)
    if path is not None and saved.provenance.sha256 == fingerprint(path):
        warnings.append("this is the recording that it was calibrated from, so it must agree: verify with another.")
    warmth = new.fit.dwells.folded.pieces.nodes.temperature_c
    if (
        conditions.temperature_min_c is not None
        and conditions.temperature_max_c is not None
        and np.isfinite(warmth).any()
    ):
        low, high = float(np.nanmin(warmth)), float(np.nanmax(warmth))
        if low < conditions.temperature_min_c - 1.0 or high > conditions.temperature_max_c + 1.0:
            warnings.append(
                f"it was {low:.1f} to {high:.1f} °C, and {conditions.temperature_min_c:.1f} to "
                f"{conditions.temperature_max_c:.1f} °C when it was calibrated: a difference may be the temperature's."
            )
    ratio = new.bench.gravity_mps2 / saved.bench.gravity_mps2 - 1.0
    if abs(ratio) > 1e-9:
        warnings.append(
            f"gravity is stated {ratio * 1e6:+.3g} ppm different: all scale factors differ by as much if it is not."
        )
    was, now = (bench.notes.get("block_serial") for bench in (saved.bench, new.bench))
    if was and now and was != now:
        warnings.append(f"the block is {now}, the calibration is of {was}.")
    return warnings


def refuse_other_frame(saved: SavedCalibration, bench: Bench) -> None:
    """Raise InputError if one of calibration and new run is made with angles and the other without."""
    if saved.fixed and bench.angles:
        raise InputError(
            "the calibration was made without angles, in the frame of its sensors: verify it without them, too "
            "(--no-angles)."
        )
    if not (saved.fixed or bench.angles):
        raise InputError(
            "the calibration was made with angles, in the frame of the platform: verify it with them, too (leave out "
            "--no-angles)."
        )


def refuse_incomplete(saved: SavedCalibration) -> None:
    """Raise UnobservableError if the old run did not determine all that it is to be compared by."""
    if saved.state.undetermined:
        raise UnobservableError(
            f"the calibration did not determine {', '.join(saved.state.undetermined)}, so it predicts no readings: "
            "verify one that did."
        )
