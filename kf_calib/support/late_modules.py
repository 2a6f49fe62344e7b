"""What libraries import and nobody here uses is not run, in a process that is a command and nobody else's.

scipy takes over every name of numpy when it is imported, and so imports numpy's translator of Fortran and its tools for
tests: 0.1 s, a tenth of the shortest diagnosis. They are put off until something of them is asked for. pint imports
dask where it is installed, for arrays that no formula has: 0.1 to 0.2 s and 9 MB. It does not find it, unless dask is
there already.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType

_LATE = {"numpy.f2py", "numpy.testing"}
_WITHOUT = {"pint": "dask"}


class _Finder(MetaPathFinder):
    """Finds what Python would find, with a loader of ours."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in _LATE | _WITHOUT.keys():
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader) if fullname in _LATE else _Alone(spec.loader, _WITHOUT[fullname])
        return spec


class _Alone(Loader):
    """Runs a module as if another one were not installed."""

    def __init__(self, loader: Loader, other: str) -> None:
        self._loader, self._other = loader, other

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        hidden = self._other not in sys.modules
        if hidden:
            sys.modules[self._other] = None  # type: ignore[assignment]  # what Python takes for not installed
        try:
            self._loader.exec_module(module)
        finally:
            if hidden:
                del sys.modules[self._other]


def put_off() -> None:
    """Do so in all of this process; for a program, not for a library."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
