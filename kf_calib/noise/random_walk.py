"""A random walk of the biases as process noise of the filter (Bierman, 1977) and in the means of dwells.

The filter's bias is the one at the end of a dwell. The rows of a dwell therefore begin with columns for the step that
the biases take within it (``dwells.pieces``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import BIASES
from kf_calib.dwells.qr import triangle


@dataclass(frozen=True)
class Links:
    """The covariance of the means of a path over D dwells, per q^2.

    If ``share`` (D - 1,) times the mean before is subtracted from each mean, the differences have the variances
    ``alone`` (D,) and the covariances ``beside`` (D - 1,) with the next one; all other covariances are zero.
    """

    share: Floats
    alone: Floats
    beside: Floats


def mean_links(ends_s: Floats) -> Links:
    """The links of a random walk for dwells that begin and end at ``ends_s`` (D, 2).

    Over a dwell of length T, the difference of its mean from its first value has the variance T / 3, so has that from
    its last value, and the two have the covariance T / 6.
    """
    spans, pauses = ends_s[:, 1] - ends_s[:, 0], np.append(0.0, np.maximum(ends_s[1:, 0] - ends_s[:-1, 1], 0.0))
    alone = pauses + spans / 3.0
    alone[1:] += spans[:-1] / 3.0
    return Links(np.ones(len(spans) - 1), alone, spans[:-1] / 6.0)


def known_at_end(ends_s: Floats) -> Floats:
    """Covariance (D, D) per q^2 of the means of a walk that is known at its end, over dwells that begin and end at
    ``ends_s`` (D, 2): min(T - s, T - t) between their middles s and t."""
    before_end_s = ends_s[-1, 1] - ends_s.mean(axis=1)
    return np.asarray(np.minimum.outer(before_end_s, before_end_s), float)


def variances(begins_s: Floats, ends_s: Floats, intensities: Floats) -> Floats:
    """Variances (D, 2, 3) of the steps of the biases in the pause before each dwell and over the dwell."""
    pauses = np.maximum(np.append(0.0, begins_s[1:] - ends_s[:-1]), 0.0)
    return np.column_stack([pauses, ends_s - begins_s])[:, :, None] * intensities**2


def to_mean(steps: Floats) -> Floats:
    """Variances (D, 3) of the change from the biases at the end of a dwell to their means over the next dwell."""
    return steps[:, 0] + steps[:, 1] / 3.0


def advance(factor: Floats, steps: Floats, rows: Floats) -> tuple[Floats, int]:
    """Time and measurement update: the triangular factor of [w | H | z], and the number of leading rows and columns of
    steps w.

    The caller drops these rows and columns. This is the square-root information form (Bierman, 1977, ch. V), which is
    valid for a singular factor, too.

    - factor (p, p + 1): [R | z] with the biases at the end of the dwell before.
    - steps (2, 3): variances of the steps of the biases in the pause and within the dwell.
    - rows (m, 3 + p + 1): [S | H | z], where S are the columns of the steps within the dwell; S is absent without a
      walk.
    """
    width = len(factor)
    inside = rows.shape[1] - width - 1
    sigma = _sigmas(steps, inside)
    count = len(sigma)
    if not count:
        return triangle(np.vstack([factor, rows])), 0
    biases = BIASES
    joint = np.zeros((count + width + len(rows), count + width + 1))
    joint[:count, :count] = np.diag(1.0 / sigma)
    before = joint[count : count + width]
    before[:, count:] = factor
    for first in range(0, count, 3):
        before[:, first : first + 3] = -factor[:, biases]
    joint[count + width :, :inside] = rows[:, :inside]
    joint[count + width :, count:] = rows[:, inside:]
    return triangle(joint), count


def recede(factor: Floats, steps: Floats, rows: Floats) -> Floats:
    """The factor with the biases before a dwell and its pause, from the factor with the biases at its end and its rows.

    The factor contains what came later; this is ``advance`` backward in time.
    """
    width, biases = len(factor), BIASES
    sigma = _sigmas(steps, rows.shape[1] - width - 1)
    joint = np.zeros((len(sigma) + width + len(rows), len(sigma) + width + 1))
    joint[: len(sigma), : len(sigma)] = np.diag(1.0 / sigma)
    later = joint[len(sigma) :]
    later[:, len(sigma) :] = np.vstack([factor, rows[:, -width - 1 :]])
    for first in range(0, len(sigma), 3):
        later[:, first : first + 3] = later[:, len(sigma) :][:, biases]
    later[width:, : rows.shape[1] - width - 1] += rows[:, : -width - 1]
    return triangle(joint)[len(sigma) : len(sigma) + width, len(sigma) :]


def _sigmas(steps: Floats, inside: int) -> Floats:
    """Return the sigmas of the steps w in their order: three within the dwell if its rows have columns for them, three
    in the pause."""
    return np.sqrt(np.concatenate([steps[1] if inside else steps[:0, 0], steps[0] if steps[0].any() else steps[:0, 0]]))


def whiten_walk(rows: Sequence[Floats], steps: Floats) -> Floats:
    """Rows (m, c) of unit noise from the rows [S | X] of each dwell, with the walk of the biases as part of the noise.

    X (r, c) are any columns of which the first twelve belong to the parameters, with the biases at the end of the
    dwell. The result is computed by a square-root information filter whose only state is the path w of the biases from
    the beginning of the run to the end of a dwell. It is estimated from each dwell by QR with all columns of X as
    right-hand sides; what remains of a dwell's rows is their innovation, which has unit noise and is independent of all
    others. Rows that precede those of the dwells have no S and are returned unchanged.
    """
    above, dwells = rows[: len(rows) - len(steps)], rows[len(rows) - len(steps) :]
    upper, right, innovations = np.zeros((0, 3)), np.zeros((0, dwells[0].shape[1] - 3)), list(above)
    for of_dwell, (pause, inside) in zip(dwells, steps, strict=True):
        unknown = ([pause] if pause.any() and len(upper) else []) + ([inside] if len(upper) else [])
        first, count = 3 * len(unknown), 3 * len(unknown) + len(upper)
        biases = of_dwell[:, 3:][:, BIASES]
        design = np.zeros((count + len(of_dwell) + (0 if len(upper) else 3), first + 3))
        design[:first, :first] = np.diag(1.0 / np.sqrt(np.ravel(unknown)))
        if len(upper):  # the path before is w less the steps in the pause and in the dwell
            design[first:count] = np.hstack([-upper] * len(unknown) + [upper])
            design[count:] = np.hstack([np.zeros((len(of_dwell), first - 3)), of_dwell[:, :3], biases])
        else:  # in the first dwell the path is the step within it
            design[:3], design[3:] = np.diag(1.0 / np.sqrt(inside)), of_dwell[:, :3] + biases
        sides = np.zeros((len(design), right.shape[1]))
        sides[first:count], sides[len(design) - len(of_dwell) :] = right, of_dwell[:, 3:]
        turned, triangular = np.linalg.qr(design, mode="complete")
        sides = turned.T @ sides
        upper, right = triangular[first : first + 3, first:], sides[first : first + 3]
        innovations.append(sides[first + 3 :])
    return np.concatenate(innovations)


def predict(factor: Floats, variances: Floats) -> Floats:
    """Time update alone: the factor after steps of the biases of these variances (3,); unchanged if they are 0."""
    if not variances.any():
        return factor
    upper, count = advance(factor, np.array([variances, np.zeros(3)]), np.zeros((0, factor.shape[1])))
    return upper[count : count + len(factor), count:]
