"""Samples of one topic whose stamps are out of order, put in order where little memory does."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.streams import Stream, Times
from kf_calib.sources.files.mcap_records import Integers

_APART = 0.25  # of the usual step
_WINDOW_NS = 2_000_000_000
"""How late a sample may come: so much of the stream is held back once one has come late."""


class TimeOrder:
    """Passes a stream on as it is until a sample comes late, and sorts from then on.

    A late sample fills a gap. One that does not, or comes later than the window, is of a clock that was set back: what
    comes with it stays in its order, and whoever takes it counts what cannot be used. late: how many came late.
    """

    def __init__(self) -> None:
        self.late = 0
        self._held = Stream.empty(0)
        self._latest_ns: int | None = None
        self._is_sorting = False

    def __call__(self, stream: Stream) -> Stream:
        """Samples that can be passed on by now."""
        if not len(stream):
            return stream
        before_ns = stream.time_ns[0] if self._latest_ns is None else self._latest_ns
        latest = np.maximum.accumulate(np.append(before_ns, stream.time_ns))
        behind = latest[:-1] - stream.time_ns
        self._latest_ns = int(latest[-1])
        late = behind > 0
        if not late.any() and not self._is_sorting:
            return stream
        joined = self._held + stream if len(self._held) else stream
        order = np.argsort(joined.time_ns, kind="stable")
        if behind.max() > _WINDOW_NS or not _fill_gaps(joined.time_ns, order, stream.time_ns[late]):
            self._held, self._latest_ns = Stream.empty(joined.values.shape[1]), int(stream.time_ns[-1])
            return joined
        self._is_sorting, self.late = True, self.late + int(late.sum())
        joined = Stream(joined.time_ns[order], joined.values[order])
        ready = int(np.searchsorted(joined.time_ns, self._latest_ns - _WINDOW_NS, side="right"))
        self._held = joined[ready:]
        return joined[:ready]

    def rest(self, width: int) -> Stream:
        """What is held back at the end."""
        held, self._held = self._held, Stream.empty(width)
        return held if len(held) else Stream.empty(width)


def _fill_gaps(time_ns: Times, order: Integers, late_ns: Times) -> bool:
    """Return whether most late samples stand apart from their neighbours once all are in order."""
    if not len(late_ns) or len(time_ns) < 2:
        return not len(late_ns)
    in_order = time_ns[order]
    steps = np.diff(in_order)
    at = np.searchsorted(in_order, late_ns)
    nearest = np.minimum(steps[np.maximum(at - 1, 0)], steps[np.minimum(at, len(steps) - 1)])
    return bool(np.mean(nearest > _APART * np.median(steps)) > 0.5)
