"""How many threads the linear algebra may take."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager[object]:
    """A context in which BLAS uses one thread: with several, small decompositions take three times as long and may give
    different bits every time."""
    return _controller("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


@cache
def _controller(scipy: bool) -> ThreadpoolController:
    """The controller of the loaded libraries, cached because finding them takes a millisecond; scipy brings its own."""
    return ThreadpoolController()
