"""All numbers of a result, in three figures a quantity: what changes any of them changes a figure.

A result is walked: mappings, sequences, and the public attributes and properties of all that is the package's. The
arrays under the same ``Class.attribute`` make its figures: how many numbers there are, the logarithms of the sizes of
the arrays (that of an array: its largest number), and the numbers over the sizes, both in sums with unequal weights.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any

import numpy as np

from helpers.stored_numbers import UNTOLD
from kf_calib.diagnosis.hypothesis_table import Hypothesis
from kf_calib.effects.effect import Effect
from kf_calib.errors import KfCalibError

_ZERO = 1e-13  # what is smaller is what rounding leaves of zero
_ZEROS = {"Fit.walk_gain": 1e-9, "Fit.scatter_gain": 1e-9}  # the same of differences of large numbers
_LEFT_OUT = ("kf_calib.sources", "kf_calib.views", "kf_calib.diagnosis.refits")
_DEEPEST = 12
_ARBITRARY = frozenset(
    ("Fit.misfit_rows", "Fit.considered", "Estimate.undetermined", "Estimate.unseen", "Estimate.determined",
     "Estimate.sigma", "Calibration.reached", "Candidate.columns", "Candidate.basis", "Candidate.directions",
     "Candidate.inverse", "Scan.residual", "WalkPath.modes", "Visit.nis", "Diagnosis.drivers",
     "FoldedDwells.pose_sigmas_rad")
)  # fmt: skip
"""Signs and bases that may be chosen at will, and what rounding decides where nothing is determined: these differ from
one processor to another."""


class ResultNumbers:
    """``figures`` of what was added, by ``Class.attribute``."""

    def __init__(self) -> None:
        self.figures = dict[str, list[float]]()
        self._walked = dict[int, Any]()  # what is kept alive keeps its identity
        self._on_the_way = list[type]()

    def add(self, thing: Any, name: str) -> ResultNumbers:
        """Walk through a thing that stands under a name."""
        match thing:
            case None | str() | bytes() | Effect():
                return self
            case bool() | int() | float() | np.number() | np.ndarray():
                self._take(np.asarray(thing), name)
                return self
        if id(thing) in self._walked or len(self._on_the_way) > _DEEPEST:
            return self
        self._walked[id(thing)] = thing
        match thing:
            case Mapping():
                for part in thing.values():
                    self.add(part, name)
            case Sequence() | Set():
                for part in sorted(thing, key=repr) if isinstance(thing, Set) else thing:
                    if not (isinstance(part, Hypothesis) and part.probability < UNTOLD):  # rounding orders these
                        self.add(part, name)
        self._add_parts(thing)
        return self

    def _add_parts(self, thing: Any) -> None:
        kind = type(thing)
        if not kind.__module__.startswith("kf_calib.") or kind.__module__.startswith(_LEFT_OUT):
            return
        computed = kind not in self._on_the_way  # else noise as seen by others would be seen by others without end
        self._on_the_way.append(kind)
        for attribute, is_computed in _attributes(kind):
            name = f"{kind.__name__}.{attribute}"
            if (computed or not is_computed) and name not in _ARBITRARY:
                self.add(_value(thing, attribute), name)
        self._on_the_way.pop()

    def _take(self, values: Any, name: str) -> None:
        if values.dtype.kind not in "biuf" or not values.size:
            return
        figures = self.figures.setdefault(name, [0, 0.0, 0.0])
        numbers = np.asarray(values, float).ravel()
        numbers = numbers[np.isfinite(numbers)]
        weight = 1.5 + np.cos(figures[0])
        figures[0] += int(values.size)
        size = float(np.abs(numbers).max(initial=0.0))
        if size > _ZEROS.get(name, _ZERO):
            figures[1] += weight * np.log(size)
            figures[2] += weight * float(np.cos(np.arange(1.0, len(numbers) + 1.0)) @ (numbers / size))


def _value(thing: Any, attribute: str) -> Any:
    """What an attribute is; nothing where this result has none."""
    try:
        return getattr(thing, attribute, None)
    except KfCalibError:
        return None


@functools.cache
def _attributes(kind: type) -> tuple[tuple[str, bool], ...]:
    """The public attributes of a class: fields, then properties, which are computed."""
    return tuple(_all_attributes(kind))


def _all_attributes(kind: type) -> Iterator[tuple[str, bool]]:
    fields = [each.name for each in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    yield from ((name, False) for name in fields if not name.startswith("_"))
    computed = (property, functools.cached_property)
    for name in dir(kind):
        if not name.startswith("_") and name not in fields and isinstance(inspect.getattr_static(kind, name), computed):
            yield name, True
