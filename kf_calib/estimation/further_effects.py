"""Score tests of effects beyond the catalogue, such as formulas: many groups, each tested for itself.

``Frame.scan`` writes all candidates in one basis, so that any two of them can be compared. Formulas are too many for
that, and only two things are asked of a group of them: what it explains, and whether it is a known effect by another
name. The model's columns and those of the known effects are therefore made orthonormal once, and each group is reduced
to a small triangle of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.qr import triangle
from kf_calib.effects import Effect
from kf_calib.estimation.candidate_scan import Complement, Scan, counts_of, is_within, scan_of, slices
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.score_test import Frame, batches, columns_at_once


class FurtherEffects:
    """Tests of groups of effects beside the model in ``linearised``, compared with ``known`` effects.

    An effect counts as known if the cosine of the largest angle between it and one of these is above ``cosine``.
    """

    def __init__(self, frame: Frame, linearised: LinearisedDwells, known: Sequence[Effect], cosine: float) -> None:
        self._frame, self._carried, self._cosine = frame, linearised, cosine
        rows, width = frame.whitened_model(linearised)
        self._beside = Complement(rows, width)
        self._residual = self._beside.of(rows[:, -1])
        self._known, self._parts = self._bases(known)

    def _bases(self, known: Sequence[Effect]) -> tuple[Floats, list[slice]]:
        """Return orthonormal bases (m, k) of what the model leaves of each known effect, and the columns of each."""
        bases, parts, last = np.empty((len(self._residual), sum(counts_of(known)))), list[slice](), 0
        for some, columns in self._columns(known):
            rest = self._beside.of(columns)
            for effect, part in zip(some, slices(counts_of(some)), strict=True):
                candidate = self._scan([effect], columns[:, part], rest[:, part]).candidates[0]
                parts.append(slice(last, last + candidate.dof))
                bases[:, parts[-1]], last = rest[:, part] @ candidate.inverse, parts[-1].stop
        return bases[:, :last], parts

    def _columns(self, known: Sequence[Effect]) -> Iterator[tuple[list[Effect], Floats]]:
        """Yield a few of the known effects at a time with their whitened columns (m, q)."""
        held = [effect for effect in known if self._frame.has(effect)]
        for part in batches(counts_of(held), columns_at_once(self._carried)):
            some = [held[k] for k in part]
            yield some, self._frame.columns(some)
        others = [effect for effect in known if effect not in held]
        yield others, self._frame.whitened(self._carried, others)

    def scans(self, groups: Sequence[Sequence[Effect]]) -> Iterator[tuple[Scan, list[bool]]]:
        """Scan each group alone, and tell of each of its effects whether it is known."""
        widths = [sum(counts_of(group)) for group in groups]
        for part in batches(widths, columns_at_once(self._carried)):
            some = [groups[k] for k in part]
            columns = self._frame.whitened(self._carried, [effect for group in some for effect in group])
            rest = self._beside.of(columns)
            cosines = self._known.T @ rest
            for group, own in zip(some, slices([widths[k] for k in part]), strict=True):
                found = self._scan(group, columns[:, own], rest[:, own])
                yield found, self._are_known(found, cosines[:, own])

    def _scan(self, effects: Sequence[Effect], columns: Floats, rest: Floats) -> Scan:
        """Scan effects by their columns (m, q) and what the model leaves of these."""
        upper = triangle(np.column_stack([rest, self._residual]))
        return scan_of(upper, np.linalg.norm(columns, axis=0), effects, counts_of(effects))

    def _are_known(self, scan: Scan, products: Floats) -> list[bool]:
        """Tell whether each candidate lies within a known effect; products (k, q): of the bases of these with the
        columns."""
        known = list[bool]()
        for candidate, columns in zip(
            scan.candidates, slices(counts_of([candidate.effect for candidate in scan.candidates])), strict=True
        ):
            cosines = (products[:, columns] @ candidate.inverse).T
            known.append(any(is_within(cosines[:, part], self._cosine) for part in self._parts))
        return known
