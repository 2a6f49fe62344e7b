"""How many threads the linear algebra may take."""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[object]:
    """While it is entered BLAS works in one thread: small decompositions take three times as long with several, and
    these need not give the same bits every time."""
    return threadpool_limits(1, user_api="blas")
