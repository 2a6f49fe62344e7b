"""What a user's effect must keep to, tried on a made stimulus before it is let into a model."""

from __future__ import annotations

import dataclasses
import functools
import sys
import traceback
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of, turned
from kf_calib.effects.effect import Effect
from kf_calib.effects.frame import RotationEffect
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C, Stimulus
from kf_calib.errors import InputError

EXAMPLE = Bench(axes_of("yzx"), 9.81, latitude_deg=50.0)
"""The bench of the trial where no other is at hand."""

_DWELLS, _NODES = 60, 5
_LARGEST_TURN_RAD = 1e-3  # of the finite rotation: central differences leave its square / 6
_DERIVATIVE_LIMIT = 1e-6
_RATE_RADPS = 0.3  # the trial turns, too, or effects of slews would add nothing


def trial(bench: Bench) -> Stimulus:
    """300 instants in 60 dwells of this bench: faces, poses a little off them and poses anywhere; about 1 K, 8 hours.

    Made anew at every call, so that a class that writes into it spoils no other's trial.
    """
    gravity = bench.gravity_mps2
    force, pose, noise = _trial_poses(bench.axes, gravity)
    since_s = np.tile(np.geomspace(1.0, 25.0, _NODES), _DWELLS)
    starts_s = np.append(30.0 * np.arange(40), np.geomspace(1200.0, 3e4, _DWELLS - 40))  # long runs are tried, too
    elapsed_s = since_s + np.repeat(starts_s, _NODES)
    before = np.vstack([force[:1], force[:-1]])
    return Stimulus(
        bench=bench,
        elapsed_s=elapsed_s,
        since_arrival_s=since_s,
        force_mps2=np.repeat(force, _NODES, axis=0),
        previous_force_mps2=np.repeat(before, _NODES, axis=0),
        pose=np.repeat(pose, _NODES, axis=0),
        previous_pose=np.repeat(np.vstack([pose[:1], pose[:-1]]), _NODES, axis=0),
        temperature_c=REFERENCE_TEMPERATURE_C + 0.3 + np.sin(elapsed_s / 300.0),
        sensitivity=np.eye(3),
        variance_mps2_2=noise.copy(),
        rate_radps=_RATE_RADPS * np.sin(elapsed_s[:, None] * np.array([1.0, 1.3, 1.7])),
        rate_change_radps2=_RATE_RADPS * np.cos(elapsed_s[:, None] * np.array([1.9, 0.7, 1.1])),
    )


@lru_cache(maxsize=8)
def _trial_poses(axes: tuple[Any, ...], gravity_mps2: float) -> tuple[Floats, Floats, Floats]:
    rng, bench = np.random.default_rng(7), Bench(axes, gravity_mps2)
    pose = rng.uniform(-np.pi, np.pi, (_DWELLS, bench.pose_width))
    if axes:
        faces = np.round(pose[:24] / (np.pi / 2)) * (np.pi / 2)
        pose[:24] = faces + np.where(np.arange(24) < 8, 0.0, np.geomspace(1e-7, 0.1, 24))[:, None]
    else:
        pose /= np.linalg.norm(pose, axis=1, keepdims=True)
    force = bench.specific_force(np.zeros(_DWELLS), pose)
    return force, pose, 1e-6 * rng.chisquare(3.0, (_DWELLS * _NODES, 3))


def check_effect(effect: Effect, s: Stimulus | None = None) -> tuple[str, ...]:
    """Try an effect's columns; returns what is worth knowing of it.

    Raises InputError, in one sentence with effect, check and values, where the columns have another shape than
    (m, 3, q), are not finite, or all zero; where they change the stimulus; and where a derivative is claimed (of a
    turned specific force by a RotationEffect, for its unknown by any) that differences do not give.
    """
    s = trial(EXAMPLE) if s is None else s
    coefficients = _call(effect, "coefficients", lambda: tuple(effect.coefficients))
    symbols = [coefficient.symbol for coefficient in coefficients]
    if len(set(symbols)) < len(symbols):
        raise InputError(f"{effect} gives two coefficients the same symbol ({' '.join(symbols)}): tell them apart.")
    count, before = len(coefficients), _arrays(s)
    before = {name: values.copy() for name, values in before.items()}
    if isinstance(effect, RotationEffect):
        _rotations(effect, s, count)
    columns = np.asarray(_call(effect, "columns", effect.columns, s))
    _refuse_shape(effect, columns, (len(s), 3, count))
    refuse_not_finite(effect, columns.reshape(len(s), -1), s)
    for name, values in _arrays(s).items():
        if not np.array_equal(values, before[name], equal_nan=True):
            raise InputError(f"{effect} writes into {name} of the stimulus: work on a copy, other effects read it too.")
    if count and not columns.any():
        raise InputError(f"{effect} adds nothing to any reading in {len(s)} spread instants: check its terms.")
    if isinstance(effect, RotationEffect):
        _refuse_wrong_derivative(effect, columns, s)
    if effect.unknown is not None and type(effect).derivative is not Effect.derivative:
        _refuse_wrong_slope(effect, s, count)
    return _remarks(effect, columns, s)


def guard(kind: type[Effect]) -> None:
    """Let the columns of a user's class fail with a sentence on measured data too, where no trial foresaw it."""
    unguarded = kind.columns
    if getattr(unguarded, "guarded", False):
        return

    @functools.wraps(unguarded)
    def columns(self: Effect, s: Stimulus) -> Floats:
        values = np.asarray(_call(self, "columns", unguarded, self, s))
        _refuse_shape(self, values, (len(s), 3, len(self.coefficients)))
        refuse_not_finite(self, values.reshape(len(s), -1), s)
        return values

    vars(columns)["guarded"] = True
    kind.columns = columns


