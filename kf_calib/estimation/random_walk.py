"""A random walk of the biases as process noise of the filter (Bierman, 1977), and of the means of dwells.

The filter's bias is the one at the END of a dwell: its rows lead with the columns of the step that the biases take in
it (``dwells.walk_path``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import triangle


@dataclass(frozen=True)
class Links:
    """Of the means of a path over D dwells, per q^2: each less ``share`` (D - 1,) of the one before has the variance
    ``alone`` (D,), and with the next of these the covariance ``beside`` (D - 1,), with others none."""

    share: Floats
    alone: Floats
    beside: Floats


def mean_links(ends_s: Floats, held_s: float = math.inf) -> Links:
    """Of dwells from ``ends_s`` (D, 2), of a walk that comes back with the time constant ``held_s``."""
    return _free(ends_s) if math.isinf(held_s) else _held(ends_s, held_s)


def _free(ends_s: Floats) -> Links:
    """Of a walk: its mean over a dwell of T is T / 3 from its beginning and its end, the two T / 6 alike."""
    spans, pauses = ends_s[:, 1] - ends_s[:, 0], np.append(0.0, np.maximum(ends_s[1:, 0] - ends_s[:-1, 1], 0.0))
    alone = pauses + spans / 3.0
    alone[1:] += spans[:-1] / 3.0
    return Links(np.ones(len(spans) - 1), alone, spans[:-1] / 6.0)


def _held(ends_s: Floats, held_s: float) -> Links:
    """Of a walk that comes back with a time constant tau: covariance tau / 2 exp(-|t - s| / tau).

    Its mean over a dwell of T has covariance a = tau / T (1 - exp(-T / tau)) with either end, over tau / 2.
    """
    spans = np.maximum(ends_s[:, 1] - ends_s[:, 0], 1e-6 * held_s) / held_s
    near = -np.expm1(-spans) / spans
    own = held_s * (1.0 - near) / spans
    share = near[1:] / near[:-1] * np.exp(-np.diff(ends_s[:, 0]) / held_s)
    pauses = np.maximum(ends_s[1:, 0] - ends_s[:-1, 1], 0.0) / held_s
    across = 0.5 * held_s * near[1:] * near[:-1] * np.exp(-pauses)
    alone = own.copy()
    alone[1:] += share**2 * own[:-1] - 2.0 * share * across
    return Links(share, alone, across - share * own[:-1])


def variances(begins_s: Floats, ends_s: Floats, intensity: float) -> Floats:
    """Variances (D, 2) of a bias's steps in the pause before each dwell and over the dwell."""
    pauses = np.maximum(np.append(0.0, begins_s[1:] - ends_s[:-1]), 0.0)
    return intensity**2 * np.column_stack([pauses, ends_s - begins_s])


def to_mean(steps: Floats) -> Floats:
    """Variance (D,) of the way from the bias at the end of a dwell to its mean over the next."""
    return steps[:, 0] + steps[:, 1] / 3.0


def advance(factor: Floats, steps: Floats, rows: Floats) -> tuple[Floats, int]:
    """Time and measurement update: the triangle [w | H | z], and how many steps w lead it, to be left out.

    factor [R | z] (p, p + 1) of the biases at the end of the dwell before; ``steps`` (2,): variances of each bias's
    step in the pause and in the dwell; rows [S | H | z] (m, 3 + p + 1), S the columns of the steps in the dwell;
    without S where there is none. SRIF form (Bierman, 1977, ch. V), valid for a singular factor.
    """
    width = len(factor)
    inside = rows.shape[1] - width - 1
    sigma = _sigmas(steps, inside)
    count = len(sigma)
    if not count:
        return triangle(np.vstack([factor, rows])), 0
    biases = [3, 7, 11]
    out = np.zeros((count + width + len(rows), count + width + 1))
    out[:count, :count] = np.diag(1.0 / sigma)
    before = out[count : count + width]
    before[:, count:] = factor
    for first in range(0, count, 3):
        before[:, first : first + 3] = -factor[:, biases]
    out[count + width :, :inside] = rows[:, :inside]
    out[count + width :, count:] = rows[:, inside:]
    return triangle(out), count


