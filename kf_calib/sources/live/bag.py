"""An MCAP file that is being written, such as a ROS 2 bag."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live.feed import IDLE_S, Feed

_SURVEY_S = 0.2


class BagFeed(Feed):
    """Every chunk as soon as it is whole; ends when the file is finished, or where nothing came for ``idle_s``."""

    patient = True

    def __init__(self, path: Path, open_recording: Callable[[Path], Recording], idle_s: float) -> None:
        super().__init__(str(path))
        self._path, self._open, self._idle_s = path, open_recording, idle_s
        self._recording: Recording | None = None
        if not path.exists():
            raise InputError(f"{path} does not exist: check the path.")

    @property
    def warnings(self) -> list[str]:
        return [] if self._recording is None else self._recording.warnings_while_read

    def begin(self) -> Bench:
        began_s = time.monotonic()
        while True:
            try:
                self._recording = self._open(self._path)
            except BenchError:
                raise
            except InputError:  # its topics may still come
                if self.stopping or time.monotonic() - began_s > self._idle_s:
                    raise
                time.sleep(_SURVEY_S)
                continue
            self.link = "live"
            return self._recording.bench

    def __iter__(self) -> Iterator[Batch]:
        assert self._recording is not None
        last_s = time.monotonic()
        for batch in self._recording.following():
            if len(batch.accel) or len(batch.pose) or len(batch.temperature):
                last_s = time.monotonic()
            elif self.stopping or time.monotonic() - last_s > self._idle_s:
                return
            else:
                time.sleep(IDLE_S)
            yield batch
            if self.stopping:
                return
