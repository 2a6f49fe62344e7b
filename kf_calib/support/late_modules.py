"""Modules that are run when something of them is asked for, not already when they are imported.

scipy takes over every name of numpy when it is imported, and so imports numpy's translator of Fortran and its tools for
tests. Nothing here uses them, and they take 0.1 s, a tenth of the shortest diagnosis.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType

_LATE = {"numpy.f2py", "numpy.testing"}


class _LateFinder(MetaPathFinder):
    """Finds what Python would find, with a loader that puts off running it (``importlib.util.LazyLoader``)."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in _LATE else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def put_off() -> None:
    """Put off what scipy imports and does not use, in all of this process; for a program, not for a library."""
    if not any(isinstance(finder, _LateFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _LateFinder())