def recede(factor: Floats, steps: Floats, rows: Floats) -> Floats:
    """The factor of the biases before a dwell and its pause, from that of the biases at its end (from what came later)
    and its rows: ``advance`` backward in time."""
    width, biases = len(factor), [3, 7, 11]
    sigma = _sigmas(steps, rows.shape[1] - width - 1)
    out = np.zeros((len(sigma) + width + len(rows), len(sigma) + width + 1))
    out[: len(sigma), : len(sigma)] = np.diag(1.0 / sigma)
    later = out[len(sigma) :]
    later[:, len(sigma) :] = np.vstack([factor, rows[:, -width - 1 :]])
    for first in range(0, len(sigma), 3):
        later[:, first : first + 3] = later[:, len(sigma) :][:, biases]
    later[width:, : rows.shape[1] - width - 1] += rows[:, : -width - 1]
    return triangle(out)[len(sigma) : len(sigma) + width, len(sigma) :]


def _sigmas(steps: Floats, inside: int) -> Floats:
    """Of the steps w in their order: three in the dwell where its rows have columns of them, three in the pause."""
    variances = ([steps[1]] if inside else []) + ([steps[0]] if steps[0] > 0 else [])
    return np.sqrt(np.repeat(variances, 3))


def whiten_walk(rows: Sequence[Floats], steps: Floats) -> Floats:
    """Rows (m, c) of unit noise from rows [S | X] of each dwell, the walk being in their noise; X (r, c): any columns,
    of which the first twelve are the parameters', the biases those at the end of the dwell.

    A square-root information filter of the walk alone: its state, the way w from the bias at the beginning of the run
    to that at the end of a dwell, is found from each dwell by QR, and all of X is its right-hand side. What is left of
    a dwell's rows is their innovation, of unit noise and independent of all others. Rows before those of the dwells
    have no S and are kept as they are.
    """
    above, dwells = rows[: len(rows) - len(steps)], rows[len(rows) - len(steps) :]
    upper, right, out = np.zeros((0, 3)), np.zeros((0, dwells[0].shape[1] - 3)), list(above)
    for own, (pause, inside) in zip(dwells, steps, strict=True):
        unknown = ([pause] if pause > 0 and len(upper) else []) + ([inside] if len(upper) else [])
        first, count = 3 * len(unknown), 3 * len(unknown) + len(upper)
        biases = own[:, 3:][:, [3, 7, 11]]
        design = np.zeros((count + len(own) + (0 if len(upper) else 3), first + 3))
        design[:first, :first] = np.diag(np.repeat(1.0 / np.sqrt(unknown), 3))
        if len(upper):  # w before is w less the steps in the pause and in the dwell
            design[first:count] = np.hstack([-upper] * len(unknown) + [upper])
            design[count:] = np.hstack([np.zeros((len(own), first - 3)), own[:, :3], biases])
        else:  # the first dwell: the way is the step within it
            design[:3], design[3:] = np.eye(3) / np.sqrt(inside), own[:, :3] + biases
        sides = np.zeros((len(design), right.shape[1]))
        sides[first:count], sides[len(design) - len(own) :] = right, own[:, 3:]
        turned, triangular = np.linalg.qr(design, mode="complete")
        sides = turned.T @ sides
        upper, right = triangular[first : first + 3, first:], sides[first : first + 3]
        out.append(sides[first + 3 :])
    return np.concatenate(out)


def predict(factor: Floats, variance: float) -> Floats:
    """Time update alone: the three biases take a step of that variance, 0: none."""
    if variance <= 0:
        return factor
    upper, count = advance(factor, np.array([variance, 0.0]), np.zeros((0, factor.shape[1])))
    return upper[count : count + len(factor), count:]
