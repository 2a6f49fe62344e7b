"""Score tests of candidate effects against a fitted model, and what the tests share: the candidates' whitened columns.

Let H be the whitened columns of the model, G those of a candidate effect and z the whitened readings. G and z are
projected onto the orthogonal complement of H. The projections answer every question about the candidate: its score
statistic, its coefficients and their sigmas, its overlap with any other candidate, and the smallest size that would be
detected.

The columns of all candidates of the catalogue are evaluated and whitened once per run and noise model and are written
in an orthonormal basis of their own (``Frame``). To test them against another model, only that model's columns and the
readings have to be whitened; the projection is then done on a small matrix, and any two candidates can be compared.

Formulas are too many for that, and only two things are asked of a group of them: what it explains, and whether it is a
known effect by another name (``FurtherEffects``). The model's columns and those of the known effects are made
orthonormal once, and each group is reduced to a small triangle of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.line_spectrum import SpectralLine
from kf_calib.dwells.qr import orthonormal
from kf_calib.dwells.sufficient_statistics import lines_of
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect, Stimulus
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.candidate_scan import SEEN, Complement, Scan, counts_of, project, slices
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns, piece_columns, stimulus_of
from kf_calib.estimation.periodogram import Periodogram
from kf_calib.estimation.whitened_rows import MisfitColumns
from kf_calib.noise import random_walk
from kf_calib.noise.noise_model import Noise, steps
from kf_calib.noise.terms import SlowWaves

_TOGETHER = 24  # least number of columns that are whitened at a time; more would take more memory
_CELLS = 10_000  # columns times dwells that are whitened at a time, if this allows more columns
_OF_ONE_KIND = 400  # columns whitened at a time if there are many effects of one kind
_MANY = 100  # above this number of oscillations, a periodogram is faster


class Frame:
    """The whitened columns of ``effects`` over all dwells, in an orthonormal basis of their own.

      columns (m, q) = basis (m, r) @ coordinates (r, q)

    A frame can be used with every model of the same dwells that is judged by the same noise. Small rotations and input
    axes remain linearised at ``state``, the state with which the frame was made.
    """

    def __init__(self, linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect]) -> None:
        self.dwells, self.noise, self.state, self.effects = (
            linearised.dwells_at_state,
            noise,
            linearised.state,
            list(effects),
        )
        self.parts = slices(counts_of(effects))
        self._stimulus = stimulus_of(linearised.dwells_at_state, linearised.model.bench, linearised.state)
        self._whitening = (
            None if noise.walk.steps else MisfitColumns(linearised.dwells_at_state, noise, linearised.state)
        )
        self.basis, self.coordinates = orthonormal(self.whitened(linearised, effects))
        self._periodogram: tuple[tuple[tuple[str, float], bytes], Periodogram] | None = None
        self._lines: dict[float, tuple[SpectralLine, ...]] = {}
        self._last: tuple[LinearisedDwells, Floats, Floats, int] | None = None

    @property
    def ends(self) -> NDArray[np.intp] | None:
        """The first row of each dwell, after those of prior knowledge, and at last the number of rows; None where a
        walk of the biases makes the rows of all dwells one."""
        return None if self._whitening is None else self._whitening.ends

    def whitened(self, linearised: LinearisedDwells, effects: Sequence[Effect]) -> Floats:
        """Whitened columns (m, q) of any effects, computed for a few at a time, which saves memory."""
        sizes, whitened, first = counts_of(effects), np.zeros((0, 0)), 0
        for part in batches(sizes, columns_at_once(linearised)) or [[]]:
            block = self._whitened(linearised, [effects[k] for k in part])
            whitened = whitened if len(whitened) else np.empty((len(block), sum(sizes)))
            whitened[:, first : first + block.shape[1]], first = block, first + block.shape[1]
        return whitened

    def _whitened(self, linearised: LinearisedDwells, effects: Sequence[Effect]) -> Floats:
        if self._whitening is not None:
            return self._whitening.of(piece_columns(effects, self._stimulus))
        # a walk is whitened by the columns of the biases, which are among the twelve
        added = candidate_columns(
            linearised.dwells_at_state, effects, linearised.model.bench, self.state, self._stimulus
        )
        both = [
            np.concatenate([own[..., :STATE_COUNT], more], axis=3)
            for own, more in zip(linearised.columns, added, strict=True)
        ]
        rows, width = _judged(linearised.dwells_at_state, both, self.noise, self.state, STATE_COUNT)
        return _stacked(rows, linearised.dwells, self.noise)[:, width:-1]

    def lines(self, level: float) -> tuple[SpectralLine, ...]:
        """Oscillations found in the readings at the significance ``level`` (see ``sufficient_statistics.lines_of``);
        they do not depend on the model."""
        if level not in self._lines:
            self._lines[level] = lines_of(self.dwells, level)
        return self._lines[level]

    def serves(self, linearised: LinearisedDwells, noise: Noise) -> bool:
        """Tell whether the frame was made for exactly these dwells and this noise."""
        return linearised.dwells_at_state.is_same(self.dwells) and noise.same_sizes(self.noise, without=SlowWaves)

    def scan(self, linearised: LinearisedDwells, more: Sequence[Effect] = ()) -> Scan:
        """Project the frame's effects, without those that the model contains, and then the effects ``more`` off the
        model in ``linearised``."""
        chosen = [k for k, effect in enumerate(self.effects) if str(effect) not in linearised.model.parts]
        inside, outside, width = self._model(linearised)
        more_inside, more_outside = self._split(self.whitened(linearised, more))
        beside = square_root_information.accumulate([np.hstack([outside[:, :-1], more_outside, outside[:, -1:]])])
        coordinates = [self.coordinates[:, self.parts[k]] for k in chosen]
        count = sum(each.shape[1] for each in coordinates)
        small = np.vstack([
            np.hstack([inside[:, :-1], *coordinates, more_inside, inside[:, -1:]]),
            np.hstack([beside[:, :width], np.zeros((len(beside), count)), beside[:, width:]]),
        ])  # fmt: skip
        effects = [*(self.effects[k] for k in chosen), *more]
        return project(square_root_information.accumulate([small]), width, effects, counts_of(effects))

    def _model(self, linearised: LinearisedDwells) -> tuple[Floats, Floats, int]:
        """Return the columns [H | W | z] of a model, inside the frame and outside it, and the number of columns before
        z; the result is cached for the next scan of the same model."""
        if self._last is None or self._last[0] is not linearised:
            rows, width = self.whitened_model(linearised)
            self._last = linearised, *self._split(rows), width
        return self._last[1:]

    def whitened_model(self, linearised: LinearisedDwells) -> tuple[Floats, int]:
        """Whitened rows [H | W | z] (m, c) of the model in ``linearised``, and the number of columns before z."""
        return whiten_model(linearised, self.noise, [], self.state, self._stimulus)

    def _split(self, rows: Floats) -> tuple[Floats, Floats]:
        """Split columns (m, c) into their coordinates (r, c) in the frame and the remainder (m, c) orthogonal to it."""
        inside = self.basis.T @ rows
        return inside, rows - self.basis @ inside

    def delta_chi2(self, linearised: LinearisedDwells, effect: Effect, values_hz: Floats) -> Floats:
        """Decrease of chi-squared (n,) if an oscillation at each frequency, alone, is added to the model in
        ``linearised``; the periodogram is kept for further calls with the same frequencies.
        """
        key = _key(effect), values_hz.tobytes()
        if self._periodogram is None or self._periodogram[0] != key:
            self._periodogram = key, Periodogram(linearised, self.noise, effect, values_hz)
        return self._periodogram[1].delta_chi2(*_with_and_without_walk(linearised, self.noise, self.state, STATE_COUNT))


def _key(effect: Effect) -> tuple[str, float]:
    """Return what identifies an effect together with the value of its constant."""
    return str(effect), effect.value


def scan(linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect]) -> Scan:
    """Project ``effects`` off the model in ``linearised`` without a frame."""
    rows, width = whiten_model(linearised, noise, effects)
    return project(square_root_information.accumulate([rows]), width, effects, counts_of(effects))


def delta_chi2(linearised: LinearisedDwells, noise: Noise, effects: Sequence[Effect]) -> Floats:
    """Decrease of chi-squared (n,) if each of many effects of one kind, alone, is added: the ``statistics`` of a scan.

    Because nothing else is needed, the rows are not reduced by QR. For n columns in d rows the cost is then
    proportional to d times n instead of d times n^2.
    """
    if effects[0].oscillates and len(effects) > _MANY:
        many = Periodogram(linearised, noise, effects[0], np.array([effect.value for effect in effects]))
        return many.delta_chi2(*_with_and_without_walk(linearised, noise, linearised.state, linearised.model.count))
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
    linearised: LinearisedDwells,
    noise: Noise,
    effects: Sequence[Effect],
    state: Floats | None = None,
    stimulus: Stimulus | None = None,
) -> tuple[Floats, int]:
    """Whitened rows [H | W | G | z] (m, c) of the model in ``linearised`` and of ``effects``, and the number of columns
    before G.

    - W: columns of the slow part of a stated scatter, see ``whitened_rows.misfit_rows``.
    - state: where small rotations and input axes are linearised; by default at the state in ``linearised``.
    - stimulus: the stimulus of the dwells at that state, if it is already known.
    """
    at, dwells = linearised.state if state is None else state, linearised.dwells_at_state
    added = candidate_columns(dwells, effects, linearised.model.bench, at, stimulus)
    columns = [np.concatenate([own, more], axis=3) for own, more in zip(linearised.columns, added, strict=True)]
    rows, width = _judged(dwells, columns, noise, at, linearised.model.count)
    return _stacked(rows, dwells, noise), width


def columns_at_once(linearised: LinearisedDwells) -> int:
    """Number of columns to whiten at a time; it is larger for few dwells, where the overhead of the calls dominates."""
    return max(_TOGETHER, _CELLS // len(linearised.dwells))


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


def _with_and_without_walk(
    linearised: LinearisedDwells, noise: Noise, state: Floats, width: int
) -> tuple[Floats, Floats, int]:
    """Rows of the model in ``linearised`` as ``Periodogram.delta_chi2`` needs them: whitened, the walk of the biases
    taken out;
    those of the dwells alone with the walk still in them; and how many columns the first ``width`` become with W."""
    rows, count = _judged(linearised.dwells_at_state, linearised.columns, noise, state, width)
    of_dwells = np.concatenate(rows[len(rows) - len(linearised.dwells) :])
    return _stacked(rows, linearised.dwells, noise), of_dwells[:, noise.walk.steps :], count
