"""How many threads the linear algebra may take."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager[object]:
    """While it is entered BLAS works in one thread: small decompositions take three times as long with several, and
    these need not give the same bits every time."""
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller() -> ThreadpoolController:
    """Of the libraries of numpy and scipy, which it takes a millisecond to find."""
    import numpy  # noqa: F401  # loads its library
    import scipy.linalg  # noqa: F401  # loads another one

    return ThreadpoolController()