def refuse_not_finite(effect: Effect, values: Floats, s: Stimulus) -> None:
    """Raise InputError, with what the row holds, where ``values`` (m, ...) of an effect are not finite."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if not bad.size:
        return
    row = int(bad[0])
    a = ", ".join(f"{value:.3g}" for value in s.along[row])
    raise InputError(
        f"{effect} is not finite at {s.elapsed_s[row]:.4g} s, where a = {a} m/s^2, T = {s.warmth[row]:.3g} K, "
        f"tau = {s.since_arrival_s[row]:.3g} s: keep it from dividing by zero, and from roots and logarithms of "
        "negative values."
    )


def _arrays(s: Stimulus) -> dict[str, Floats]:
    """Every array of a stimulus that an effect could write into, those it computes when asked included."""
    names = [field.name for field in dataclasses.fields(s)]
    names += [name for name, value in vars(type(s)).items() if isinstance(value, cached_property)]
    return {name: value for name in names if isinstance(value := getattr(s, name), np.ndarray)}


def _call(effect: Effect, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
    try:
        with np.errstate(all="ignore"):
            return call(*arguments)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{effect}: its {what} failed{line_of(error, type(effect))} ({error_words(error)}).") from None


def error_words(error: BaseException) -> str:
    """An error of someone else's code in a line."""
    said = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())[:200]
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def line_of(error: BaseException, kind: type) -> str:
    """Where in the file of a class an error arose, as `` at FILE, line N``; empty where it is not known."""
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return f" at {file}{line_in(error, file)}" if line_in(error, file) else ""


def line_in(error: BaseException, file: str | None) -> str:
    """The last line of a file that an error passed through, as ``, line N``; empty where it is not known."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return f", line {error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f", line {lines[-1]}" if lines else ""


def _refuse_shape(effect: Effect, columns: Floats, shape: tuple[int, int, int]) -> None:
    if columns.shape != shape:
        raise InputError(
            f"{effect}: its columns have the shape {columns.shape}, not (instants, 3, coefficients) {shape}."
        )
    if columns.dtype.kind not in "fiub":
        raise InputError(f"{effect}: its columns are of the type {columns.dtype}, not real numbers.")


def _rotations(effect: RotationEffect, s: Stimulus, count: int) -> Floats:
    rotations = np.asarray(_call(effect, "rotations", effect.rotations, s))
    shape = (len(s), count, 3)
    if rotations.shape != shape:
        raise InputError(
            f"{effect}: its rotations have the shape {rotations.shape}, not (instants, coefficients, 3) {shape}."
        )
    return rotations


def _refuse_wrong_derivative(effect: RotationEffect, columns: Floats, s: Stimulus) -> None:
    """Columns against (s_i . f turned by alpha - s_i . f turned by -alpha) / 2, alpha a small finite rotation."""
    rotations = _rotations(effect, s, columns.shape[2])
    for k, rotation in enumerate(np.moveaxis(rotations, 1, 0)):
        largest = max(float(np.linalg.norm(rotation, axis=1).max()), 1e-300)
        step = _LARGEST_TURN_RAD / largest
        change = (turned(s.force_mps2, step * rotation) - turned(s.force_mps2, -step * rotation)) / (2.0 * step)
        expected = change @ s.sensitivity.T
        off = np.abs(columns[:, :, k] - expected)
        if off.max() > _DERIVATIVE_LIMIT * largest * s.bench.gravity_mps2:
            row, i = (int(index) for index in np.unravel_index(off.argmax(), off.shape))
            raise InputError(
                f"{effect}: column {k + 1} is {columns[row, i, k]:.4g} m/s^2 for accelerometer {i + 1} at "
                f"{s.elapsed_s[row]:.4g} s, and a small finite rotation by its rotations gives {expected[row, i]:.4g}: "
                "leave columns to RotationEffect."
            )


def _refuse_wrong_slope(effect: Effect, s: Stimulus, count: int) -> None:
    """A class's own derivative for its unknown, against central differences of its columns."""
    given = np.asarray(_call(effect, "derivative", effect.derivative, s, np.ones(count)))
    expected = _call(effect, "columns", Effect.derivative, effect, s, np.ones(count))
    if given.shape != expected.shape:
        raise InputError(f"{effect}: its derivative has the shape {given.shape}, not {expected.shape}.")
    off, limit = np.abs(given - expected), 10.0 * _DERIVATIVE_LIMIT * np.abs(expected).max()
    if not off.max() <= limit:
        row = int(np.nanargmax(off.max(axis=(1, 2))))
        raise InputError(
            f"{effect}: its derivative is {given[row, :, 0]} at {s.elapsed_s[row]:.4g} s, and differences of its "
            f"columns give {expected[row, :, 0]}: it must be that by the logarithm of its unknown."
        )


def _remarks(effect: Effect, columns: Floats, s: Stimulus) -> tuple[str, ...]:
    keep = slice(1, None, 3)
    fewer = np.asarray(_call(effect, "columns", effect.columns, s.at(keep)))
    if fewer.shape == columns[keep].shape and np.allclose(
        fewer, columns[keep], rtol=1e-9, atol=1e-12 * np.abs(columns).max(initial=0.0)
    ):
        return ()
    return (f"{effect} gives an instant another value when others are left out: it must not need the whole run.",)
