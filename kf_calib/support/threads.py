"""How many threads the linear algebra may take."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager[object]:
    """While it is entered BLAS works in one thread: small decompositions take three times as long with several, and
    these need not give the same bits every time."""
    return _controller("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


@cache
def _controller(scipy: bool) -> ThreadpoolController:
    """Of the libraries that are loaded, which it takes a millisecond to find; scipy brings one of its own."""
    return ThreadpoolController()
