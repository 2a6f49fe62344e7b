"""Score tests of candidate effects against a fitted model, and the rows from which they are made.

Let H be the whitened columns of the model, G those of a candidate effect and z the whitened readings. G and z are
projected onto the orthogonal complement of H. The projections answer every question about the candidate: its score
statistic, its coefficients and their sigmas, its overlap with any other candidate, and the smallest size that would be
detected.

The rows of all candidates are made and reduced by QR for a few dwells at a time, so that a long run takes no more
memory than a short one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats, Indices
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect
from kf_calib.estimation import whitened_rows
from kf_calib.estimation.candidate_scan import SEEN, Complement, Scan, counts_of, project, slices
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns, few_at_a_time, stimulus_of
from kf_calib.estimation.periodogram import Periodogram
from kf_calib.estimation.square_root_information import accumulate
from kf_calib.noise import random_walk
from kf_calib.noise.noise_model import Noise, steps

_OF_ONE_KIND = 400  # columns whitened at a time if there are many effects of one kind
_MANY = 100  # above this number of oscillations, a periodogram is faster


def scan(linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect]) -> Scan:
    """Project ``effects`` off the model in ``linearised``."""
    if noise.walk.steps:
        rows, width = whiten_model(linearised, noise, effects)
        return project(accumulate([rows]), width, effects, counts_of(effects))
    (upper, _), width = triangles(linearised, noise, effects, [np.arange(len(linearised.dwells))])
    return project(upper, width, effects, counts_of(effects))


def triangles(
    linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect], groups: Sequence[Indices]
) -> tuple[list[Floats], int]:
    """Triangular factors [H | W | G | z] of all rows and of those of each of some groups of dwells, which together are
    all, and the number of columns before G; for a noise in which the biases do not walk.

    W are columns for noise that dwells have in common (``whitened_rows.misfit_rows``), of which something is known
    beforehand: these rows belong to each group.
    """
    dwells, state, known = linearised.dwells_at_state, linearised.state, linearised.model.count
    judging = noise.with_scatter_as_flicker(len(dwells))
    shared, values = judging.columns("run", dwells, state), of_all_pieces(linearised.columns)
    width, made = known + shared.shape[3], sum(counts_of(effects))
    stimulus = stimulus_of(dwells, linearised.model.bench, state)
    uppers = [np.zeros((0, width + made + 1)) for _ in groups]
    for few, some, pieces, nodes in few_at_a_time(dwells, stimulus, width + made):
        added = candidate_columns(some, effects, linearised.model.bench, state, nodes)
        columns = np.concatenate([values[pieces], shared[pieces], added.values], axis=3)
        rows = whitened_rows.whiten(some, OfPieces(columns, some.folded.ends), judging, state, reduced=False)
        for k, group in enumerate(groups):
            own = group[(group >= few.start) & (group < few.stop)] - few.start
            uppers[k] = accumulate([uppers[k], *(rows[n] for n in own.tolist())]) if len(own) else uppers[k]
    prior = np.eye(width - known, width + made + 1, known)
    of_groups = [accumulate([prior, upper]) if len(prior) else upper for upper in uppers]
    return [accumulate([prior, *uppers]) if len(groups) > 1 else of_groups[0], *of_groups], width


def delta_chi2(linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect]) -> Floats:
    """Decrease of chi-squared (n,) if each of many effects of one kind, alone, is added: the ``statistics`` of a scan.

    Because nothing else is needed, the rows are not reduced by QR. For n columns in d rows the cost is then
    proportional to d times n instead of d times n^2.
    """
    if effects[0].oscillates and len(effects) > _MANY:
        return periodogram(linearised, noise, effects[0], np.array([effect.value for effect in effects]))
    deltas = list[Floats]()
    for part in batches(counts_of(effects), _OF_ONE_KIND):
        rows, width = whiten_model(linearised, noise, [effects[k] for k in part])
        sizes, rest = np.linalg.norm(rows[:, width:-1], axis=0), Complement(rows, width).of(rows[:, width:])
        columns = rest[:, :-1] / np.where(sizes > 0, sizes, 1.0)
        columns = columns.T.reshape(len(part), -1, len(rest))
        along, gram = columns @ rest[:, -1], columns @ columns.swapaxes(1, 2)
        inverse = np.linalg.pinv(gram, rcond=SEEN, hermitian=True)
        deltas.append(np.einsum("ni,nij,nj->n", along, inverse, along))
    return np.concatenate(deltas)


def periodogram(linearised: LinearisedDwells, noise: Noise, effect: Effect, values_hz: Floats) -> Floats:
    """Decrease of chi-squared (n,) if an oscillation at each frequency, alone, is added to the model."""
    return Periodogram(linearised, noise, effect, values_hz).delta_chi2(*_with_and_without_walk(linearised, noise))


def joint_delta_chi2(
    linearised: LinearisedDwells, noise: Noise, groups: Sequence[Sequence[Effect]]
) -> list[tuple[float, int]]:
    """Decrease of chi-squared if all effects of a group are added together, and their rank, of each group alone.

    As in ``delta_chi2``, rows are not reduced by QR, which would take most of the time in runs of many dwells.
    """
    effects = [effect for group in groups for effect in group]
    rows, width = whiten_model(linearised, noise, effects)
    sizes, rest = np.linalg.norm(rows[:, width:-1], axis=0), Complement(rows, width).of(rows[:, width:])
    columns = rest[:, :-1] / np.where(sizes > 0, sizes, 1.0)
    joint = list[tuple[float, int]]()
    for part in slices([sum(counts_of(group)) for group in groups]):
        left, singular, _ = np.linalg.svd(columns[:, part], full_matrices=False)
        spanned = left[:, singular > SEEN]
        joint.append((float(np.sum((spanned.T @ rest[:, -1]) ** 2)), spanned.shape[1]))
    return joint


def whiten_model(
    linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect], state: Floats | None = None
) -> tuple[Floats, int]:
    """Whitened rows [H | W | G | z] (m, c) of the model in ``linearised`` and of ``effects``, and the number of columns
    before G.

    - W: columns of the slow part of a stated scatter, see ``whitened_rows.misfit_rows``.
    - state: where small rotations and input axes are linearised; by default at the state in ``linearised``.
    """
    at, dwells = linearised.state if state is None else state, linearised.dwells_at_state
    added = candidate_columns(dwells, effects, linearised.model.bench, at)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(linearised.columns, added, strict=True)]
    rows, width = _judged(dwells, columns, noise, at, linearised.model.count)
    return _stacked(rows, dwells, noise), width


def batches(sizes: Sequence[int], columns: int) -> list[list[int]]:
    """Split effects with the given numbers of columns into consecutive groups of about ``columns`` columns; return the
    effects' indices."""
    ends = (np.cumsum(sizes) // columns).tolist()
    return [[k for k, end in enumerate(ends) if end == each] for each in dict.fromkeys(ends)]


def _judged(
    dwells: DwellTable, columns: Sequence[Floats], noise: Noise, state: Floats, width: int
) -> tuple[Sequence[Floats], int]:
    """Call ``whitened_rows.misfit_rows`` without reducing the rows to the rank of their columns."""
    return whitened_rows.misfit_rows(dwells, columns, noise, state, width, reduced=False)


def _stacked(rows: Sequence[Floats], dwells: DwellTable, noise: Noise) -> Floats:
    """Concatenate all rows; if the biases walk, whiten them with respect to the walk."""
    return random_walk.whiten_walk(rows, steps(dwells, noise)) if noise.walk.steps else np.concatenate(rows)


def _with_and_without_walk(linearised: LinearisedDwells, noise: Noise) -> tuple[Floats, Floats]:
    """Rows of the model in ``linearised`` as ``Periodogram.delta_chi2`` needs them: whitened, the walk of the biases
    taken out; and those of the dwells alone, with the walk still in them."""
    rows, _ = _judged(linearised.dwells_at_state, linearised.columns, noise, linearised.state, linearised.model.count)
    of_dwells = np.concatenate(rows[len(rows) - len(linearised.dwells) :])
    return _stacked(rows, linearised.dwells, noise), of_dwells[:, noise.walk.steps :]
